"""Surfels: planes fitted to the returns of a cell and its neighbourhood."""

from dataclasses import dataclass

import numpy as np

from radarsdf.arrays import Array, Bools, Floats, Floats32, Ints, Ints32, Keys
from radarsdf.core import CellBlocks, cell_keys, principal_axes
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import UPPER, ScanSums, merged_keys

# Measured by the F-score of returns moved onto surfels: flatness 0.25 and 0.8 are 0.0 to 0.7 points worse; cells of 0.3 and
# 0.5 m find 87 and 92 % of the ghosts of `hugin`, but 0.5 m only 77 % of those of `oculii`.
LEAVES_PER_SURFEL = 2  # leaf cells along the edge of a surfel's cell: 0.4 m with leaf cells of 0.2 m
# Weight of a neighbour that shares a face; its square for one that shares an edge, its cube for a corner.
NEIGHBOUR_WEIGHT = 0.7
MAX_FLATNESS = 0.5  # largest ratio of the smallest to the middle variance of a flat surfel
MIN_SUPPORT = 12.0  # minimum weighted number of returns in the 27 cells of a surfel
_PLANES_AT_ONCE = 1 << 14  # their moments and axes stay in the cache


@dataclass(frozen=True)
class Surfels:
    """Cells twice as large as leaf cells, with a surfel where the neighbourhood has enough returns."""

    cell_size_m: float  # edge of a cell, m
    keys: Keys  # (C,) Morton keys of the cells that hold returns, ascending
    blocks: CellBlocks  # finds the row of a cell from its key
    counts: Floats  # (C,) number of returns in each cell
    support: Floats  # (C,) weighted number of returns in a cell and its 26 neighbours
    cell_of_plane: Ints  # (P,) row of the cell of each surfel, ascending
    centres: Floats  # (P, 3) weighted mean of the returns, local, m
    normals: Floats  # (P, 3) unit vectors towards the sensors
    variances: Floats  # (P, 3) variances of the returns along the principal axes, ascending, m²
    widest: Floats32 | None = None  # (P, 3) axes of the largest variance, unit vectors, in a batch

    @classmethod
    def of(
        cls, rays: Rays, leaf_size_m: float, num_threads: int = 0, weights: Ints32 | None = None
    ) -> "Surfels":
        return cls.of_sums(ScanSums.of(rays, leaf_size_m, num_threads, weights=weights), num_threads)

    @classmethod
    def of_sums(cls, sums: ScanSums, num_threads: int = 0) -> "Surfels":
        cell_size_m = LEAVES_PER_SURFEL * sums.leaf_size_m
        keys, of_cells = sums.merged_moments()
        blocks = CellBlocks(keys)
        support, *planes = neighbour_planes(blocks, keys, of_cells, cell_size_m, num_threads)
        return cls(cell_size_m, keys, blocks, of_cells[:, 0].copy(), support, *planes)

    def is_flat(self) -> Bools:
        return self.variances[:, 0] < MAX_FLATNESS * self.variances[:, 1]

    def clutter_ratio(self) -> float:
        """Return the share of the returns in cells with a surfel whose surfel is not flat. 0 without surfels."""
        returns = self.counts[self.cell_of_plane]
        total = float(returns.sum())
        return 1 - float(returns[self.is_flat()].sum()) / total if total else 0.0

    def returns_per_cell(self) -> float:
        """Return the mean number of returns per cell, to which false returns are proportional. 0 without cells."""
        return float(self.counts.sum()) / len(self.keys) if len(self.keys) else 0.0

    def cells_at(self, points: Floats32, num_threads: int = 0) -> Ints32:
        """Return the row (N,) of the cell of each of the `points` (N, 3), local, m; -1 for a cell without returns."""
        return self.blocks.rows(cell_keys(points, self.cell_size_m, num_threads), num_threads)

    def cells_of_leaves(self, leaf_keys: Keys, num_threads: int = 0) -> Ints32:
        """Return the row (M,) of the cell that contains each leaf cell with Morton keys (M,); -1 without returns."""
        return self.blocks.rows(merged_keys(leaf_keys), num_threads)

    def flat_planes_at(self, points: Floats32, num_threads: int = 0) -> Ints32:
        """Return the row (N,) of the flat surfel in the cell of each of the `points` (N, 3), local, m; -1 without one."""
        return self.flat_planes_of(self.cells_at(points, num_threads))

    def flat_planes_of(self, cells: Ints32) -> Ints32:
        """Return the row (N,) of the flat surfel of each of the `cells` (N,), -1 for none; -1 without one."""
        flat = np.flatnonzero(self.is_flat())
        planes = np.full(len(self.keys) + 1, -1, np.int32)  # the last entry serves row -1, no cell
        planes[self.cell_of_plane[flat]] = flat
        return planes[cells]


def neighbour_planes(
    blocks: CellBlocks, keys: Keys, of_cells: Floats, cell_size_m: float, num_threads: int = 0
) -> tuple[Array, ...]:
    """Fit planes to the neighbourhoods of `keys` (K,). `of_cells`: moments by cell of `blocks`.

    Returns their support (K,), and `cell_of_plane`, `centres`, `normals`, `variances` and `widest` of :class:`Surfels`.
    """
    counts = np.ascontiguousarray(of_cells[:, :1])
    support = blocks.neighbour_sums(keys, counts, NEIGHBOUR_WEIGHT, num_threads)[:, 0]
    # Most cells have few returns: surfels for all of them would dominate time and memory.
    cell_of_plane = np.flatnonzero(support >= MIN_SUPPORT)
    centres, normals, variances = (np.empty((len(cell_of_plane), 3)) for _ in range(3))
    widest = np.empty((len(cell_of_plane), 3), np.float32)
    for first in range(0, len(cell_of_plane), _PLANES_AT_ONCE):
        part = slice(first, first + _PLANES_AT_ONCE)
        moments = blocks.neighbour_sums(keys[cell_of_plane[part]], of_cells, NEIGHBOUR_WEIGHT, num_threads)
        means = moments[:, 1:10] / moments[:, :1]
        centre = centres[part] = means[:, :3]
        covariance = np.empty((len(means), 3, 3))  # all nine numbers are written below
        for mean, (i, j) in zip(means[:, 3:].T, UPPER, strict=True):
            covariance[:, i, j] = covariance[:, j, i] = mean - centre[:, i] * centre[:, j]
        variances[part], axes = principal_axes(covariance, num_threads)
        away = np.einsum("ni,ni->n", axes[:, :, 0], moments[:, 10:]) > 0
        normals[part] = np.where(away, -1.0, 1.0)[:, None] * axes[:, :, 0]
        widest[part] = axes[:, :, 2]
    # The lower bound is the resolution of float32 coordinates.
    variances = np.maximum(variances, (0.0025 * cell_size_m) ** 2)
    return support, cell_of_plane, centres, normals, variances, widest
