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
from radarsdf.live.rows import ROUND, Keys, Replacement, changed_rows, leaves_of, shifted, within
from radarsdf.map import queries
from radarsdf.map.contents import Scene
from radarsdf.map.isosurface import extract_cells, sparse_lattice
from radarsdf.map.meshing import Surface, local
from radarsdf.returns.cells import lattice_of, merged_keys
from radarsdf.returns.evidence import BLOCK_BITS, Evidence, Looks, ReturnsOfCells, sums_round
from radarsdf.returns.gaps import bridged
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.scan_sums import ScanSums
from radarsdf.returns.surfels import LEAVES_PER_SURFEL, MIN_SUPPORT, Surfels, planes_round, support_round

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


@dataclass(frozen=True)
class Triangles:
    """All triangles of the surface with what decides which of them are kept."""

    scene: Scene
    surface: Surface
    leaf_cells: int
    """Number of leaf cells near the surface."""


class GrowingSurface:
    """What follows from sums over scans. :meth:`update` makes anew what depends on changes, and nothing else.

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
        self._origin = origin
        self._sums = ScanSums(config.leaf_size_m, _NONE, np.zeros((0, 14), np.int64), np.zeros(0, np.uint32))
        self._means = MeanRays.of_sums(self._sums)
        self._noise: SensorNoise | None = None
        # Of cells of surfels.
        self._keys = _NONE
        self._moments = np.zeros((0, 13))
        self._support = np.zeros(0)
        self._planes = np.zeros((0, _PLANE))  # NaN without support
        self._ghosts = np.zeros(0, bool)
        self._normals = np.zeros((0, 3), np.float32)  # at the leaf cells with returns
        # Of leaf cells that rays cross near their returns.
        self._near = _NONE
        # Of leaf cells near the surface: these, and those that bridge gaps between them.
        self._leaf_keys = _NONE
        self._values = np.zeros((0, 8), np.float32)  # signed distances at the corners, m
        self._crossed = np.zeros(0, bool)
        self._information = np.zeros(0, np.float32)
        self._detections = np.zeros(0, np.uint32)
        self._looks = Looks(_NONE, np.zeros(0, np.uint32))
        self._rough_share = 0.0
        self._triangles: Triangles | None = None

    @property
    def num_bytes(self) -> int:
        """Memory of what is kept, bytes."""
        held = [*vars(self).values(), *vars(self._sums).values(), *vars(self._means).values()]
        return sum(array.nbytes for array in held if isinstance(array, np.ndarray))

    def update(self, changes: Changes, noise: SensorNoise, num_threads: int) -> Keys:
        """Takes changes in. Gives the keys (D,) of the blocks of the surface that were made anew, ascending."""
        changed = self._take_sums(changes)
        self._take_looks(changes)
        if noise != self._noise:  # ghosts and evidence depend on it everywhere
            self._noise, dirty = noise, np.unique(self._sums.keys >> BLOCK_BITS)
        else:
            dirty = _NONE
        if len(changed) == 0 and len(dirty) == 0:
            return _NONE
        self._fit_planes(changed, num_threads)
        surfels = self._surfels()
        self._rough_share = surfels.rough_share()
        return self._derive(surfels, changed, dirty, num_threads)

    def triangles(self, num_threads: int) -> Triangles:
        """All triangles, and what the returns tell of their vertices."""
        if self._triangles is None:
            self._triangles = self._extracted(num_threads)
        return self._triangles

    def _take_sums(self, changes: Changes) -> Keys:
        """The keys of the leaf cells whose sums changed."""
        first, last = leaves_of(changes.returns)
        before, after = self._sums, changes.sums
        there = within(before.keys, first, last)
        changed = changed_rows(
            before.keys[there],
            (before.sums[there], before.scans[there]),
            after.keys,
            (after.sums, after.scans),
        )
        if len(changed) == 0:
            return changed
        rows = Replacement.of(before.keys, after.keys, first, last)
        self._sums = ScanSums(
            before.leaf_size_m,
            rows.keys,
            rows.column(before.sums, after.sums),
            rows.column(before.scans, after.scans),
        )
        old, new = self._means, MeanRays.of_sums(after)
        self._means = MeanRays(
            rows.keys,
            rows.column(old.points, new.points),
            rows.column(old.directions, new.directions),
            rows.column(old.counts, new.counts),
            rows.column(old.scans, new.scans),
            rows.column(old.ranges_m, new.ranges_m),
        )
        self._normals = rows.column(self._normals, np.full((len(after.keys), 3), np.nan, np.float32))
        keys, moments = after.merged_moments()
        rows = Replacement.of(self._keys, keys, merged_keys(first), merged_keys(last))
        self._keys = rows.keys
        self._moments = rows.column(self._moments, moments)
        self._support = rows.column(self._support, np.zeros(len(keys)))
        self._planes = rows.column(self._planes, np.full((len(keys), _PLANE), np.nan))
        self._ghosts = rows.column(self._ghosts, np.zeros(len(keys), bool))
        # All of a block is new in these columns, so all of it is to be made.
        return np.union1d(changed, after.keys)

    def _take_looks(self, changes: Changes) -> None:
        if len(changes.look_blocks) == 0:
            return
        blocks, new = changes.look_blocks, changes.looks
        rows = Replacement.of(self._looks.keys, new.keys, blocks, blocks)
        self._looks = Looks(rows.keys, rows.column(self._looks.scans, new.scans))
        self._triangles = None

    def _fit_planes(self, changed: Keys, num_threads: int) -> None:
        """Surfels of the cells round changed ones."""
        blocks = CellBlocks(self._keys)
        near = shifted(np.unique(merged_keys(changed)), ROUND)
        rows = blocks.rows(near, num_threads)
        rows = rows[rows >= 0]
        self._support[rows] = support_round(blocks, self._keys[rows], self._moments, num_threads)
        self._planes[rows] = np.nan
        rows = rows[self._support[rows] >= MIN_SUPPORT]
        centres, normals, _, variances = planes_round(
            blocks, self._keys[rows], self._moments, LEAVES_PER_SURFEL * self._config.leaf_size_m, num_threads
        )
        self._planes[rows] = np.concatenate([centres, normals, variances], axis=1)

    def _surfels(self) -> Surfels:
        cell_of_plane = np.flatnonzero(self._support >= MIN_SUPPORT)
        planes = self._planes[cell_of_plane]
        return Surfels(
            cell_size_m=LEAVES_PER_SURFEL * self._config.leaf_size_m,
            keys=self._keys,
            blocks=CellBlocks(self._keys),
            counts=self._moments[:, 0].copy(),
            support=self._support,
            cell_of_plane=cell_of_plane,
            centres=planes[:, :3].copy(),
            normals=planes[:, 3:6].copy(),
            variances=planes[:, 6:].copy(),
        )

    def _derive(self, surfels: Surfels, changed: Keys, dirty: Keys, num_threads: int) -> Keys:
        """Distances and evidence in the blocks round changed leaf cells, and in the `dirty` blocks."""
        assert self._noise is not None
        means = self._means
        cell_of_leaf = surfels.cells_of_leaves(means.keys, num_threads)
        ghosts = np.zeros(len(self._keys), bool)
        if self._config.returns.drop_ghosts:
            ghosts = find_ghosts(surfels, means, self._noise, num_threads)
        normals = normals_at(means, surfels, num_threads)
        differs = (ghosts != self._ghosts)[cell_of_leaf] | (normals != self._normals).any(axis=1)
        self._ghosts, self._normals = ghosts, normals
        changed = np.union1d(changed, means.keys[differs])
        near = np.union1d(dirty, np.unique(shifted(changed, self._reach()) >> BLOCK_BITS))
        true = means.select(~ghosts[cell_of_leaf])
        normals = normals[~ghosts[cell_of_leaf]]
        self._find_near(near, true, num_threads)
        told = told_by(true, self._noise, self._config.returns)
        leaf_keys = self._bridged(told, num_threads)
        # A cell that came or went tells which rays count at the corners of those round it.
        opened = shifted(np.setxor1d(leaf_keys, self._leaf_keys, assume_unique=True), ROUND)
        redone = np.union1d(near, np.unique(opened >> BLOCK_BITS))
        there = np.union1d(leaf_keys >> BLOCK_BITS, self._leaf_keys >> BLOCK_BITS)
        redone = np.intersect1d(self._smoothed_with(redone), there, assume_unique=True)
        round_them = leaves_of(self._smoothed_with(_blocks_round(redone)))
        here = within(true.keys, *round_them)
        self._remake(
            redone,
            leaf_keys[within(leaf_keys, *round_them)],
            true.select(here),
            normals[here],
            told.select(here),
            num_threads,
        )
        self._triangles = None
        return redone

    def _find_near(self, blocks: Keys, means: MeanRays, num_threads: int) -> None:
        """The leaf cells of these blocks that rays cross near their returns."""
        config = self._config
        first, last = leaves_of(blocks)
        here = means.select(within(means.keys, *leaves_of(_blocks_round(blocks))))
        near = here.leaf_keys(config.leaf_size_m, config.near_band_m, num_threads)
        self._near = Replacement.of(self._near, near[within(near, first, last)], first, last).keys

    def _bridged(self, told: ReturnsOfCells, num_threads: int) -> Keys:
        """All leaf cells near the surface."""
        cells = self._config.encoding.bridge_cells
        return bridged(self._near, told.keys, told.counts, cells, num_threads)

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
        steps = _steps(math.ceil(reach / _LARGE_CELLS))
        large = shifted(np.unique(blocks >> _LARGE_BITS) << (BLOCK_BITS + _LARGE_BITS), steps * _LARGE_CELLS)
        large = np.unique(large >> (BLOCK_BITS + _LARGE_BITS))
        found: Keys = ((large << _LARGE_BITS)[:, None] | np.arange(8, dtype=np.uint64)).reshape(-1)
        return found

    def _remake(
        self,
        blocks: Keys,
        near: Keys,
        means: MeanRays,
        normals: NDArray[np.float32],
        told: ReturnsOfCells,
        num_threads: int,
    ) -> None:
        """The leaf cells of these blocks, by the leaf cells `near`, and the rays, in and round them."""
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
        rows = Replacement.of(self._leaf_keys, leaf_keys, first, last)
        self._leaf_keys = rows.keys
        self._values = rows.column(self._values, values)
        self._crossed = rows.column(self._crossed, crossed)
        self._information = rows.column(self._information, information)
        self._detections = rows.column(self._detections, detections)

    def _extracted(self, num_threads: int) -> Triangles:
        crossed, size_m = self._crossed, self._config.leaf_size_m
        cells = lattice_of(self._leaf_keys[crossed]).astype(np.int32)
        order = np.lexsort(cells.T[::-1])  # as of a sparse lattice
        _, corners, of_cells = sparse_lattice(cells, num_threads=num_threads)
        values = np.zeros(len(corners), np.float32)
        values[of_cells] = self._values[crossed][order]
        vertices, faces = extract_cells(
            corners, values, of_cells, spacing=[size_m] * 3, num_threads=num_threads
        )
        scene = Scene(self._origin, self._config, self._rough_share)
        found = Evidence(self._information, self._detections, self._looks.at(self._leaf_keys))
        evidence = queries.interpolated(found, self._leaf_keys, size_m, local(scene, vertices + self._origin))
        surface = Surface.told_by(scene, vertices, faces, evidence, len(self._leaf_keys))
        return Triangles(scene, surface, len(self._leaf_keys))


def _steps(reach: int) -> NDArray[np.int64]:
    """((2 reach + 1)³, 3) steps of at most so many along each axis."""
    return np.array(list(itertools.product(range(-reach, reach + 1), repeat=3)), np.int64)


def _blocks_round(blocks: Keys) -> Keys:
    """Keys of these blocks, and of those round them."""
    return np.unique(shifted(blocks << BLOCK_BITS, ROUND << 3) >> BLOCK_BITS)
