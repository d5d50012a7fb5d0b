# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mean ray of the returns in each cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellSet
from radarsdf.returns.scan_sums import ScanSums

_MIN_LENGTH = 1e-6  # of the mean of unit directions. A shorter one has no meaningful direction


@dataclass(frozen=True)
class MeanRays:
    """The mean ray of each cell.

    Measured: as a start of the training, the average over mean rays is as good as over all rays, of which
    there are two to three times as many.
    """

    keys: NDArray[np.uint64]
    """(M,) Morton keys of the cells, ascending."""
    points: NDArray[np.float32]
    """(M, 3) mean of the returns in each cell, local, m."""
    directions: NDArray[np.float32]
    """(M, 3) mean direction of their rays, unit vectors. Downwards where rays from opposite sides leave none."""
    counts: NDArray[np.float32]
    """(M,) number of returns in each cell."""
    scans: NDArray[np.uint32]
    """(M,) number of different scans that they are of."""
    ranges_m: NDArray[np.float32]
    """(M,) mean range of the returns in each cell, m."""

    @classmethod
    def of_sums(cls, sums: ScanSums) -> MeanRays:
        """The mean rays of scans that are known by their `sums`."""
        directions = sums.mean_directions
        lengths = np.linalg.norm(directions, axis=1)[:, None]
        directions = np.where(
            lengths > _MIN_LENGTH, directions / np.maximum(lengths, _MIN_LENGTH), [0.0, 0.0, -1.0]
        )
        return cls(
            keys=sums.keys,
            points=sums.mean_points.astype(np.float32),
            directions=directions.astype(np.float32),
            counts=sums.counts.astype(np.float32),
            scans=sums.scans,
            ranges_m=sums.mean_ranges_m.astype(np.float32),
        )

    def select(self, part: NDArray[np.bool_] | NDArray[np.int64]) -> MeanRays:
        """The mean rays of some of the cells: a mask (M,) bool, or row numbers."""
        return MeanRays(
            self.keys[part],
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
