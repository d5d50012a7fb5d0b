# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Support and information: how many returns there are in and round each leaf cell, and what they tell."""

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
    sums = _sums_round(keys, counts, leaf_keys, num_threads)
    return np.minimum(sums, np.iinfo(np.uint16).max).astype(np.uint16)


def information_of_cells(
    keys: NDArray[np.uint64],
    information: NDArray[np.float32],
    leaf_keys: NDArray[np.uint64],
    num_threads: int = 0,
) -> NDArray[np.float32]:
    """What the returns in each leaf cell and in the 26 cells round it tell of a position there.

    Parameters
    ----------
    keys : ndarray
        (M,) uint64 Morton keys of cells with returns.
    information : ndarray
        (M,) float32 sum over the returns that each key stands for: 1 / variance of the return, m⁻².
    leaf_keys, num_threads
        As for :func:`support_of_points`.

    Returns
    -------
    ndarray
        (C,) float32, m⁻².
    """
    return _sums_round(keys, information, leaf_keys, num_threads).astype(np.float32)


def _sums_round(
    keys: NDArray[np.uint64],
    weights: NDArray[np.float32] | None,
    leaf_keys: NDArray[np.uint64],
    num_threads: int,
) -> NDArray[np.float64]:
    """(C,) sums of `weights` in each leaf cell and the 26 cells round it. None: each key weighs 1."""
    cells = CellBlocks(leaf_keys)
    rows = cells.rows(keys, num_threads)
    inside = rows >= 0
    sums = np.bincount(rows[inside], None if weights is None else weights[inside], len(leaf_keys))
    round_: NDArray[np.float64] = cells.sum_round(
        leaf_keys, sums.astype(np.float64)[:, None], 1.0, num_threads
    )
    return round_[:, 0]
