# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Cells without a return that a surface crosses all the same: what a sparse sensor left out between two returns."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, cell_keys
from radarsdf.returns.rays import Rays
from radarsdf.returns.support import support_of_points

# Measured on simulated and real scans; see "What the levers of the surface are worth" in BENCHMARK.md.
_MIN_SUPPORT = 0.5  # of the median: returns of less are too often false to say where a surface goes on
_MAX_SUPPORT = (
    9.0  # returns in 27 cells, of which a surface crosses nine: one a cell, and a hole is hardly chance
)


def bridged(
    leaf_keys: NDArray[np.uint64], rays: Rays, leaf_size_m: float, max_cells: int, num_threads: int = 0
) -> NDArray[np.uint64]:
    """`leaf_keys` and, ascending among them, the cells between two that hold returns, in one of 13 directions.

    Parameters
    ----------
    leaf_keys : ndarray
        (C,) Morton keys of the cells that near-surface samples fall into, ascending.
    rays : Rays
        The returns.
    leaf_size_m : float
        Edge of the cells, m.
    max_cells : int
        So many cells in a row are bridged at most.
    num_threads : int
        0: as many as OpenMP uses.
    """
    if max_cells == 0:
        return leaf_keys
    points = np.ascontiguousarray(rays.points)
    support = support_of_points(points, leaf_keys, leaf_size_m, num_threads)
    median = float(np.median(support[support > 0])) if support.any() else 0.0
    keys, first = np.unique(cell_keys(points, leaf_size_m, num_threads), return_index=True)
    rows = np.minimum(np.searchsorted(leaf_keys, keys), len(leaf_keys) - 1)
    returns = np.where(leaf_keys[rows] == keys, support[rows], 0).astype(np.float64)
    least = max(1.0, _MIN_SUPPORT * median)
    used = (returns >= least) & (returns + least < 2 * _MAX_SUPPORT)  # more finds no partner
    keys, first, returns = keys[used], first[used], returns[used]
    cells = np.floor(points[first] * np.float32(1 / leaf_size_m))  # as the core does it, to the bit
    ends = CellBlocks(keys)

    def keys_at(cells: NDArray[np.float32]) -> NDArray[np.uint64]:
        return cell_keys((cells.astype(np.float64) + 0.5) * leaf_size_m, leaf_size_m, num_threads)

    found = [leaf_keys]
    for direction in itertools.product((-1, 0, 1), repeat=3):
        if direction <= (0, 0, 0):
            continue  # the same pairs from their other ends
        step = np.array(direction, np.float32)
        for distance in range(2, max_cells + 2):
            row = ends.rows(keys_at(cells + distance * step), num_threads)
            pair = np.flatnonzero(row >= 0)
            pair = pair[returns[pair] + returns[row[pair]] < 2 * _MAX_SUPPORT]
            found += [keys_at(cells[pair] + between * step) for between in range(1, distance)]
    keys = np.concatenate(found)
    keys.sort()  # np.unique would build a hash table, ten times slower
    different: NDArray[np.uint64] = keys[np.concatenate([[True], keys[1:] != keys[:-1]])]
    return different
