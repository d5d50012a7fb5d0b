"""Scenes of the experiments: of each kind what their name says, in one form, with the distances to their true surfaces."""

import dataclasses

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal
from radarsdf.io.npz import write_scans
from radarsdf.returns.sensor import Sensor
from radarsdf.scans import Scans
from radarsdf.simulate import Box, Pole, Terrain, materials
from radarsdf.simulate import Scene as World
from scipy.spatial import cKDTree

from bench.truth import along_normals, filled_truth, score_without_holes, to_planes, truth_of
from scenes.kinds import KINDS
from scenes.scene import load_scene


@pytest.fixture(scope="module")
def wall():
    return load_scene("wall", frames=6, seed=3)


def test_every_nth_subsamples_the_simulation(wall):
    third = wall.every_nth(3)
    assert len(third) == 2
    assert_array_equal(third.points[1], wall.points[3])
    assert_array_equal(third.intensities[1], wall.intensities[3])
    assert_array_equal(third.poses, wall.poses[[0, 3]])
    assert third.ground_truth is wall.ground_truth
    count = sum(map(len, third.points))
    assert third.simulation.is_surface().size == len(third.simulation.world_points()) == count
    assert_array_equal(third.simulation.noiseless_intensities[1], wall.simulation.noiseless_intensities[3])


def scans_with_lidar(frames):
    """Each scan has points 2 m, 10 m and 70 m ahead; lidar points are near them and elsewhere."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = 0.01 * np.arange(frames)
    points = [np.array([[2, 0, 0], [10, 0, 0], [70, 0, 0]], np.float32)] * frames
    intensities = [np.array([1, 2, 3], np.float32)] * frames
    lidar = np.array([[2, 0, 0], [10, 0, 0.9], [10, 0, 1.5], [70, 0, 0], [30, 0, 0]], np.float32)
    return Scans(points, poses, intensities, lidar)


@pytest.mark.parametrize(("frames", "every"), [(49, 5), (50, 10)])
def test_file(frames, every, tmp_path):
    write_scans(tmp_path / "street.npz", scans_with_lidar(frames))
    scene = load_scene(str(tmp_path / "street.npz"))
    assert (scene.name, len(scene), scene.holdout_every) == ("street", frames, every)
    assert (scene.min_range_m, scene.max_range_m, scene.simulation) == (2.5, 60.0, None)
    assert_array_equal(scene.points[1], [[2, 0, 0], [10, 0, 0], [70, 0, 0]])
    assert_array_equal(scene.intensities[1], [1, 2, 3])
    assert_array_equal(scene.ground_truth, np.float32([[10, 0, 0.9]]))
    assert len(load_scene(str(tmp_path / "street.npz"), frames=3)) == 3


@pytest.fixture(scope="module")
def scenes():
    return {name: make(seed=3, frames=2) for name, make in KINDS.items()}


def ranges_up(simulation):
    """Distance straight up from each sensor to the first surface, m."""
    at = simulation.poses[:, :3, 3]
    return simulation.scene.raycast(at, np.tile([0.0, 0.0, 1.0], (len(at), 1)), 100.0).range_m


def test_labels_of_returns_agree_with_distances_to_surfaces(scenes):
    for name, simulation in scenes.items():
        surface = simulation.is_surface()
        distance_m = np.abs(simulation.scene.signed_distance(simulation.world_points()))
        assert np.median(distance_m[surface]) < 0.15, name
        assert surface.mean() > 0.5, name
        if (~surface).sum() > 20:
            assert np.median(distance_m[~surface]) > 2 * np.median(distance_m[surface]), name


def test_enclosed_kinds_have_a_roof(scenes):
    roofed = {name for name, simulation in scenes.items() if np.isfinite(ranges_up(simulation)).all()}
    assert {"hall", "tunnel"} <= roofed
    assert not roofed & {"yard", "slope", "facade", "car_park", "fences"}


X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def wall_world():
    """A wall with the front x = 0 and the back x = -0.3, on ground at z = 0 and extending below it."""
    wall = Box(np.array([-0.15, 0.0, 1.0]), np.array([0.15, 5.0, 2.0]), 0.0, materials.BRICK)
    pole = Pole(np.array([4.0, 0.0, 0.0]), 0.1, 3.0, materials.METAL)
    return World([wall, pole], Terrain(np.ones((1, 2)), np.zeros(1), np.zeros(1), 0.0, materials.GRASS))


def errors(points, normal):
    points = np.atleast_2d(points).astype(np.float64)
    return along_normals(wall_world(), points, np.broadcast_to(normal, points.shape))


def test_errors_are_positive_in_front_and_negative_behind():
    points = [[0.2, 0, 1.5], [0.01, 1, 1], [0, 1, 1], [-0.1, 2, 1], [-0.29, 2, 1], [-0.5, 2, 1]]
    # The last three are nearer to the back, which has the opposite normal.
    np.testing.assert_allclose(errors(points, X), [0.2, 0.01, 0, -0.1, -0.29, -0.5], atol=1e-6)
    np.testing.assert_allclose(errors([[-0.5, 2, 1], [-0.1, 2, 1]], -X), [0.2, -0.2], atol=1e-6)


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


def test_points_beyond_an_edge_have_no_error():
    scene = load_scene("wall", frames=2)
    assert scene.simulation is not None
    simulation = dataclasses.replace(scene.simulation, scene=wall_world())
    scene = dataclasses.replace(scene, simulation=simulation)
    # Above the wall, which is 3 m high; next to it, with the normal up; and on the ground, 60 cm below that.
    x = np.array([[-0.1, 0, 3.05], [0.05, 0, 0.6], [0.7, 0, 0.02]])
    truth = truth_of(scene, x, np.broadcast_to(Z, x.shape))
    np.testing.assert_allclose(truth.error_m, [0.05, np.nan, 0.02], atol=1e-6)
    np.testing.assert_allclose(truth.distance_m, [0.05, 0.05, 0.02], atol=1e-6)


def test_the_filled_truth_has_no_holes_on_detectable_surface(wall):
    simulation = wall.simulation
    truth = filled_truth(simulation)
    assert np.abs(simulation.scene.signed_distance(truth)).max() < 1e-3
    assert len(np.unique(np.floor(truth / 0.1), axis=0)) == len(truth)
    rng, T = np.random.default_rng(0), simulation.lidar_poses[3]
    angles = rng.uniform(-0.5, 0.5, (3000, 2)) * [
        simulation.sensor.azimuth_fov_rad,
        simulation.sensor.elevation_fov_rad,
    ]
    directions = Sensor.directions(*angles.T) @ T[:3, :3].T
    hits = simulation.scene.raycast(T[:3, 3], directions, simulation.sensor.max_range_m)
    detected = (
        simulation.sensor.echo_power_db(simulation.scene, T[:3, 3], directions, hits)
        >= simulation.sensor.threshold_db
    )
    found = T[:3, 3] + hits.range_m[detected, None] * directions[detected]
    assert len(found) > 300
    assert (cKDTree(truth).query(found)[0] < 0.15).mean() > 0.999


def test_the_score_without_holes_is_of_the_scene_and_the_filled_truth(wall):
    simulation = wall.simulation
    truth = filled_truth(simulation)
    corners = truth[:, None] + 0.01 * np.eye(3)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(truth)).reshape(-1, 3), process=False)
    x = np.concatenate([truth, truth[::3] + [0, 0, 50.0]])  # a quarter is in the sky
    assert score_without_holes(simulation, mesh, x, 300_000) == pytest.approx(2 * 0.75 / 1.75, abs=1e-3)
    far = trimesh.Trimesh(mesh.vertices + [0, 0, 50.0], mesh.faces, process=False)
    assert score_without_holes(simulation, far, x, 300_000) == 0
