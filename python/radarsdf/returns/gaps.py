# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Bridges gaps: adds the empty cells that a sparse sensor leaves between cells with returns."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, cell_keys
from radarsdf.config import BLOCK_CELLS
from radarsdf.returns.rays import Rays
from radarsdf.returns.support import support_of_points

# Measured on simulated and real scans; see docs/levers.md.
# Share of the median support of the block. Returns with less are too often false to tell where a surface goes on.
_MIN_SUPPORT = 0.5
# Mean support of the two ends of a bridge, at most. A surface crosses about nine of the 27 cells. With one
# return in each of these or more, an empty cell is most likely a real gap.
_MAX_SUPPORT = 9.0


def bridged(
    leaf_keys: NDArray[np.uint64], rays: Rays, leaf_size_m: float, max_cells: int, num_threads: int = 0
) -> NDArray[np.uint64]:
    """Adds the leaf cells that bridge a gap: those on the line between two cells with returns.

    Lines run along the axes and the diagonals of the cells, in 13 directions.

    Parameters
    ----------
    leaf_keys : ndarray
        (C,) uint64 Morton keys of the leaf cells near the surface, ascending.
    rays : Rays
        The returns.
    leaf_size_m : float
        Edge of a leaf cell, m.
    max_cells : int
        Largest number of cells between the two.
    num_threads : int
        0: as many as OpenMP uses.

    Returns
    -------
    ndarray
        (C',) uint64 Morton keys of `leaf_keys` and the new cells, ascending.
    """
    if max_cells == 0:
        return leaf_keys
    points = np.ascontiguousarray(rays.points)
    support = support_of_points(points, leaf_keys, leaf_size_m, num_threads)
    medians = _medians(leaf_keys, support)
    keys, first = np.unique(cell_keys(points, leaf_size_m, num_threads), return_index=True)
    rows = np.minimum(np.searchsorted(leaf_keys, keys), len(leaf_keys) - 1)
    here = leaf_keys[rows] == keys
    returns = np.where(here, support[rows], 0).astype(np.float64)
    least = np.maximum(1.0, _MIN_SUPPORT * np.where(here, medians[rows], 0))
    used = (returns >= least) & (
        returns + least < 2 * _MAX_SUPPORT
    )  # with more, the mean with any other end is too high
    keys, first, returns = keys[used], first[used], returns[used]
    cells = np.floor(points[first] * np.float32(1 / leaf_size_m))  # the same bits as in the core
    ends = CellBlocks(keys)

    def keys_at(cells: NDArray[np.float32]) -> NDArray[np.uint64]:
        return cell_keys((cells.astype(np.float64) + 0.5) * leaf_size_m, leaf_size_m, num_threads)

    found = [leaf_keys]
    for direction in itertools.product((-1, 0, 1), repeat=3):
        if direction <= (0, 0, 0):
            continue  # the opposite direction finds the same pairs
        step = np.array(direction, np.float32)
        for distance in range(2, max_cells + 2):
            row = ends.rows(keys_at(cells + distance * step), num_threads)
            pair = np.flatnonzero(row >= 0)
            pair = pair[returns[pair] + returns[row[pair]] < 2 * _MAX_SUPPORT]
            found += [keys_at(cells[pair] + between * step) for between in range(1, distance)]
    keys = np.concatenate(found)
    keys.sort()  # np.unique takes ten times as long: it builds a hash table
    different: NDArray[np.uint64] = keys[np.concatenate([[True], keys[1:] != keys[:-1]])]
    return different


def _medians(leaf_keys: NDArray[np.uint64], support: NDArray[np.uint16]) -> NDArray[np.float64]:
    """(C,) median of the `support` (C,) of the leaf cells with returns round them in the block of each cell.

    Of a block, not of the map: what is added here must not depend on how many returns there are elsewhere.
    """
    block = leaf_keys >> np.uint64(3 * (BLOCK_CELLS.bit_length() - 1))
    starts = np.flatnonzero(np.diff(block, prepend=~block[:1]))  # cells of a block follow each other
    # Sorted within blocks: the number of the block counts more than the support.
    number = np.repeat(np.arange(len(starts), dtype=np.uint64), np.diff(starts, append=len(block)))
    ordered = np.sort(number << np.uint64(16) | support) & np.uint64(0xFFFF)
    ends = np.append(starts[1:], len(block))
    zeros = np.add.reduceat(ordered == 0, starts)
    first = starts + zeros  # of those with returns; if there are none, medians are of no use
    last = np.maximum(ends - 1, first)
    middle = np.minimum([(first + last) // 2, (first + last + 1) // 2], len(block) - 1)
    return ordered[middle].mean(axis=0)[number.astype(np.int64)]  # type: ignore[no-any-return]
