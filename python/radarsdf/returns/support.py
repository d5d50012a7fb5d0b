# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Support: the number of returns in and round each leaf cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, cell_keys


def support_of_points(
    points: NDArray[np.float32], leaf_keys: NDArray[np.uint64], leaf_size_m: float, num_threads: int = 0
) -> NDArray[np.uint16]:
    """Support of leaf cells: the number of returns in each and in the 26 cells round it.

    Parameters
    ----------
    points : ndarray
        (N, 3) float32 returns, local frame, m.
    leaf_keys : ndarray
        (C,) uint64 Morton keys of the leaf cells, ascending.
    leaf_size_m : float
        Edge of a leaf cell, m.
    num_threads : int
        0: as many as OpenMP uses.

    Returns
    -------
    ndarray
        (C,) uint16. A count above 65535 is stored as 65535.
    """
    keys = cell_keys(np.ascontiguousarray(points), leaf_size_m, num_threads)
    return support_of_cells(keys, None, leaf_keys, num_threads)


def support_of_cells(
    keys: NDArray[np.uint64],
    counts: NDArray[np.float32] | None,
    leaf_keys: NDArray[np.uint64],
    num_threads: int = 0,
) -> NDArray[np.uint16]:
    """:func:`support_of_points` for returns that are already counted in cells.

    Parameters
    ----------
    keys : ndarray
        (M,) uint64 Morton keys of cells with returns.
    counts : ndarray or None
        (M,) float32 number of returns in each of them. None: one for each key.
    leaf_keys, num_threads
        As for :func:`support_of_points`.

    Returns
    -------
    ndarray
        (C,) uint16. A count above 65535 is stored as 65535.
    """
    cells = CellBlocks(leaf_keys)
    rows = cells.rows(keys, num_threads)
    inside = rows >= 0
    returns = np.bincount(rows[inside], None if counts is None else counts[inside], len(leaf_keys))
    sums = cells.sum_round(leaf_keys, returns.astype(np.float64)[:, None], 1.0, num_threads)[:, 0]
    return np.minimum(sums, np.iinfo(np.uint16).max).astype(np.uint16)
