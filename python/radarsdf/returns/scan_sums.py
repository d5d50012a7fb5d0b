# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Sums over scans: what is kept of the returns in each cell, whatever becomes of the scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import DIRECTION_QUANTA, count_scans, sum_returns
from radarsdf.returns.cells import ReturnCells, lattice_of
from radarsdf.returns.rays import Rays

QUANTA = 1 << 16
"""Quanta in the edge of a leaf cell: 3 µm of 0.2 m, as float32 coordinates have at 50 m. Products of 10⁸ returns have room."""

_COUNT, _POSITION, _PRODUCTS, _DIRECTION, _RANGE = 0, slice(1, 4), slice(4, 10), slice(10, 13), 13


@dataclass(frozen=True)
class ScanSums:
    """Sums over the returns of scans in each cell, in integers.

    What a scan adds depends on nothing but the scan. So a map of all scans at once, one that gets them one after another,
    and one that a scan was taken out of again, have the same sums to the last bit, in any order.
    """

    keys: NDArray[np.uint64]
    """(C,) Morton keys of the cells with returns, ascending."""
    sums: NDArray[np.int64]
    """(C, 14) of 1, x, y, z, xx, xy, xz, yy, yz, zz, the direction (3) of the ray, and its range. Positions are in quanta from
    the corner of the cell, ranges in quanta, directions times ``DIRECTION_QUANTA``."""
    scans: NDArray[np.uint32]
    """(C,) number of different scans with returns."""
    cells_of_edge: int
    """Leaf cells along the edge of a cell."""
    leaf_size_m: float
    """Edge of a leaf cell, m."""

    @classmethod
    def of(
        cls, rays: Rays, cells: ReturnCells, cells_of_edge: int, leaf_size_m: float, num_threads: int = 0
    ) -> ScanSums:
        """Of the returns of `rays` in these `cells`. `num_threads` 0: as many as OpenMP uses."""
        sums = sum_returns(
            np.ascontiguousarray(rays.points),
            np.ascontiguousarray(rays.directions),
            np.ascontiguousarray(rays.ranges_m),
            cells.cell_of_ray,
            _corners(cells.keys, cells_of_edge),
            leaf_size_m / QUANTA,
            num_threads,
        )
        scans = count_scans(cells.cell_of_ray, rays.scans, len(cells.keys), num_threads)
        return cls(cells.keys, sums, scans, cells_of_edge, leaf_size_m)

    def __add__(self, other: ScanSums) -> ScanSums:
        """With other scans, too."""
        return self._with(other, 1)

    def __sub__(self, other: ScanSums) -> ScanSums:
        """Without scans that were added. Cells without returns go."""
        return self._with(other, -1)

    def _with(self, other: ScanSums, sign: int) -> ScanSums:
        if (self.cells_of_edge, self.leaf_size_m) != (other.cells_of_edge, other.leaf_size_m):
            msg = "sums over cells of different sizes cannot be added"
            raise ValueError(msg)
        keys = np.union1d(self.keys, other.keys)
        sums = np.zeros((len(keys), self.sums.shape[1]), np.int64)
        scans = np.zeros(len(keys), np.int64)
        for part, factor in ((self, 1), (other, sign)):
            rows = np.searchsorted(keys, part.keys)
            sums[rows] += factor * part.sums
            scans[rows] += factor * part.scans.astype(np.int64)
        kept = sums[:, _COUNT] != 0
        return ScanSums(
            keys[kept], sums[kept], scans[kept].astype(np.uint32), self.cells_of_edge, self.leaf_size_m
        )

    @property
    def counts(self) -> NDArray[np.float64]:
        """(C,) number of returns in each cell."""
        return self.sums[:, _COUNT].astype(np.float64)

    @property
    def mean_points(self) -> NDArray[np.float64]:
        """(C, 3) mean of the returns in each cell, local, m."""
        quanta = self.sums[:, _POSITION] / self.counts[:, None] + _corners(self.keys, self.cells_of_edge)
        means: NDArray[np.float64] = quanta * (self.leaf_size_m / QUANTA)
        return means

    @property
    def mean_directions(self) -> NDArray[np.float64]:
        """(C, 3) mean direction of the rays, no unit vector."""
        means: NDArray[np.float64] = self.sums[:, _DIRECTION] / (DIRECTION_QUANTA * self.counts[:, None])
        return means

    @property
    def mean_ranges_m(self) -> NDArray[np.float64]:
        """(C,) mean range of the returns, m."""
        means: NDArray[np.float64] = self.sums[:, _RANGE] * (self.leaf_size_m / QUANTA) / self.counts
        return means

    @property
    def moments(self) -> NDArray[np.float64]:
        """(C, 13) sums over the returns of each cell: of 1, of x, y, z, local, m, of xx, xy, xz, yy, yz, zz, m², and of the direction (3)."""
        quantum_m = self.leaf_size_m / QUANTA
        found = np.empty((len(self.keys), _RANGE))
        count = found[:, _COUNT] = self.counts
        corners_m = _corners(self.keys, self.cells_of_edge) * quantum_m
        inner_m = self.sums[:, _POSITION] * quantum_m
        found[:, _POSITION] = inner_m + count[:, None] * corners_m
        upper = [(i, j) for i in range(3) for j in range(i, 3)]
        for k, (i, j) in enumerate(upper, _PRODUCTS.start):
            # Σ (a + x)(b + y) of the corner (a, b) is Σ xy + a Σ y + b Σ x + n a b.
            a, b = corners_m[:, i], corners_m[:, j]
            products = self.sums[:, k] * quantum_m**2
            found[:, k] = products + a * inner_m[:, j] + b * found[:, 1 + i]
        found[:, _DIRECTION] = self.sums[:, _DIRECTION] / DIRECTION_QUANTA
        return found


def _corners(keys: NDArray[np.uint64], cells_of_edge: int) -> NDArray[np.int64]:
    """(C, 3) lower corners of cells, quanta."""
    return lattice_of(keys) * (QUANTA * cells_of_edge)
