# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Sums over scans: the same in any order, and after a scan was taken out again."""

from __future__ import annotations

import dataclasses
import functools
import operator

import numpy as np
import pytest
from radarsdf.returns.cells import ReturnCells
from radarsdf.returns.rays import prepare
from radarsdf.returns.scan_sums import QUANTA, ScanSums

from ..conftest import ground_and_wall

LEAF_M = 0.2


def sums_of(rays, cells_of_edge):
    return ScanSums.of(rays, ReturnCells.of(rays, cells_of_edge * LEAF_M), cells_of_edge, LEAF_M)


def same(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(dataclasses.astuple(a), dataclasses.astuple(b), strict=True)
    )


@pytest.fixture(scope="module")
def rays():
    scene = ground_and_wall()
    return prepare(scene.points, scene.poses)


@pytest.mark.parametrize("cells_of_edge", [1, 2])
def test_scans_one_after_another_in_any_order_are_all_scans_at_once(rays, cells_of_edge):
    parts = [sums_of(rays.select(rays.scans == scan), cells_of_edge) for scan in np.unique(rays.scans)]
    order = np.random.default_rng(0).permutation(len(parts))
    whole = sums_of(rays, cells_of_edge)
    assert whole.scans.max() > 1
    assert same(functools.reduce(operator.add, [parts[i] for i in order]), whole)


@pytest.mark.parametrize("cells_of_edge", [1, 2])
def test_a_scan_that_is_taken_out_was_never_there(rays, cells_of_edge):
    gone = rays.scans == 2
    without = sums_of(rays.select(~gone), cells_of_edge)
    found = sums_of(rays, cells_of_edge) - sums_of(rays.select(gone), cells_of_edge)
    assert len(found.keys) < len(sums_of(rays, cells_of_edge).keys)
    assert same(found, without)


def test_means_and_moments_are_those_of_the_returns(rays):
    cells = ReturnCells.of(rays, LEAF_M)
    sums = ScanSums.of(rays, cells, 1, LEAF_M)
    points, quantum_m = rays.points.astype(np.float64), LEAF_M / QUANTA
    products = [points[:, i] * points[:, j] for i in range(3) for j in range(i, 3)]
    columns = [np.ones(len(points)), *points.T, *products, *rays.directions.T.astype(np.float64)]
    expected = np.stack([np.bincount(cells.cell_of_ray, column) for column in columns], 1)
    counts = expected[:, 0]
    assert np.array_equal(sums.counts, counts)
    assert np.abs(sums.mean_points - expected[:, 1:4] / counts[:, None]).max() <= quantum_m / 2 + 1e-9
    ranges_m = np.bincount(cells.cell_of_ray, rays.ranges_m) / counts
    assert np.abs(sums.mean_ranges_m - ranges_m).max() <= quantum_m / 2 + 1e-9
    np.testing.assert_allclose(sums.mean_directions, expected[:, 10:] / counts[:, None], rtol=0, atol=1e-7)
    # A product of two coordinates has an error of a quantum times both.
    bound = quantum_m * (np.abs(points).max() + quantum_m) * counts
    assert (np.abs(sums.moments - expected).max(axis=1) <= bound).all()


def test_cells_of_other_sizes_are_refused(rays):
    with pytest.raises(ValueError, match="different sizes"):
        sums_of(rays, 1) + sums_of(rays, 2)
