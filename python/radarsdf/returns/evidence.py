"""Evidence of a surface in each leaf cell, and the leaf cells that bridge gaps."""

from dataclasses import dataclass, replace

import numpy as np

from radarsdf.arrays import Bools, Counts32, Floats, Floats32, Keys
from radarsdf.config.fit_config import LATTICE_BLOCK_CELLS
from radarsdf.config.groups import ReturnsConfig
from radarsdf.core import CellBlocks, block_medians, bridge_cells, count_scans, count_visibility
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import WEIGHT_UNIT, MeanRays, ReturnCells, merged_keys

CELLS_OF_SURFACE = 9
"""Approximate number of cells that a plane crosses in a 3 × 3 × 3 neighbourhood."""

BLOCK_BITS = np.uint64(9)
"""Bits of a leaf cell's Morton key below those of its visibility block (8 × 8 × 8 leaf cells)."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of a surface in each leaf cell, by key. `information` and `hits` are sums over it and its 26 neighbours."""

    information: Floats32  # (C,) 1 / variance of the position estimated from all returns, m⁻²
    # (C,) number of scans with returns, summed over the cells. Several returns of a scan in a cell count once there, because
    # their errors are correlated.
    hits: Counts32
    # (C,) number of scans with a ray through or into the block of 8 × 8 × 8 leaf cells that contains the cell
    visibility: Counts32

    @classmethod
    def of(
        cls,
        returns: "ReturnsOfCells",
        rays: Rays,
        leaf_keys: Keys,
        leaf_size_m: float,
        num_threads: int = 0,
        visibility: "VisibilityCounts | None" = None,
    ) -> "Evidence":
        """Compute evidence for leaf cells with ascending keys (C,). `rays` include those of ghosts, which count for visibility."""
        near = CellBlocks(leaf_keys).rows(returns.keys, num_threads) >= 0
        information, hits = evidence_sums(returns.select(near), leaf_keys, num_threads)
        if visibility is not None:
            return cls(information, hits, visibility.at(leaf_keys))
        rays_seen = rays.points, rays.directions, rays.ranges_m, rays.scans
        return cls(information, hits, count_visibility(leaf_keys, leaf_size_m, *rays_seen, num_threads))

    def columns(self, leaf_keys: Keys, num_threads: int = 0) -> Floats32:
        """Return information, hits, visibility and :func:`usual_information` of each leaf cell, (C, 4)."""
        usual = usual_information(self.information, leaf_keys, num_threads)
        return np.stack([self.information, self.hits, self.visibility, usual], 1, dtype=np.float32)


@dataclass(frozen=True)
class ReturnsOfCells:
    """Information, number of scans and number of returns of each leaf cell, in the order of the keys."""

    keys: Keys  # (M,) Morton keys of the leaf cells with returns, ascending
    information: Floats32  # (M,) 1 / variance of the position estimated from its returns, m⁻²
    scans: Counts32  # (M,) number of different scans with returns
    counts: Floats  # (M,) number of returns

    @classmethod
    def of_rays(
        cls, rays: Rays, noise: SensorNoise, leaf_size_m: float, config: ReturnsConfig, num_threads: int
    ) -> "ReturnsOfCells":
        """Sum over all returns in each leaf cell."""
        cells = ReturnCells.of(rays, leaf_size_m, num_threads)
        parts = noise.weights(rays)
        weights = np.float32(1) if parts is None else (parts / WEIGHT_UNIT).astype(np.float32)
        of_rays = weights / noise.variances_m2(rays.ranges_m)
        information = np.bincount(cells.cell_of_ray, of_rays, len(cells.keys)).astype(np.float32)
        scans = count_scans(cells.cell_of_ray, rays.scans, len(cells.keys), num_threads)
        ranges_m = np.bincount(cells.cell_of_ray, rays.ranges_m, len(cells.keys)) / cells.counts
        found = cls(cells.keys, information, scans, cells.counts)
        return found.with_uncertain_poses(ranges_m.astype(np.float32), config)

    @classmethod
    def of_means(cls, means: MeanRays, noise: SensorNoise, config: ReturnsConfig) -> "ReturnsOfCells":
        """Weigh the mean ray of each leaf cell, whose returns have nearly the same range if seen from the same position."""
        information = means.counts / noise.variances_m2(means.ranges_m)
        found = cls(means.keys, information, means.scans, means.counts.astype(np.float64))
        return found.with_uncertain_poses(means.ranges_m, config)

    def select(self, part: Bools) -> "ReturnsOfCells":
        return ReturnsOfCells(*(column[part] for column in vars(self).values()))

    def with_uncertain_poses(self, ranges_m: Floats32, config: ReturnsConfig) -> "ReturnsOfCells":
        """Include the pose uncertainty of `config`. `ranges_m` (M,): mean range of the returns in each cell, m."""
        if config.pose_sigma_m == 0 and config.pose_sigma_rad == 0:
            return self
        # All returns of a scan share its pose error, so its variance is divided by the number of scans only. The evidence
        # sums 27 cells, of which a surface crosses nine: each gets nine times this variance, to keep the sum correct.
        pose_m2 = config.pose_sigma_m**2 + np.square(np.float32(config.pose_sigma_rad) * ranges_m)
        variances_m2 = 1 / self.information + CELLS_OF_SURFACE * pose_m2 / self.scans
        return replace(self, information=(1 / variances_m2).astype(np.float32))


@dataclass(frozen=True)
class VisibilityCounts:
    """Number of scans whose rays reach each block of 8 × 8 × 8 leaf cells."""

    keys: Keys  # (B,) Morton keys of leaf cells without their last nine bits, ascending
    scans: Counts32  # (B,) number of scans with a ray through or into each block

    def at(self, leaf_keys: Keys) -> Counts32:
        """Return the counts (C,) of the blocks that contain leaf cells with ascending Morton keys (C,)."""
        rows = CellBlocks(self.keys).rows(leaf_keys >> BLOCK_BITS)
        return np.append(self.scans, np.uint32(0))[rows]  # the last entry serves row -1, no block


def evidence_sums(returns: ReturnsOfCells, leaf_keys: Keys, num_threads: int) -> tuple[Floats32, Counts32]:
    """Compute `information` and `hits` of :class:`Evidence`, (C,) each, for leaf cells with ascending keys (C,)."""
    blocks = CellBlocks(returns.keys)
    columns = np.stack([returns.information, returns.scans], 1).astype(np.float64)
    information, hits = np.empty(len(leaf_keys), np.float32), np.empty(len(leaf_keys), np.uint32)
    for first in range(0, len(leaf_keys), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        information[part], hits[part] = blocks.neighbour_sums(leaf_keys[part], columns, 1.0, num_threads).T
    return information, hits


def usual_information(information: Floats32, leaf_keys: Keys, num_threads: int = 0) -> Floats32:
    """Return the mean `information` (C,) of cells within two to four cells of each, weighted by itself: that of most returns."""
    pairs = merged_keys(leaf_keys)
    begins = np.concatenate([[True], pairs[1:] != pairs[:-1]])[: len(pairs)]
    first, weights = np.flatnonzero(begins), information.astype(np.float64)
    sums = np.add.reduceat(np.stack([weights, weights**2], axis=1), first) if len(first) else np.zeros((0, 2))
    near = CellBlocks(pairs[first]).neighbour_sums(pairs[first], sums, 1.0, num_threads)
    return (near[:, 1] / np.maximum(near[:, 0], 1e-30)).astype(np.float32).take(np.cumsum(begins) - 1)


_AT_ONCE = 1 << 20  # leaf cells: float64 sums of all would be the peak of a large fit's memory

# Measured on simulated and real scans. The support of a leaf cell is the number of returns in it and its 26 neighbours.
# Relative to the median support of the block. Cells with less are too often false to indicate that a surface continues.
_MIN_SUPPORT = 0.5
# Largest mean support of the two ends of a bridge. A surface crosses about nine of the 27 cells. If each of
# these has at least one return, an empty cell is most likely a real gap.
_MAX_SUPPORT = 9.0


def bridged(leaf_keys: Keys, keys: Keys, counts: Floats, max_cells: int, num_threads: int = 0) -> Keys:
    """Add gaps of at most `max_cells` between two cells with returns, along 13 directions, to ascending `leaf_keys` (C,).

    `counts` (M,): number of returns in the cells with ascending `keys` (M,).
    """
    if max_cells == 0:
        return leaf_keys
    rows = CellBlocks(leaf_keys).rows(keys, num_threads)
    near = rows >= 0
    keys, counts, rows = keys[near], counts[near], rows[near]
    of_leaves = CellBlocks(keys).neighbour_sums(leaf_keys, counts[:, None], 1.0, num_threads)[:, 0]
    # Per block, not over the map: the cells added must not depend on the number of returns elsewhere.
    levels = LATTICE_BLOCK_CELLS.bit_length() - 1
    medians = block_medians(leaf_keys, of_leaves, levels, num_threads)[rows]
    least = np.maximum(1.0, _MIN_SUPPORT * medians)
    support = of_leaves[rows]
    # An end with more support than this exceeds the limit with any other end.
    used = (support >= least) & (support + least < 2 * _MAX_SUPPORT)
    return bridge_cells(leaf_keys, keys[used], support[used], max_cells, 2 * _MAX_SUPPORT, num_threads)
