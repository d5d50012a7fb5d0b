"""Cells that hold returns, and integer sums in them."""

import numpy as np
import pytest
from radarsdf._core import QUANTA
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import UPPER, MeanRays, ReturnCells, ScanSums, merged_keys

from ..conftest import ground_and_wall

LEAF_M = 0.2


def sums_of(rays):
    return ScanSums.of(rays, LEAF_M)


@pytest.fixture(scope="module")
def rays():
    scene = ground_and_wall()
    return prepare(scene.points, scene.poses)


def test_means_equal_those_of_the_returns(rays):
    cells, sums = ReturnCells.of(rays, LEAF_M), sums_of(rays)
    quantum_m, counts = LEAF_M / QUANTA, sums.counts

    def means(values):
        columns = np.atleast_2d(values.T.astype(np.float64))
        return np.stack([np.bincount(cells.cell_of_ray, column) for column in columns], 1) / counts[:, None]

    assert np.array_equal(counts, np.bincount(cells.cell_of_ray))
    found = MeanRays.of_sums(sums)
    bound_m = quantum_m / 2 + np.spacing(np.float32(np.abs(rays.points).max()))
    assert np.abs(found.points - means(rays.points)).max() <= bound_m
    assert np.abs(found.ranges_m - means(rays.ranges_m)[:, 0]).max() <= bound_m
    directions = means(rays.directions)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(found.directions, directions, rtol=0, atol=2e-7)
    assert np.array_equal(found.counts, counts)


def test_moments_equal_those_of_returns_in_parent_cells(rays):
    cells = ReturnCells.of(rays, 2 * LEAF_M)
    points = rays.points.astype(np.float64)
    products = [points[:, i] * points[:, j] for i, j in UPPER]
    columns = [np.ones(len(points)), *points.T, *products, *rays.directions.T.astype(np.float64)]
    expected = np.stack([np.bincount(cells.cell_of_ray, column) for column in columns], 1)
    keys, moments = sums_of(rays).merged_moments()
    np.testing.assert_array_equal(keys, cells.keys)
    np.testing.assert_array_equal(keys, np.unique(merged_keys(sums_of(rays).keys)))
    np.testing.assert_array_equal(moments[:, 0], expected[:, 0])
    # A product of two coordinates has an error of a quantum times both.
    quantum_m = LEAF_M / QUANTA
    bound = quantum_m * (np.abs(points).max() + quantum_m) * expected[:, 0]
    assert (np.abs(moments - expected).max(axis=1) <= bound).all()
