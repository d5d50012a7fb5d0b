# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities in closed form."""

import numpy as np
import pytest
import radarsdf
from radarsdf.evaluation import KNNIntensity, holdout
from radarsdf.returns import reflectance
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare
from radarsdf.returns.reflectance import Reflectance

LEAF_M = 0.2


@pytest.fixture(scope="module")
def rays():
    scans = radarsdf.simulate.wall(frames=12, seed=2)
    return prepare(scans.points, scans.poses, scans.intensities, min_range_m=2.5)


def split(rays, every=4):
    """The rays of the training scans, and of the held-out ones."""
    test = np.isin(rays.scans, holdout(rays.scans, every)[1])
    return rays.select(~test), rays.select(test)


def unit(rays):
    values = rays.intensities
    return ((values - values.min()) / (values.max() - values.min())).astype(np.float32)


def learnt(rays, values, num_threads=1):
    surfels = Surfels.of(rays, LEAF_M, num_threads)
    return Reflectance.of(rays, values, surfels, LEAF_M, num_threads=num_threads)


def at(found, rays):
    return found.at(rays.points, rays.directions, rays.ranges_m, 1).clip(0, 1)


def test_it_is_better_than_nearest_neighbours(rays):
    train, test = split(rays)
    low, high = train.intensities.min(), train.intensities.max()
    own = low + (high - low) * at(learnt(train, unit(train)), test)
    knn = KNNIntensity.chosen(*train.in_world(), train.intensities, train.scans)
    error = np.abs(own - test.intensities).mean()
    assert error < 0.99 * np.abs(knn.predict(*test.in_world()) - test.intensities).mean()


def test_with_a_network_the_answer_is_the_mean_of_two(rays):
    """That of the network, and of half of it with what that leaves in closed form."""
    answers = np.linspace(0.2, 0.6, len(rays), dtype=np.float32)
    surfels = Surfels.of(rays, LEAF_M, 1)
    found = Reflectance.of(rays, unit(rays), surfels, LEAF_M, lambda *_: answers)
    closed = Reflectance.of(rays, unit(rays) - answers / 2, surfels, LEAF_M)
    whole, leaves = (r.at(rays.points, rays.directions, rays.ranges_m, 1) for r in (found, closed))
    assert closed.network_share == 0
    expected = (answers + (answers / 2 + leaves)) / 2
    np.testing.assert_allclose(found.network_share * answers + whole, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("most", [1000, 10**9], ids=["groups", "returns"])
def test_any_number_of_threads_has_the_same_bits(rays, monkeypatch, most):
    monkeypatch.setattr(reflectance, "_MOST_RETURNS", most)
    values = unit(rays)
    first, other = learnt(rays, values, 1), learnt(rays, values, 3)
    assert len(first.means) > 1000
    for name in ("coefficients", "table", "plane_keys", "normals", "mean_keys", "means"):
        np.testing.assert_array_equal(getattr(first, name), getattr(other, name))


def test_answers_are_numbers_everywhere(rays):
    found = learnt(rays, unit(rays))
    points = np.array([[0, 0, 0], [1e7, -1e7, 1e7], [1e30, 0, 0]], np.float32)
    directions = np.tile(np.float32([1, 0, 0]), (3, 1))
    answers = found.at(points, directions, np.array([0, 1e7, 1e30], np.float32), 1)
    assert np.isfinite(answers).all()
