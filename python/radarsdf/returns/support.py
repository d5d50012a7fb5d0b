# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Support: how many returns there are in and round each leaf cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks

_MOST = float(np.iinfo(np.uint16).max)


def support_at(
    leaf_keys: NDArray[np.uint64], keys: NDArray[np.uint64], counts: NDArray[np.float64], num_threads: int = 0
) -> NDArray[np.float64]:
    """Support of leaf cells: the number of returns in each and in the 26 cells round it.

    Parameters
    ----------
    leaf_keys : ndarray
        (C,) uint64 Morton keys of the leaf cells.
    keys : ndarray
        (M,) uint64 Morton keys of the cells that hold returns, ascending.
    counts : ndarray
        (M,) float64 number of returns in each of `keys`.
    num_threads : int
        0: as many as OpenMP uses.

    Returns
    -------
    ndarray
        (C,) float64. A count above 65535 counts as 65535.
    """
    sums = CellBlocks(keys).sum_round(leaf_keys, np.ascontiguousarray(counts)[:, None], 1.0, num_threads)
    return np.minimum(sums[:, 0], _MOST)
