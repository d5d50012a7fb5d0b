# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface of a map that grows: what a quick fit makes of sums, made anew only where they changed."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, Encoding, VertexTable
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.start import average_at_vertices, cells_smoothed, normals_at, told_by
from radarsdf.live.ghosts import NOWHERE, GrowingGhosts, means_of, surfels_of
from radarsdf.live.regions import REGION_BITS, RegionTable, Rows, regions_of, regions_round
from radarsdf.live.rows import ROUND, Keys, Replacement, changed_rows, leaves_of, shifted, steps_round, within
from radarsdf.live.triangles import GrowingTriangles, Triangles
from radarsdf.returns.cells import merged_keys
from radarsdf.returns.evidence import BLOCK_BITS, Looks, ReturnsOfCells, sums_round
from radarsdf.returns.gaps import bridged
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.scan_sums import ScanSums
from radarsdf.returns.surfels import LEAVES_PER_SURFEL, MIN_SUPPORT, planes_round, support_round

_NONE = np.zeros(0, np.uint64)
_LARGE_BITS = np.uint64(3)  # by which the key of a block is longer than that of a large one
_LARGE_CELLS = 16  # along its edge
_PLANE = 9  # numbers of a surfel: centre, normal, variances


@dataclass(frozen=True)
class Changes:
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
        self._on_planes: dict[
            int, tuple[float, float]
        ] = {}  # returns in cells with planes, and with flat ones
        # Of leaf cells that rays cross near their returns.
        self._near = RegionTable()
        # Of leaf cells near the surface: these, and those that bridge gaps between them. Signed distances at the corners, m.
        self._surface = RegionTable(
            values=np.zeros((0, 8), np.float32),
            crossed=np.zeros(0, bool),
            information=numbers,
            detections=np.zeros(0, np.uint32),
        )
        # Of blocks, by the keys of their first leaf cells.
        self._looks = RegionTable(scans=np.zeros(0, np.uint32))
        self._triangles = GrowingTriangles(config, origin)

    @property
    def num_bytes(self) -> int:
        """Memory of what is kept, bytes."""
        tables = (self._leaves, self._cells, self._near, self._surface, self._looks, self._triangles)
        return sum(table.num_bytes for table in tables)

    @property
    def num_bytes_of_cell(self) -> float:
        """Likewise, for each leaf cell with returns."""
        return self.num_bytes / max(self._leaves.num_rows, 1)

    @property
    def num_leaves(self) -> int:
        """Number of leaf cells near the surface."""
        return self._surface.num_rows

    def update(self, changes: Changes, noise: SensorNoise, num_threads: int) -> Keys:
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
            redone = self._derive(of_rays, of_planes, changed, dirty, num_threads)
        stale = np.union1d(looked, regions_of(redone << BLOCK_BITS))
        self._triangles.cut(regions_round(stale, 1), self._surface, self._looks, num_threads)
        return redone

    def triangles(self) -> Triangles:
        """All triangles, and what the returns tell of their vertices."""
        returns = sum(in_all for in_all, _ in self._on_planes.values())
        flat = sum(on_flat for _, on_flat in self._on_planes.values())
        return self._triangles.joined(1 - flat / returns if returns else 0.0, self.num_leaves)

    def _take_sums(self, changes: Changes) -> Keys:
        """The keys of the leaf cells whose sums changed, and of the others in their blocks."""
        regions = regions_of(changes.returns << BLOCK_BITS)
        first, last = leaves_of(changes.returns)
        before, after = self._leaves.gather(regions), changes.sums
        there = within(before["keys"], first, last)
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
        keys, moments = after.merged_moments()
        before = self._cells.gather(regions)
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
        rows = Replacement.of(before["keys"], keys, merged_keys(first), merged_keys(last))
        self._cells.put(regions, rows.rows(before, new))
        # All of a block is new in these columns, so all of it is to be made.
        return np.union1d(changed, after.keys)

    def _take_looks(self, changes: Changes) -> Keys:
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
            self._on_planes[int(region)] = float(returns.sum()), float(returns[surfels.is_flat()].sum())
        return regions

    def _derive(self, of_rays: Keys, of_planes: Keys, changed: Keys, dirty: Keys, num_threads: int) -> Keys:
        """Distances and evidence in the blocks round changed leaf cells, and in the `dirty` blocks.

        `of_rays`, `of_planes`: regions in which mean rays and planes changed.
        """
        assert self._noise is not None
        if self._config.returns.drop_ghosts:
            ghosts = self._ghosts.update(of_rays, of_planes, self._noise, num_threads)
            near_ghosts = self._leaves.gather(np.unique(self._cells.regions_of(ghosts)))["keys"]
            changed = np.union1d(changed, near_ghosts[np.isin(merged_keys(near_ghosts), ghosts)])
        changed = np.union1d(changed, self._turn(of_planes, num_threads))
        near = np.union1d(dirty, np.unique(shifted(changed, self._reach()) >> BLOCK_BITS))
        # Bridges that open or close tell of cells at most a block of medians away, and smoothing carries what they do.
        middle = regions_of(near << BLOCK_BITS)
        inner, around = regions_round(middle, 2), regions_round(middle, 3)
        leaves, cell_rows = self._leaves.gather(around), self._cells.gather(around)
        cell_of_leaf = CellBlocks(cell_rows["keys"]).rows(merged_keys(leaves["keys"]), num_threads)
        is_true = ~cell_rows["ghosts"][cell_of_leaf]
        true, normals = means_of(leaves).select(is_true), leaves["normals"][is_true]
        near_keys = self._find_near(near, true, around, num_threads)
        told = told_by(true, self._noise, self._config.returns)
        surface = self._surface.gather(around)
        leaf_keys = bridged(
            near_keys, told.keys, told.counts, self._config.encoding.bridge_cells, num_threads
        )
        leaf_keys = np.concatenate(
            [
                leaf_keys[np.isin(leaf_keys >> REGION_BITS, inner)],
                surface["keys"][~np.isin(surface["keys"] >> REGION_BITS, inner)],
            ]
        )
        leaf_keys.sort()
        # A cell that came or went tells which rays count at the corners of those round it.
        opened = shifted(np.setxor1d(leaf_keys, surface["keys"], assume_unique=True), ROUND)
        redone = np.union1d(near, np.unique(opened >> BLOCK_BITS))
        there = np.union1d(leaf_keys >> BLOCK_BITS, surface["keys"] >> BLOCK_BITS)
        redone = np.intersect1d(self._smoothed_with(redone), there, assume_unique=True)
        round_them = leaves_of(self._smoothed_with(_blocks_round(redone)))
        here = within(true.keys, *round_them)
        self._surface.put(
            around,
            self._remade(
                surface,
                redone,
                leaf_keys[within(leaf_keys, *round_them)],
                true.select(here),
                normals[here],
                told.select(here),
                num_threads,
            ),
        )
        return redone

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

    def _find_near(self, blocks: Keys, means: MeanRays, regions: Keys, num_threads: int) -> Keys:
        """The leaf cells of these `regions` that rays cross near their returns: in these `blocks` found anew."""
        config = self._config
        first, last = leaves_of(blocks)
        here = means.select(within(means.keys, *leaves_of(_blocks_round(blocks))))
        near = here.leaf_keys(config.leaf_size_m, config.near_band_m, num_threads)
        before = self._near.gather(regions)["keys"]
        found = Replacement.of(before, near[within(near, first, last)], first, last).keys
        self._near.put(regions, {"keys": found})
        return found

    def _reach(self) -> NDArray[np.int64]:
        """(S, 3) steps from a leaf cell to the corners of all that its returns have a part in."""
        config = self._config
        # A ray ends in a cell of its band. The corners of that cell have others round them.
        cells = math.ceil(max(config.truncation_m, config.near_band_m) / config.leaf_size_m - 1e-9) + 1
        inside = range(-cells, cells, 8)  # no more than a block apart
        return np.array(list(itertools.product([*inside, cells], repeat=3)), np.int64)

    def _smoothed_with(self, blocks: Keys) -> Keys:
        """Keys of these blocks, and of those that smoothing may reach from them, or them from."""
        reach = cells_smoothed(self._config)
        if reach == 0:
            return blocks
        # By larger blocks, of 16³ leaf cells: to step from all to all takes longer than what is smoothed too far away.
        steps = steps_round(math.ceil(reach / _LARGE_CELLS))
        large = shifted(np.unique(blocks >> _LARGE_BITS) << (BLOCK_BITS + _LARGE_BITS), steps * _LARGE_CELLS)
        large = np.unique(large >> (BLOCK_BITS + _LARGE_BITS))
        found: Keys = ((large << _LARGE_BITS)[:, None] | np.arange(8, dtype=np.uint64)).reshape(-1)
        return found

    def _remade(
        self,
        before: Rows,
        blocks: Keys,
        near: Keys,
        means: MeanRays,
        normals: NDArray[np.float32],
        told: ReturnsOfCells,
        num_threads: int,
    ) -> Rows:
        """The rows `before` with the leaf cells of these blocks anew, by the leaf cells `near`, and the rays, in and round them."""
        config, size_m = self._config, self._config.leaf_size_m
        first, last = leaves_of(blocks)
        own = within(near, first, last)
        leaf_keys = near[own]
        table = VertexTable(near, size_m, 1, Encoding.OCTREE, num_threads)
        distances_m = average_at_vertices(table, means, told, normals, config, num_threads)
        # As the field's features hold it.
        distances_m = distances_m / np.float32(config.sigma_m) * np.float32(config.sigma_m)
        _, vertices = table.leaf_vertices()
        values = distances_m[vertices[own]]
        crossed = (values.min(axis=1, initial=np.inf) <= 0) & (values.max(axis=1, initial=-np.inf) > 0)
        information, detections = sums_round(told, leaf_keys, num_threads)
        rows = Replacement.of(before["keys"], leaf_keys, first, last)
        new = {"values": values, "crossed": crossed, "information": information, "detections": detections}
        return rows.rows(before, new)


def _blocks_round(blocks: Keys) -> Keys:
    """Keys of these blocks, and of those round them."""
    return np.unique(shifted(blocks << BLOCK_BITS, ROUND << 3) >> BLOCK_BITS)
