# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Support: how many returns there are in and round each leaf cell."""

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
    cells = CellBlocks(leaf_keys)
    rows = cells.rows(keys, num_threads)
    counts = np.bincount(rows[rows >= 0], minlength=len(leaf_keys)).astype(np.float64)
    sums = cells.sum_round(leaf_keys, counts[:, None], 1.0, num_threads)[:, 0]
    return np.minimum(sums, np.iinfo(np.uint16).max).astype(np.uint16)
