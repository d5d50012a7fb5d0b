# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities in closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.evaluation import KNNIntensity, holdout
from radarsdf.returns import reflectance
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare
from radarsdf.returns.reflectance import Reflectance, Residuals

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
    return Reflectance.of(
        Residuals.of(rays, values, Surfels.of(rays, LEAF_M, num_threads), LEAF_M), num_threads
    )


def at(found, rays):
    return found.at(rays.points, rays.directions, rays.ranges_m, 1).clip(0, 1)


def test_it_is_better_than_nearest_neighbours(rays):
    train, test = split(rays)
    low, high = train.intensities.min(), train.intensities.max()
    own = low + (high - low) * at(learnt(train, unit(train)), test)
    knn = KNNIntensity.chosen(*train.in_world(), train.intensities, train.scans)
    error = np.abs(own - test.intensities).mean()
    assert error < 0.99 * np.abs(knn.predict(*test.in_world()) - test.intensities).mean()


def test_a_law_of_the_range_holds_where_there_was_no_return(rays):
    values = (0.9 - 0.4 * np.log10(rays.ranges_m / 2)).astype(np.float32)
    found = learnt(rays, values)
    far = dataclasses.replace(rays, points=rays.points + np.float32(1000))
    assert values.std() > 0.05
    np.testing.assert_allclose(at(found, far), values, atol=0.02)


def test_the_view_decides_where_it_does(rays):
    """Of the same places, one half is bright from the left and the other from the right."""
    values = (0.5 + 0.4 * np.tanh(5 * rays.directions[:, 0] * np.sign(rays.points[:, 2]))).astype(np.float32)
    train, test = split(dataclasses.replace(rays, intensities=values))
    assert np.abs(at(learnt(train, train.intensities), test) - test.intensities).mean() < 0.3 * values.std()


def test_outliers_move_it_little(rays):
    train, test = split(rays)
    values = unit(train)
    struck = values.copy()
    struck[::20] = 1.0
    moved = np.abs(at(learnt(train, struck), test) - at(learnt(train, values), test)).mean()
    assert moved < 0.6 * np.abs(struck - values).mean()


def test_with_a_network_the_answer_is_the_mean_of_two(rays):
    """That of the network, and of half of it with what that leaves in closed form."""
    answers = np.linspace(0.2, 0.6, len(rays), dtype=np.float32)
    surfels = Surfels.of(rays, LEAF_M, 1)
    found = Reflectance.of(Residuals.of(rays, unit(rays), surfels, LEAF_M, lambda *_: answers))
    closed = Reflectance.of(Residuals.of(rays, unit(rays) - answers / 2, surfels, LEAF_M))
    whole, leaves = (r.at(rays.points, rays.directions, rays.ranges_m, 1) for r in (found, closed))
    assert closed.network_share == 0
    expected = (answers + (answers / 2 + leaves)) / 2
    np.testing.assert_allclose(found.network_share * answers + whole, expected, rtol=0, atol=1e-4)


def test_a_network_is_asked_once_for_a_group(rays, monkeypatch):
    for most in ("_MOST_RETURNS", "_MOST_ASKED"):
        monkeypatch.setattr(reflectance, most, 1000)
    asked = []

    def ask(points, directions, ranges_m):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
        asked.append(len(points))
        values = 0.3 + 0.02 * points[:, 0] + 0.1 * directions[:, 1] + 0.01 * ranges_m
        return values.astype(np.float32)

    answers = ask(rays.points, rays.directions, rays.ranges_m)
    surfels = Surfels.of(rays, LEAF_M, 1)
    found = Reflectance.of(Residuals.of(rays, unit(rays), surfels, LEAF_M, ask))
    assert asked[1] < 0.8 * len(rays)
    each = Reflectance.of(Residuals.of(rays, unit(rays) - answers / 2, surfels, LEAF_M))
    closed, leaves = (r.at(rays.points, rays.directions, rays.ranges_m, 1) for r in (found, each))
    assert answers.std() > 0.04
    # Within a group the answer differs by some hundredths.
    assert np.abs(2 * closed - leaves).mean() < 0.003


def test_means_that_tell_nothing_are_left_out(rays, monkeypatch):
    train, test = split(rays)
    found = learnt(train, unit(train))
    monkeypatch.setattr(reflectance, "_LEAST_MEAN", 0.0)
    whole = learnt(train, unit(train))
    assert len(found.means) < 0.8 * len(whole.means)
    errors = [np.abs(at(r, test) - unit(test)).mean() for r in (found, whole)]
    assert errors[0] < 1.005 * errors[1]


@pytest.mark.parametrize("most", [1000, 10**9], ids=["groups", "returns"])
def test_any_number_of_threads_has_the_same_bits(rays, monkeypatch, most):
    monkeypatch.setattr(reflectance, "_MOST_RETURNS", most)
    values = unit(rays)
    first, other = learnt(rays, values, 1), learnt(rays, values, 3)
    assert len(first.means) > 1000
    for name in ("coefficients", "table", "plane_keys", "normals", "mean_keys", "means"):
        np.testing.assert_array_equal(getattr(first, name), getattr(other, name))


def test_groups_cost_little(rays, monkeypatch):
    train, test = split(rays)
    exact = np.abs(at(learnt(train, unit(train)), test) - unit(test)).mean()
    monkeypatch.setattr(reflectance, "_MOST_RETURNS", 1000)
    assert np.abs(at(learnt(train, unit(train)), test) - unit(test)).mean() < 1.03 * exact


def test_answers_are_numbers_everywhere(rays):
    found = learnt(rays, unit(rays))
    points = np.array([[0, 0, 0], [1e7, -1e7, 1e7], [1e30, 0, 0]], np.float32)
    directions = np.tile(np.float32([1, 0, 0]), (3, 1))
    answers = found.at(points, directions, np.array([0, 1e7, 1e30], np.float32), 1)
    assert np.isfinite(answers).all()


def test_few_returns_have_no_planes_and_still_answer():
    points = [np.array([[5.0, 0, 0], [6.0, 1, 0]]), np.array([[7.0, 2, 0]])]
    config = FitConfig.quick()
    radar_map = radarsdf.fit(
        points, np.stack([np.eye(4)] * 2), [[1.0, 2.0], [3.0]], config=config, progress=False
    )
    places = np.array([[5.0, 0, 0], [9.0, 9, 9]])
    answers = radar_map.intensity(places, [0.0, 0, 0], extrapolate=True)
    assert ((answers >= 1) & (answers <= 3)).all()
