# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The cells that hold returns, and sums over the returns of each cell."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, CellSet, cell_keys
from radarsdf.returns.rays import Rays

MAX_CELLS_FROM_ORIGIN = 1_000_000
"""Farthest cell along each axis. A Morton key has 21 bits for each axis."""

_AXIS_BITS = 21  # of a key, interleaved with those of the other axes
_QUARTER = np.uint64(
    0b111 << (3 * (_AXIS_BITS - 2))
)  # of the bits of a key: those that say in which quarter of the axes
_COMPACTED = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x001F0000FF0000FF),
    (16, 0x001F00000000FFFF),
    (32, 0x1FFFFF),
)  # how far to shift, and which bits to keep then


def lattice_of(keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Lattice coordinates (N, 3) of the cells with these Morton keys (N,)."""
    coordinates = np.empty((len(keys), 3), np.int64)
    for axis in range(3):
        bits = keys >> np.uint64(axis) & np.uint64(0x1249249249249249)
        for shift, kept in _COMPACTED:
            bits = (bits | bits >> np.uint64(shift)) & np.uint64(kept)
        coordinates[:, axis] = bits.astype(np.int64) - (1 << (_AXIS_BITS - 1))
    return coordinates


def merged_keys(keys: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Morton keys (N,) of the cells twice as large that the cells with these keys (N,) are in. Their order stays."""
    halved = keys >> np.uint64(3)
    # Coordinates count from -2²⁰, of these cells, too: half of that was shifted out.
    quarters = halved & _QUARTER
    merged: NDArray[np.uint64] = (halved ^ _QUARTER) | quarters << np.uint64(3)
    return merged


@dataclass(frozen=True)
class ReturnCells:
    """The cells that hold returns."""

    keys: NDArray[np.uint64]
    """(C,) Morton keys of the cells, ascending."""
    blocks: CellBlocks
    """Finds the row of a cell from its key."""
    cell_of_ray: NDArray[np.int32]
    """(N,) row of each return's cell."""

    @classmethod
    def of(cls, rays: Rays, cell_size_m: float, num_threads: int = 0) -> ReturnCells:
        """The cells of this size, m, that hold returns of `rays`. `num_threads` 0: as many as OpenMP uses."""
        points = np.ascontiguousarray(rays.points)
        occupied = CellSet(cell_size_m)
        occupied.insert(points, num_threads)
        keys = occupied.sorted_keys(num_threads)
        del occupied  # frees memory: it can be as large as everything below
        blocks = CellBlocks(keys)
        rows = blocks.rows(cell_keys(points, cell_size_m, num_threads), num_threads)
        return cls(keys, blocks, rows)

    @cached_property
    def counts(self) -> NDArray[np.float64]:
        """(C,) number of returns in each cell."""
        return np.bincount(self.cell_of_ray, minlength=len(self.keys)).astype(np.float64)
