# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Echoes: means of returns that are close and seen alike."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf.returns.rays import prepare
from radarsdf.returns.view_statistics import ViewStatistics, rows_of_views

LEAF_M = 0.2


@pytest.fixture(scope="module")
def rays():
    scans = radarsdf.simulate.wall(frames=12, seed=3)
    return prepare(scans.points, scans.poses, scans.intensities)


@pytest.fixture(scope="module")
def view_statistics(rays):
    return ViewStatistics.of(rays, (rays.intensities / 100).astype(np.float32), LEAF_M)


def test_they_are_the_means_of_their_returns(rays, view_statistics):
    rows, count = rows_of_views(rays.points, rays.directions, rays.ranges_m, LEAF_M)
    found = view_statistics.in_world(rays.origin, 0.0, 100.0)
    assert found.counts.sum() == len(rays)
    largest = int(np.argmax(found.counts))
    of_it = rows == largest
    assert 20 < of_it.sum() == found.counts[largest]
    np.testing.assert_allclose(found.intensities[largest], rays.intensities[of_it].mean(), rtol=1e-5)
    np.testing.assert_allclose(
        found.points[largest], rays.points[of_it].mean(axis=0) + rays.origin, atol=1e-4
    )
    np.testing.assert_allclose(found.ranges_m[largest], rays.ranges_m[of_it].mean(), rtol=1e-3)
    np.testing.assert_allclose(found.directions[largest], rays.directions[of_it].mean(axis=0), atol=0.02)
    # They are close and seen alike.
    assert np.ptp(rays.points[of_it], axis=0).max() <= 3 * LEAF_M + 1e-5
    assert np.ptp(rays.directions[of_it], axis=0).max() <= 0.25 + 1e-5
    assert count == len(found.counts)


def test_wrong_arrays_are_refused(view_statistics):
    view_statistics.check(LEAF_M)
    ViewStatistics.none().check(LEAF_M)
    for change in (
        {"points": view_statistics.points[1:]},
        {"points": view_statistics.points + np.float32(1e7)},
        {"counts": np.zeros_like(view_statistics.counts)},
        {"ranges_m": -view_statistics.ranges_m},
        {"sigma": np.inf},
        {"sigma": np.nan},
    ):
        with pytest.raises(ValueError, match="the view statistics"):
            dataclasses.replace(view_statistics, **change).check(LEAF_M)
