# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface of a map that grows: what a quick fit makes of sums, derived again only where they changed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, Encoding, VertexTable
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.average import (
    BAND_CELLS,
    CELLS_SMOOTHED,
    TRUNCATION_CELLS,
    average_at_corners,
    normals_at,
    returns_of_means,
)
from radarsdf.live.ghosts import GrowingGhosts, means_of, surfels_of
from radarsdf.live.regions import (
    NO_KEYS,
    REGION_BITS,
    Keys,
    RegionTable,
    cubes_near,
    regions_near,
    regions_of,
    shifted,
    steps_near,
)
from radarsdf.live.triangles import GrowingTriangles
from radarsdf.map.contents import WholeMap
from radarsdf.map.mesh import Surface
from radarsdf.returns.evidence import BLOCK_BITS, Looks, bridged, sums_round
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, MIN_SUPPORT, planes_round, support_round
from radarsdf.returns.sums import MeanRays, ScanSums, merged_keys

_BLOCK_CELLS, _LARGE_CELLS = 8, 16  # edges of cubes, in which distances from changes are counted


class GrowingSurface:
    """What follows from sums over scans: planes, ghosts, distances, triangles. :meth:`update` derives again what changes reach.

    All is a function of the sums, the visibility counts and the noise: however they came about, it has the same bits. One
    thread at a time. `config`: of a quick fit; `origin` (3,): of the local frame, world, m.
    """

    def __init__(self, config: FitConfig, origin: NDArray[np.float64]) -> None:
        self._config = config
        self._noise: SensorNoise | None = None
        vector, number = np.full((1, 3), np.nan, np.float32), np.zeros(1, np.float32)
        # Leaf cells with returns: mean rays, normals, and whether the ray crosses a plane.
        self._leaves = RegionTable(
            points=vector,
            directions=vector,
            counts=number,
            scans=np.zeros(1, np.uint32),
            ranges_m=number,
            normals=vector,
            crosses=np.zeros(1, bool),
        )
        # Cells of surfels. Planes (centre, normal, variances) are NaN without support.
        self._cells = RegionTable(
            LEAVES_PER_SURFEL,
            moments=np.zeros((1, 13)),
            support=np.zeros(1),
            planes=np.full((1, 9), np.nan),
            opaque=np.zeros(1, bool),
            behind=np.zeros(1),
            ghosts=np.zeros(1, bool),
        )
        self._ghosts = GrowingGhosts(self._leaves, self._cells, config.leaf_size_m)
        # Of each region: returns in cells with planes, in those with flat ones, and in all, and the number of these.
        self._counts: dict[int, tuple[float, float, float, int]] = {}
        self._crossed = RegionTable()  # leaf cells that rays cross near their returns
        # These, and those that bridge gaps between them: distances at the corners, m, whether they change sign, evidence.
        self.distances = RegionTable(
            values=np.zeros((1, 8), np.float32),
            crossed=np.zeros(1, bool),
            information=np.zeros(1, np.float32),
            detections=np.zeros(1, np.uint32),
        )
        self._visibility = RegionTable(scans=np.zeros(1, np.uint32))  # by the first leaf cells of blocks
        self._triangles = GrowingTriangles(config, origin)

    @property
    def num_bytes(self) -> int:
        """Memory of all that is kept, bytes."""
        tables = (self._leaves, self._cells, self._crossed, self.distances, self._visibility)
        return sum(table.num_bytes for table in tables) + self._triangles.num_bytes

    def update(
        self, blocks: Keys, sums: ScanSums, seen: Keys, looks: Looks, noise: SensorNoise, num_threads: int
    ) -> Keys:
        """Derives again what changes reach. Returns the keys of the regions with other distances, ascending.

        `blocks` (B,) and `seen` (L,): keys of the blocks whose sums and visibility counts changed, ascending; `sums` and
        `looks`: all of the regions of these.
        """
        seen = regions_of(seen << BLOCK_BITS)
        self._visibility.put(seen, {"keys": looks.keys << BLOCK_BITS, "scans": looks.scans})
        changed = self._put_sums(blocks, sums)
        if noise != self._noise:  # ghosts and evidence depend on it everywhere
            self._noise = noise
            changed = np.union1d(changed, self._leaves.gather(self._leaves.regions)["keys"])
        redone = NO_KEYS
        if len(changed):
            of_rays = regions_of(changed)
            of_planes = np.union1d(of_rays, self._fit_planes(changed, num_threads))
            if self._config.returns.drop_ghosts:
                ghosts = self._ghosts.update(of_rays, of_planes, noise, num_threads)
                near = self._leaves.gather(np.unique(self._cells.regions_of(ghosts)))["keys"]
                changed = np.union1d(changed, near[np.isin(merged_keys(near), ghosts)])
            changed = np.union1d(changed, self._find_normals(of_planes, num_threads))
            redone = self._derive_distances(changed, noise, num_threads)
        stale = regions_near(np.union1d(seen, redone), 1)
        self._triangles.cut(stale, self.distances, self._visibility, num_threads)
        return redone

    def surface(self) -> tuple[WholeMap, Surface]:
        """All triangles, with the evidence of their vertices."""
        counts = np.array([*self._counts.values(), (0.0, 0.0, 0.0, 0)]).sum(axis=0)
        on_planes, on_flat, returns, cells = counts.tolist()
        clutter_ratio = 1 - on_flat / on_planes if on_planes else 0.0
        return self._triangles.joined(clutter_ratio, returns / max(cells, 1), self.distances.num_rows)

    def _put_sums(self, blocks: Keys, sums: ScanSums) -> Keys:
        """Takes sums in. Returns the keys of the leaf cells in changed blocks that have returns, or had some."""
        regions = regions_of(blocks << BLOCK_BITS)
        either = np.union1d(self._leaves.gather(regions)["keys"], sums.keys)
        self._leaves.put(regions, self._leaves.carried(regions, sums.keys) | vars(MeanRays.of_sums(sums)))
        keys, moments = sums.merged_moments()
        self._cells.put(regions, self._cells.carried(regions, keys) | {"moments": moments})
        found: Keys = either[np.isin(either >> BLOCK_BITS, blocks)]
        return found

    def _fit_planes(self, changed: Keys, num_threads: int) -> Keys:
        """Fits the planes of the cells near changed ones. Returns the regions of these, ascending."""
        near = shifted(np.unique(merged_keys(changed)), steps_near(1))
        regions = np.unique(self._cells.regions_of(near))
        cells = self._cells.gather(regions_near(regions, 1))
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
            on_planes, on_flat = float(returns.sum()), float(returns[surfels.is_flat()].sum())
            self._counts[int(region)] = on_planes, on_flat, float(surfels.counts.sum()), len(surfels.keys)
        return regions

    def _find_normals(self, regions: Keys, num_threads: int) -> Keys:
        """Finds the normals of the leaf cells in these regions. Returns the keys of those that differ from before."""
        leaves = self._leaves.gather(regions)
        surfels = surfels_of(self._cells.gather(regions), self._config.leaf_size_m)
        normals = normals_at(means_of(leaves), surfels, num_threads)
        differs = (normals != leaves["normals"]).any(axis=1)
        self._leaves.put(regions, leaves | {"normals": normals})
        found: Keys = leaves["keys"][differs]
        return found

    def _derive_distances(self, changed: Keys, noise: SensorNoise, num_threads: int) -> Keys:
        """Derives distances and evidence again where they depend on changed leaf cells. Returns the regions, ascending.

        A ray counts in the cells of its band; the corners of the last one have others round them. Cells that come or go tell
        which rays count at the corners of those round them, and smoothing carries what is known there.
        """
        config = self._config
        reached = cubes_near(changed, _BLOCK_CELLS, math.ceil(max(TRUNCATION_CELLS, BAND_CELLS)) + 1)
        centre = regions_of(reached)
        # Bridges depend on medians of blocks of 32 cells, and on their two ends.
        own, around = regions_near(centre, 2), regions_near(centre, 3)
        leaves, cells = self._leaves.gather(around), self._cells.gather(around)
        is_true = ~cells["ghosts"][CellBlocks(cells["keys"]).rows(merged_keys(leaves["keys"]), 1)]
        means, normals = means_of(leaves).select(is_true), leaves["normals"][is_true]
        before = self.distances.gather(around)["keys"]
        rays = means.select(np.isin(means.keys >> REGION_BITS, regions_near(centre, 1)))
        keys = rays.leaf_keys(config.leaf_size_m, config.metres(BAND_CELLS), num_threads)
        self._crossed.put(centre, {"keys": keys})
        crossed = self._crossed.gather(around)["keys"]
        counts = means.counts.astype(np.float64)
        found = bridged(crossed, means.keys, counts, config.encoding.bridge_cells, num_threads)
        # At the rim of what was gathered, bridges lack an end.
        leaf_keys = np.concatenate(
            [found[np.isin(found >> REGION_BITS, own)], before[~np.isin(before >> REGION_BITS, own)]]
        )
        leaf_keys.sort()
        came_or_went = np.setxor1d(leaf_keys, before, assume_unique=True)
        reached = np.union1d(reached, cubes_near(came_or_went, _BLOCK_CELLS, 1))
        there = regions_of(np.union1d(leaf_keys, before))
        redone = np.intersect1d(regions_of(cubes_near(reached, _LARGE_CELLS, CELLS_SMOOTHED)), there)
        # All that has a part in what their corners get: smoothing reaches no farther.
        near = regions_near(redone, 1)
        leaf_keys = leaf_keys[np.isin(leaf_keys >> REGION_BITS, near)]
        here = np.isin(means.keys >> REGION_BITS, near)
        means, normals = means.select(here), normals[here]
        weighted = returns_of_means(means, noise, config.returns)
        table = VertexTable(leaf_keys, config.leaf_size_m, 1, Encoding.OCTREE, num_threads)
        distances_m = average_at_corners(table, means, weighted, normals, config, num_threads)
        own_cells = np.isin(leaf_keys >> REGION_BITS, redone)
        values = distances_m[table.leaf_vertices()[1][own_cells]]
        information, detections = sums_round(weighted, leaf_keys[own_cells], num_threads)
        rows = {
            "keys": leaf_keys[own_cells],
            "values": values,
            "crossed": (values.min(axis=1, initial=np.inf) <= 0) & (values.max(axis=1, initial=-np.inf) > 0),
            "information": information,
            "detections": detections,
        }
        self.distances.put(redone, rows)
        return redone
