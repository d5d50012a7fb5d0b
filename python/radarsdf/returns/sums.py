"""Integer sums over the returns of each leaf cell, and mean rays computed from them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from radarsdf.arrays import Bools, Counts32, Floats, Floats32, Ints, Ints32, Keys
from radarsdf.core import CellBlocks, CellSet, cell_keys, count_scans, mean_rays, merge_sums, sum_returns
from radarsdf.returns.rays import Rays

MAX_CELLS_FROM_ORIGIN = 1_000_000
"""Farthest cell along each axis. A Morton key has 21 bits for each axis."""

WEIGHT_UNIT = 64
"""Parts of a weight of 1. Sums of integers do not depend on their order; a power of two divides them exactly."""
_AXIS_BITS = 21  # bits of a key for each axis, interleaved
_QUARTER = np.uint64(0b111 << (3 * (_AXIS_BITS - 2)))  # second highest bit of each axis
_COMPACTED = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x001F0000FF0000FF),
    (16, 0x001F00000000FFFF),
    (32, 0x1FFFFF),
)  # steps of the Morton decoding: shift, and mask of the bits kept


def lattice_of(keys: Keys) -> Ints:
    """Decode Morton keys (N,) to lattice coordinates (N, 3)."""
    coordinates = np.empty((len(keys), 3), np.int64)
    for axis in range(3):
        bits = keys >> np.uint64(axis) & np.uint64(0x1249249249249249)
        for shift, kept in _COMPACTED:
            bits = (bits | bits >> np.uint64(shift)) & np.uint64(kept)
        coordinates[:, axis] = bits.astype(np.int64) - (1 << (_AXIS_BITS - 1))
    return coordinates


def merged_keys(keys: Keys) -> Keys:
    """Return the Morton keys (N,) of the parent cells, twice as large, of cells with keys (N,), in the same order."""
    halved = keys >> np.uint64(3)
    # Coordinates of the parents have the offset 2²⁰ too; the shift halved it.
    quarters = halved & _QUARTER
    return (halved ^ _QUARTER) | quarters << np.uint64(3)


@dataclass(frozen=True)
class ReturnCells:
    keys: Keys  # (C,) Morton keys of the cells, ascending
    blocks: CellBlocks  # lookup of the row of a cell by its key
    cell_of_ray: Ints32  # (N,) row of each return's cell

    @classmethod
    def of(cls, rays: Rays, cell_size_m: float, num_threads: int = 0) -> "ReturnCells":
        occupied = CellSet(cell_size_m)
        occupied.insert(rays.points, num_threads)
        keys = occupied.sorted_keys(num_threads)
        del occupied  # frees memory: it can be as large as everything below
        blocks = CellBlocks(keys)
        rows = blocks.rows(cell_keys(rays.points, cell_size_m, num_threads), num_threads)
        return cls(keys, blocks, rows)

    @cached_property
    def counts(self) -> Floats:
        return np.bincount(self.cell_of_ray, minlength=len(self.keys)).astype(np.float64)


UPPER = [(i, j) for i in range(3) for j in range(i, 3)]
"""Axes of the upper-triangular products of coordinates, in order."""


@dataclass(frozen=True)
class ScanSums:
    """Integer sums over the returns of scans in each leaf cell.

    The contribution of a scan depends on the scan alone. So sums are bit-identical whether scans are added at once, one after
    another in any order, or removed again.
    """

    leaf_size_m: float  # edge of a leaf cell, m
    keys: Keys  # (C,) Morton keys of the leaf cells with returns, ascending
    # (C, 14) sums of 1, x, y, z, xx, xy, xz, yy, yz, zz, the direction (3) of the ray, and its range. Positions are in quanta
    # from the corner of the cell, ranges in quanta, directions times DIRECTION_QUANTA.
    sums: Ints
    scans: Counts32  # (C,) number of different scans with returns
    unit: int = 1  # weight of a mean return in the sums

    @classmethod
    def of(
        cls,
        rays: Rays,
        leaf_size_m: float,
        num_threads: int = 0,
        cells: ReturnCells | None = None,
        weights: Ints32 | None = None,
    ) -> "ScanSums":
        """Sum up `rays` by their `cells`. `weights` (N,): of each return, in parts of 1 / `WEIGHT_UNIT`; None: all are 1."""
        cells = cells or ReturnCells.of(rays, leaf_size_m, num_threads)
        of_rays = rays.points, rays.directions, rays.ranges_m, cells.cell_of_ray
        sums = sum_returns(*of_rays, cells.keys, leaf_size_m, num_threads, weights)
        scans = count_scans(cells.cell_of_ray, rays.scans, len(cells.keys), num_threads)
        return cls(leaf_size_m, cells.keys, sums, scans, 1 if weights is None else WEIGHT_UNIT)

    @property
    def counts(self) -> Floats:
        """(C,) sum of the weights of the returns: without weights, their number."""
        return self.sums[:, 0] / float(self.unit)

    def merged_moments(self) -> tuple[Keys, Floats]:
        """Return the keys (P,), ascending, of the cells twice as large, and sums (P, 13) over their returns.

        The sums are those of 1; x, y, z, local, m; xx, xy, xz, yy, yz, zz, m²; and the direction (3).
        """
        keys, moments = merge_sums(self.keys, self.sums, self.leaf_size_m)
        return keys, moments if self.unit == 1 else moments / self.unit


@dataclass(frozen=True)
class MeanRays:
    """Mean ray of each cell. Measured: averaging them is as good as averaging all rays, two to three times as many."""

    keys: Keys  # (M,) Morton keys of the cells, ascending
    points: Floats32  # (M, 3) mean of the returns in each cell, local, m
    directions: Floats32  # (M, 3) unit vectors of their mean direction; downwards if it is zero
    counts: Floats32  # (M,) number of returns in each cell
    scans: Counts32  # (M,) number of different scans with returns in each cell
    ranges_m: Floats32  # (M,) mean range of the returns in each cell, m

    @classmethod
    def of_sums(cls, sums: ScanSums, num_threads: int = 0) -> "MeanRays":
        points, directions, ranges_m, counts = mean_rays(sums.keys, sums.sums, sums.leaf_size_m, num_threads)
        return cls(sums.keys, points, directions, counts / np.float32(sums.unit), sums.scans, ranges_m)

    def select(self, part: Bools | Ints) -> "MeanRays":
        rows = np.flatnonzero(part) if part.dtype == np.bool_ else part
        return MeanRays(**{name: column.take(rows, axis=0) for name, column in vars(self).items()})

    def leaf_keys(self, leaf_size_m: float, reach_m: float, num_threads: int = 0) -> Keys:
        """Return ascending Morton keys (C,) of the leaf cells that rays cross within `reach_m` of their returns."""
        cells = CellSet(leaf_size_m)
        cells.insert_rays(self.points, self.directions, reach_m, num_threads)
        return cells.sorted_keys(num_threads)
