"""View statistics of intensity: means of returns that are close and have similar views."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf.returns.rays import prepare
from radarsdf.returns.view_statistics import ViewStatistics, ViewStatisticsAt, rows_of_views

LEAF_M = 0.2


@pytest.fixture(scope="module")
def rays():
    scans = radarsdf.simulate.wall(frames=12, seed=3)
    return prepare(scans.points, scans.poses, scans.intensities)


@pytest.fixture(scope="module")
def view_statistics(rays):
    return ViewStatistics.of(rays, (rays.intensities / 100).astype(np.float32), LEAF_M)


def test_view_statistics_are_means_of_their_returns(rays, view_statistics):
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
    # They are close and have similar views.
    assert np.ptp(rays.points[of_it], axis=0).max() <= 3 * LEAF_M + 1e-5
    assert np.ptp(rays.directions[of_it], axis=0).max() <= 0.25 + 1e-5
    assert count == len(found.counts)


def test_merged_parts_have_the_mean_of_their_variances(view_statistics):
    one = view_statistics.in_world(np.array([1.0, 2, 3]), 10.0, 30.0)
    assert one.sigma == pytest.approx(20 * view_statistics.sigma)
    few = dataclasses.replace(one.select(np.arange(len(one.counts)) < 5), sigma=3.0)
    both = ViewStatisticsAt.together([one, few])
    weights = np.array([one.counts.sum(), few.counts.sum()])
    assert both.sigma == pytest.approx(np.sqrt(weights @ [one.sigma**2, 9] / weights.sum()))
    np.testing.assert_array_equal(both.points, np.concatenate([one.points, one.points[:5]]))
    assert ViewStatisticsAt.together([few.select(np.zeros(5, bool))]).sigma == 3


def test_the_deviation_is_of_single_returns_from_their_means(rays, view_statistics):
    rows, count = rows_of_views(rays.points, rays.directions, rays.ranges_m, LEAF_M)
    values = rays.intensities / 100
    means = np.bincount(rows, values) / np.bincount(rows)
    squares = (values - means[rows]) ** 2
    assert view_statistics.sigma == pytest.approx(np.sqrt(squares.sum() / (len(rows) - count)), rel=1e-4)
