# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mean ray of the returns in each cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellSet, count_scans
from radarsdf.returns.cells import ReturnCells
from radarsdf.returns.rays import Rays

_MIN_LENGTH = 1e-3  # of the sum of unit directions. A shorter sum has no meaningful direction


@dataclass(frozen=True)
class MeanRays:
    """The mean ray of each cell.

    Measured: as a start of the training, the average over mean rays is as good as over all rays, of which
    there are two to three times as many.
    """

    keys: NDArray[np.uint64]
    """(M,) Morton keys of the cells, ascending."""
    first: NDArray[np.int64]
    """(M,) row of the first return in each cell."""
    points: NDArray[np.float32]
    """(M, 3) mean of the returns in each cell, local, m."""
    directions: NDArray[np.float32]
    """(M, 3) mean direction of their rays, unit vectors."""
    counts: NDArray[np.float32]
    """(M,) number of returns in each cell."""
    scans: NDArray[np.uint32]
    """(M,) number of different scans that they are of."""
    ranges_m: NDArray[np.float32]
    """(M,) range of the first return in each cell."""

    @classmethod
    def of(cls, rays: Rays, cells: ReturnCells, num_threads: int = 0) -> MeanRays:
        """The mean rays of the `cells` that hold the returns of `rays`. `num_threads` 0: as many as OpenMP uses."""
        rows, moments = cells.cell_of_ray, cells.moments(rays, num_threads)
        first = np.zeros(len(cells.keys), np.int64)
        first[rows[::-1]] = np.arange(
            len(rows) - 1, -1, -1
        )  # backwards: NumPy assigns in order, so the first return of a cell is written last and stays
        lengths = np.linalg.norm(moments[:, 10:], axis=1)[:, None]
        directions = np.where(
            lengths > _MIN_LENGTH,
            moments[:, 10:] / np.maximum(lengths, _MIN_LENGTH),
            rays.directions[first],  # without a mean direction, that of the first ray
        )
        return cls(
            keys=cells.keys,
            first=first,
            points=(moments[:, 1:4] / moments[:, :1]).astype(np.float32),
            directions=directions.astype(np.float32),
            counts=moments[:, 0].astype(np.float32),
            scans=count_scans(rows, rays.scans, len(cells.keys), num_threads),
            ranges_m=rays.ranges_m[first],
        )

    def select(self, part: NDArray[np.bool_]) -> MeanRays:
        """The mean rays of some of the cells."""
        return MeanRays(
            self.keys[part],
            self.first[part],
            self.points[part],
            self.directions[part],
            self.counts[part],
            self.scans[part],
            self.ranges_m[part],
        )

    def leaf_keys(self, leaf_size_m: float, reach_m: float, num_threads: int = 0) -> NDArray[np.uint64]:
        """(C,) uint64, ascending Morton keys of the leaf cells that rays cross within `reach_m` of their returns."""
        cells = CellSet(leaf_size_m)
        cells.insert_rays(self.points, self.directions, reach_m, num_threads)
        return cells.sorted_keys(num_threads)
