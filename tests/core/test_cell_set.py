# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The set of cells and the order of keys, against NumPy."""

import numpy as np
import pytest
from radarsdf._core import CellSet, cell_keys, gather_rows, stable_order

LEAF_M = 0.2
OFFSETS_M = np.linspace(-0.3, 0.3, 7).astype(np.float32)


def rays_of(count, half_m=20.0):
    rng = np.random.default_rng(count)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return rng.uniform(-half_m, half_m, (count, 3)).astype(np.float32), directions.astype(np.float32)


def along(points, directions):
    return (points[:, None] + OFFSETS_M[:, None] * directions[:, None]).reshape(-1, 3)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 300, 70_000])  # the last: more than are marked at a time
def test_points_along_rays_mark_the_cells_of_those_points(count, threads):
    points, directions = rays_of(count)
    expected = np.unique(cell_keys(along(points, directions), LEAF_M))
    for cells, insert in ((CellSet(LEAF_M), "along"), (CellSet(LEAF_M), "points")):
        if insert == "along":
            cells.insert_along(points, directions, OFFSETS_M, threads)
        else:
            cells.insert(along(points, directions), threads)
        np.testing.assert_array_equal(cells.sorted_keys(threads), expected)
        assert len(cells) == len(expected)


@pytest.mark.parametrize("highest", [1, 2**9, 2**40, 2**64])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_the_order_of_keys_is_stable(highest, count):
    keys = np.random.default_rng(count).integers(0, highest, count, np.uint64)
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("count", [0, 1, 40_000])
def test_rows_of_blocks_are_gathered_side_by_side(count):
    generator = np.random.default_rng(0)
    blocks = [generator.normal(size=(50_000, width)).astype(np.float32) for width in (3, 1, 4)]
    order = generator.integers(0, 50_000, count, np.int32)
    for threads in (1, 3):
        out = np.zeros((count, 8), np.float32)
        gather_rows(blocks, order, out, threads)
        np.testing.assert_array_equal(out, np.concatenate(blocks, 1)[order])
