# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface of a map that grows: what a quick fit makes of sums, made anew only where they changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.average import normals_at
from radarsdf.live.distances import GrowingDistances
from radarsdf.live.ghosts import NOWHERE, GrowingGhosts, means_of, surfels_of
from radarsdf.live.regions import RegionTable, Rows, regions_of, regions_round
from radarsdf.live.rows import ROUND, Keys, Replacement, between, changed_rows, leaves_of, shifted
from radarsdf.live.triangles import GrowingTriangles, Triangles
from radarsdf.returns.evidence import BLOCK_BITS, Looks
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, MIN_SUPPORT, planes_round, support_round
from radarsdf.returns.sums import MeanRays, ScanSums, merged_keys

_NONE = np.zeros(0, np.uint64)
_PLANE = 9  # numbers of a surfel: centre, normal, variances


@dataclass(frozen=True)
class ChangedSums:
    """What became of the sums since the surface was derived last. Of a block, all is told anew."""

    returns: Keys
    """(B,) keys of the blocks whose sums changed, ascending."""
    sums: ScanSums
    """Of the cells of these blocks."""
    look_blocks: Keys
    """(L,) keys of the blocks whose looks changed, ascending."""
    looks: Looks
    """Of those of them that anything looked at."""


class GrowingSurface:
    """What follows from sums over scans. :meth:`update` makes anew what depends on changes, and asks for nothing far from them.

    All is a function of the sums, the looks and the noise: however they came about, it has the same bits. One thread at a
    time.

    Parameters
    ----------
    config : FitConfig
        Of a quick fit.
    origin : ndarray
        (3,) of the local frame, world, m.
    """

    def __init__(self, config: FitConfig, origin: NDArray[np.float64]) -> None:
        self._config = config
        self._noise: SensorNoise | None = None
        vectors, numbers = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        # Of leaf cells with returns: sums, mean rays, normals, and the key of the first plane that the ray crosses.
        self._leaves = RegionTable(
            sums=np.zeros((0, 14), np.int64),
            scans=np.zeros(0, np.uint32),
            points=vectors,
            directions=vectors,
            counts=numbers,
            ranges_m=numbers,
            normals=vectors,
            first=_NONE,
        )
        # Of cells of surfels. Planes are NaN without support.
        self._cells = RegionTable(
            LEAVES_PER_SURFEL,
            moments=np.zeros((0, 13)),
            support=np.zeros(0),
            planes=np.zeros((0, _PLANE)),
            passed=np.zeros(0),
            opaque=np.zeros(0, bool),
            behind=np.zeros(0),
            ghosts=np.zeros(0, bool),
        )
        self._ghosts = GrowingGhosts(self._leaves, self._cells, config.leaf_size_m)
        # Of each region: returns in cells with planes, in those with flat ones, and in all, and the number of these.
        self._counts: dict[int, tuple[float, float, float, int]] = {}
        self._distances = GrowingDistances(config)
        # Of blocks, by the keys of their first leaf cells.
        self._looks = RegionTable(scans=np.zeros(0, np.uint32))
        self._triangles = GrowingTriangles(config, origin)

    @property
    def num_bytes(self) -> int:
        """Memory of what is kept, bytes."""
        tables = (self._leaves, self._cells, self._distances, self._looks, self._triangles)
        return sum(table.num_bytes for table in tables)

    @property
    def num_bytes_of_cell(self) -> float:
        """Likewise, for each leaf cell with returns."""
        return self.num_bytes / max(self._leaves.num_rows, 1)

    @property
    def num_leaves(self) -> int:
        """Number of leaf cells near the surface."""
        return self._distances.table.num_rows

    def update(self, changes: ChangedSums, noise: SensorNoise, num_threads: int) -> Keys:
        """Takes changes in. Gives the keys (D,) of the blocks of the surface that were made anew, ascending."""
        looked = self._take_looks(changes)
        changed = self._take_sums(changes)
        of_rays, dirty = regions_of(changed), _NONE
        if noise != self._noise:  # ghosts and evidence depend on it everywhere
            self._noise, of_rays = noise, np.union1d(of_rays, self._leaves.regions)
            dirty = np.unique(self._leaves.gather(of_rays)["keys"] >> BLOCK_BITS)
        redone = _NONE
        if len(of_rays):
            of_planes = np.union1d(of_rays, self._fit_planes(changed, num_threads))
            changed = self._count_otherwise(of_rays, of_planes, changed, num_threads)
            reached = np.union1d(dirty, self._distances.blocks_reached(changed))
            redone = self._distances.update(reached, self._leaves, self._cells, noise, num_threads)
        stale = np.union1d(looked, regions_of(redone << BLOCK_BITS))
        self._triangles.cut(regions_round(stale, 1), self._distances.table, self._looks, num_threads)
        return redone

    def triangles(self) -> Triangles:
        """All triangles, and what the returns tell of their vertices."""
        none = (0.0, 0.0, 0.0, 0)
        on_planes, on_flat, returns, cells = map(sum, zip(none, *self._counts.values(), strict=True))
        rough_share = 1 - on_flat / on_planes if on_planes else 0.0
        return self._triangles.joined(rough_share, returns / max(cells, 1), self.num_leaves)

    def _take_sums(self, changes: ChangedSums) -> Keys:
        """The keys of the leaf cells whose sums changed, and of all that now hold returns in their blocks."""
        regions = regions_of(changes.returns << BLOCK_BITS)
        first, last = leaves_of(changes.returns)
        before, after = self._leaves.gather(regions), changes.sums
        there = between(before["keys"], first, last)
        changed = changed_rows(
            before["keys"][there],
            (before["sums"][there], before["scans"][there]),
            after.keys,
            (after.sums, after.scans),
        )
        if len(changed) == 0:
            return changed
        means = MeanRays.of_sums(after)
        new: Rows = vars(means) | {
            "sums": after.sums,
            "normals": np.full((len(after.keys), 3), np.nan, np.float32),
            "first": np.full(len(after.keys), NOWHERE),
        }
        self._leaves.put(regions, Replacement.of(before["keys"], after.keys, first, last).rows(before, new))
        self._take_moments(regions, merged_keys(first), merged_keys(last), after)
        # Normals and planes of whole blocks are gone now, so all of their cells are to be made.
        return np.union1d(changed, after.keys)

    def _take_moments(self, regions: Keys, first: Keys, last: Keys, sums: ScanSums) -> None:
        """The cells of surfels from each of `first` (B,) to each of `last` (B,), in these regions, become those of the sums.

        What follows from moments is not made yet. How many rays pass a plane first is kept: :class:`GrowingGhosts` changes
        it by the rays that it asks again, and does not count the others anew.
        """
        before = self._cells.gather(regions)
        keys, moments = sums.merged_moments()
        passed = np.zeros(len(keys))
        _, kept, old = np.intersect1d(keys, before["keys"], assume_unique=True, return_indices=True)
        passed[kept] = before["passed"][old]
        new = {
            "keys": keys,
            "moments": moments,
            "support": np.zeros(len(keys)),
            "planes": np.full((len(keys), _PLANE), np.nan),
            "passed": passed,
            "opaque": np.zeros(len(keys), bool),
            "behind": np.zeros(len(keys)),
            "ghosts": np.zeros(len(keys), bool),
        }
        self._cells.put(regions, Replacement.of(before["keys"], keys, first, last).rows(before, new))

    def _take_looks(self, changes: ChangedSums) -> Keys:
        """The regions whose looks changed."""
        blocks, new = changes.look_blocks, changes.looks
        regions = regions_of(blocks << BLOCK_BITS)
        before = self._looks.gather(regions)
        rows = Replacement.of(
            before["keys"], new.keys << BLOCK_BITS, blocks << BLOCK_BITS, blocks << BLOCK_BITS
        )
        self._looks.put(regions, rows.rows(before, {"keys": new.keys << BLOCK_BITS, "scans": new.scans}))
        return regions

    def _fit_planes(self, changed: Keys, num_threads: int) -> Keys:
        """Surfels of the cells round changed ones. Gives the regions of these, ascending."""
        near = shifted(np.unique(merged_keys(changed)), ROUND)
        regions = np.unique(self._cells.regions_of(near))
        cells = self._cells.gather(regions_round(regions, 1))
        keys, moments, blocks = cells["keys"], cells["moments"], CellBlocks(cells["keys"])
        rows = blocks.rows(near, num_threads)
        rows = rows[rows >= 0]
        cells["support"][rows] = support_round(blocks, keys[rows], moments, num_threads)
        cells["planes"][rows] = np.nan
        rows = rows[cells["support"][rows] >= MIN_SUPPORT]
        centres, normals, _, variances = planes_round(
            blocks, keys[rows], moments, LEAVES_PER_SURFEL * self._config.leaf_size_m, num_threads
        )
        cells["planes"][rows] = np.concatenate([centres, normals, variances], axis=1)
        own = np.isin(self._cells.regions_of(keys), regions)
        self._cells.put(regions, {name: column[own] for name, column in cells.items()})
        for region in regions:
            surfels = surfels_of(self._cells.gather(region[None]), self._config.leaf_size_m)
            returns = surfels.counts[surfels.cell_of_plane]
            self._counts[int(region)] = (
                float(returns.sum()),
                float(returns[surfels.is_flat()].sum()),
                float(surfels.counts.sum()),
                len(surfels.keys),
            )
        return regions

    def _count_otherwise(self, of_rays: Keys, of_planes: Keys, changed: Keys, num_threads: int) -> Keys:
        """Keys of the leaf cells whose returns count otherwise than before.

        These are the `changed` ones; those that became ghosts, or are none any more; and those whose planes turned.
        `of_rays`, `of_planes`: regions in which mean rays and planes changed, ascending.
        """
        assert self._noise is not None
        if self._config.returns.drop_ghosts:
            ghosts = self._ghosts.update(of_rays, of_planes, self._noise, num_threads)
            near_ghosts = self._leaves.gather(np.unique(self._cells.regions_of(ghosts)))["keys"]
            changed = np.union1d(changed, near_ghosts[np.isin(merged_keys(near_ghosts), ghosts)])
        return np.union1d(changed, self._turn(of_planes, num_threads))

    def _turn(self, regions: Keys, num_threads: int) -> Keys:
        """The keys of the leaf cells in these regions whose normals differ from before."""
        leaves = self._leaves.gather(regions)
        surfels = surfels_of(self._cells.gather(regions), self._config.leaf_size_m)
        normals = normals_at(means_of(leaves), surfels, num_threads)
        differs = (normals != leaves["normals"]).any(axis=1)
        leaves["normals"] = normals
        self._leaves.put(regions, leaves)
        found: Keys = leaves["keys"][differs]
        return found
