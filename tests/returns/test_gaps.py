# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Gaps between returns are bridged where a surface goes on, and nowhere else."""

import numpy as np
import pytest
from radarsdf._core import CellSet, cell_keys
from radarsdf.config.fit_config import LATTICE_BLOCK_CELLS
from radarsdf.returns.evidence import _MAX_SUPPORT, bridged, support_at
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import ReturnCells

LEAF_M = 0.2


def rays_to(cells, count=1):
    """`count` returns in the middle of each cell, seen from afar."""
    points = (np.repeat(np.asarray(cells, float), count, axis=0) + 0.5) * LEAF_M
    pose = np.eye(4)
    pose[:3, 3] = [0, 0, 30]
    # The local frame's zero is the sensor, a whole number of cells away.
    return prepare([points - pose[:3, 3]], pose[None], min_range_m=1.0, max_range_m=None)


def leaf_keys_of(rays):
    cells = CellSet(LEAF_M)
    cells.insert(np.ascontiguousarray(rays.points), 1)
    return cells.sorted_keys(1)


def key_of(rays, cell):
    return cell_keys(((np.array([cell], float) + 0.5) * LEAF_M - rays.origin), LEAF_M)[0]


def added(rays, max_cells, leaf_keys=None):
    leaf_keys = leaf_keys_of(rays) if leaf_keys is None else leaf_keys
    cells = ReturnCells.of(rays, LEAF_M)
    result = bridged(leaf_keys, cells.keys, cells.counts, max_cells)
    np.testing.assert_array_equal(result, bridged(leaf_keys, cells.keys, cells.counts, max_cells, 3))
    assert (np.diff(result.astype(np.int64)) > 0).all()
    assert np.isin(leaf_keys, result).all()
    return set(np.setdiff1d(result, leaf_keys).tolist())


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (1, 1, 0), (-1, 0, 1), (1, -1, -1)])
@pytest.mark.parametrize("gap", [1, 2, 3])
def test_the_cells_between_two_returns_and_no_others(direction, gap):
    start, step = np.array([3, -2, 0]), np.array(direction)
    rays = rays_to([start, start + (gap + 1) * step])
    between = {key_of(rays, start + i * step) for i in range(1, gap + 1)}
    assert added(rays, gap) == between
    assert added(rays, 8) == between
    assert added(rays, gap - 1) == set()


def test_badly_supported_and_dense_ends_are_not_bridged():
    block = [(x, y, 0) for x in range(3) for y in range(3)]
    lone = (4, 1, 0)
    assert added(rays_to([*block, lone]), 1) == set()  # one return, against a median of five
    assert len(added(rays_to([*block, lone, lone, lone]), 1)) == 1
    for count, bridges in ((int(_MAX_SUPPORT) - 1, 1), (int(_MAX_SUPPORT), 0)):
        assert len(added(rays_to([(0, 0, 0), (2, 0, 0)], count), 1)) == bridges


@pytest.mark.parametrize("max_cells", [1, 2, 4])
def test_as_a_search_of_all_pairs(max_cells):
    rng = np.random.default_rng(max_cells)
    rays = rays_to(rng.integers(-6, 6, (150, 3)))
    leaf_keys = leaf_keys_of(rays)
    cells = np.unique(np.floor(rays.points / np.float32(LEAF_M)).astype(int), axis=0)
    keys = cell_keys(((cells + 0.5) * LEAF_M), LEAF_M)
    returns = ReturnCells.of(rays, LEAF_M)
    support = support_at(keys, returns.keys, returns.counts)
    block = cells // LATTICE_BLOCK_CELLS  # the cells lie in eight of them, and every leaf cell holds returns
    same = (block[:, None] == block).all(axis=2)
    least = np.array([0.5 * np.median(support[of_block]) for of_block in same])
    expected = set()
    for i, a in enumerate(cells):
        for j, b in enumerate(cells[:i]):
            way = b - a
            distance = np.abs(way).max()
            if not 2 <= distance <= max_cells + 1 or not np.isin(np.abs(way), (0, distance)).all():
                continue
            if (support[[i, j]] >= least[[i, j]]).all() and support[i] + support[j] < 2 * _MAX_SUPPORT:
                line = a + np.arange(1, distance)[:, None] * (way // distance)
                expected |= set(cell_keys((line + 0.5) * LEAF_M, LEAF_M).tolist())
    assert added(rays, max_cells) == expected - set(leaf_keys.tolist())
