# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Distances to true surfaces along normals, where they are known in closed form."""

import dataclasses

import numpy as np
import pytest
from radarsdf.simulate import Box, Pole, Terrain, materials
from radarsdf.simulate import Scene as World

from bench.scenes import load_scene
from bench.truth import along_normals, to_planes, truth_of

X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def flat_ground():
    return Terrain(np.ones((1, 2)), np.zeros(1), np.zeros(1), 0.0, materials.GRASS)


def wall_world():
    """A wall whose front is x = 0 and whose back is x = -0.3, on ground at z = 0 and reaching below it."""
    wall = Box(np.array([-0.15, 0.0, 1.0]), np.array([0.15, 5.0, 2.0]), 0.0, materials.BRICK)
    pole = Pole(np.array([4.0, 0.0, 0.0]), 0.1, 3.0, materials.METAL)
    return World([wall, pole], flat_ground())


def errors(points, normal):
    points = np.atleast_2d(points).astype(np.float64)
    return along_normals(wall_world(), points, np.broadcast_to(normal, points.shape))


def test_errors_are_positive_in_front_and_negative_behind():
    points = [[0.2, 0, 1.5], [0.01, 1, 1], [0, 1, 1], [-0.1, 2, 1], [-0.29, 2, 1], [-0.5, 2, 1]]
    # The last three are nearer to the back, which faces the other way.
    np.testing.assert_allclose(errors(points, X), [0.2, 0.01, 0, -0.1, -0.29, -0.5], atol=1e-6)
    np.testing.assert_allclose(errors([[-0.5, 2, 1], [-0.1, 2, 1]], -X), [0.2, -0.2], atol=1e-6)


def test_ground_under_things_and_foundations():
    # Beside the wall; and 5 cm below the ground, 10 cm in front of the foundation, which is not the surface.
    np.testing.assert_allclose(errors([[0.1, 0, 0.1], [0.1, 0, -0.05]], Z), [0.1, -0.05], atol=1e-6)
    np.testing.assert_allclose(errors([4.0 - 0.15, 0, 1.0], -X), [0.05], atol=1e-6)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5e5, 5.4e6, 120.0)], ids=["local", "UTM"])
def test_planes_through_noisy_points(offset):
    rng = np.random.default_rng(0)
    lidar = np.column_stack([0.02 * rng.standard_normal(20_000), rng.uniform(-4, 4, (20_000, 2))]) + offset
    x = np.column_stack([rng.uniform(-0.4, 0.4, 200), rng.uniform(-3, 3, (200, 2))])
    nearest = np.array([np.argmin(np.linalg.norm(lidar - offset - point, axis=1)) for point in x])
    for normal, sign in ((X, 1.0), (-X, -1.0), (np.array([0.8, 0.6, 0.0]), 1 / 0.8)):
        found = to_planes(lidar, nearest, x + offset, np.broadcast_to(normal, x.shape), offset + 9 * X[None])
        np.testing.assert_allclose(found, sign * x[:, 0], atol=0.03)
    assert np.isnan(
        to_planes(lidar, nearest, x + offset, np.broadcast_to(Z, x.shape), offset + 9 * X[None])
    ).all()


def test_beyond_an_edge_there_is_no_error():
    scene = load_scene("wall", frames=2)
    assert scene.simulation is not None
    simulation = dataclasses.replace(scene.simulation, scene=wall_world())
    scene = dataclasses.replace(scene, simulation=simulation)
    # Above the wall, whose top is at 3 m; beside it, with the normal up; and on the ground, 60 cm under that.
    x = np.array([[-0.1, 0, 3.05], [0.05, 0, 0.6], [0.7, 0, 0.02]])
    truth = truth_of(scene, x, np.broadcast_to(Z, x.shape))
    np.testing.assert_allclose(truth.error_m, [0.05, np.nan, 0.02], atol=1e-6)
    np.testing.assert_allclose(truth.distance_m, [0.05, 0.05, 0.02], atol=1e-6)
