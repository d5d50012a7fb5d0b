# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The signed distances of a map that grows, at the corners of its leaf cells, made anew only where they may differ."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, Encoding, VertexTable
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.average import (
    BAND_CELLS,
    CELLS_SMOOTHED,
    TRUNCATION_CELLS,
    average_at_corners,
    returns_of_means,
)
from radarsdf.live.ghosts import means_of
from radarsdf.live.regions import REGION_BITS, RegionTable, regions_of, regions_round
from radarsdf.live.rows import ROUND, Keys, Replacement, between, leaves_of, shifted, steps_round
from radarsdf.returns.evidence import BLOCK_BITS, ReturnsOfCells, bridged, sums_round
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.sums import MeanRays, merged_keys

_LARGE_BITS = np.uint64(3)  # by which the key of a block is longer than that of a large one
_LARGE_CELLS = 16  # along its edge


@dataclass(frozen=True)
class TrueReturns:
    """Leaf cells whose returns are no ghosts, in the order of their keys: what distances are made of."""

    means: MeanRays
    """The mean ray of each cell."""
    normals: NDArray[np.float32]
    """(M, 3) of the planes at their ends."""
    told: ReturnsOfCells
    """What the returns of each cell tell."""

    @classmethod
    def of(
        cls,
        regions: Keys,
        leaves: RegionTable,
        surfels: RegionTable,
        noise: SensorNoise,
        config: FitConfig,
        num_threads: int,
    ) -> TrueReturns:
        """Those in some `regions`, of the tables of :class:`radarsdf.live.surface.GrowingSurface`."""
        rows, cells = leaves.gather(regions), surfels.gather(regions)
        cell_of_leaf = CellBlocks(cells["keys"]).rows(merged_keys(rows["keys"]), num_threads)
        is_true = ~cells["ghosts"][cell_of_leaf]
        means = means_of(rows).select(is_true)
        return cls(means, rows["normals"][is_true], returns_of_means(means, noise, config.returns))

    def within(self, blocks: Keys) -> TrueReturns:
        """Those in these blocks."""
        here = between(self.means.keys, *leaves_of(blocks))
        return TrueReturns(self.means.select(here), self.normals[here], self.told.select(here))


class GrowingDistances:
    """Keeps the leaf cells near the surface, with the distances at their corners and their evidence.

    `config`: of a quick fit.
    """

    def __init__(self, config: FitConfig) -> None:
        self._config = config
        # Leaf cells that rays cross near their returns.
        self._crossed = RegionTable()
        self.table = RegionTable(
            values=np.zeros((0, 8), np.float32),
            crossed=np.zeros(0, bool),
            information=np.zeros(0, np.float32),
            detections=np.zeros(0, np.uint32),
        )
        """Of these leaf cells, and of those that bridge gaps between them: signed distances at the corners, m, whether they
        change their sign, and what :func:`radarsdf.returns.evidence.sums_round` gives."""

    @property
    def num_bytes(self) -> int:
        """Memory of what is kept, bytes."""
        return self._crossed.num_bytes + self.table.num_bytes

    def blocks_reached(self, leaf_keys: Keys) -> Keys:
        """Keys of the blocks with a corner at which the returns of these leaf cells count, before distances are smoothed."""
        # A ray ends in a cell of its band. The corners of that cell have others round them.
        cells = math.ceil(max(TRUNCATION_CELLS, BAND_CELLS)) + 1
        inside = range(-cells, cells, 8)  # no more than a block apart
        steps = np.array(list(itertools.product([*inside, cells], repeat=3)), np.int64)
        return np.unique(shifted(leaf_keys, steps) >> BLOCK_BITS)

    def update(
        self, reached: Keys, leaves: RegionTable, surfels: RegionTable, noise: SensorNoise, num_threads: int
    ) -> Keys:
        """Takes in that other returns count in some blocks.

        Parameters
        ----------
        reached : (B,) ndarray
            Keys of these blocks, as :meth:`blocks_reached` finds them, ascending.
        leaves, surfels : RegionTable
            All returns and planes, as they are now. Only those near the blocks are asked for.
        noise : SensorNoise
            Of the returns.

        Returns
        -------
        (D,) ndarray
            Keys of the blocks of :attr:`table` that were made anew, ascending. Corners in all others have the same bits.
        """
        # Bridges that open or close tell of cells at most a block of medians away, and smoothing carries what they do.
        centre = regions_of(reached << BLOCK_BITS)
        own, around = regions_round(centre, 2), regions_round(centre, 3)
        returns = TrueReturns.of(around, leaves, surfels, noise, self._config, num_threads)
        before = self.table.gather(around)
        leaf_keys = self._cells_near_surface(reached, returns, before["keys"], own, around, num_threads)
        anew = self._blocks_anew(reached, before["keys"], leaf_keys)
        # All that has a part in what their corners get.
        needed = self._blocks_smoothed_with(_blocks_round(anew))
        leaf_keys = leaf_keys[between(leaf_keys, *leaves_of(needed))]
        new_keys, new = self._made(anew, leaf_keys, returns.within(needed), num_threads)
        rows = Replacement.of(before["keys"], new_keys, *leaves_of(anew))
        self.table.put(around, rows.rows(before, new))
        return anew

    def _cells_near_surface(
        self, reached: Keys, returns: TrueReturns, before: Keys, own: Keys, around: Keys, num_threads: int
    ) -> Keys:
        """Keys of the leaf cells of the regions `around` that belong into the table: found anew in `own`, else as `before`."""
        told = returns.told
        crossed = self._find_crossed(reached, returns.means, around, num_threads)
        found = bridged(crossed, told.keys, told.counts, self._config.encoding.bridge_cells, num_threads)
        # At the rim of what was gathered, bridges lack an end.
        leaf_keys: Keys = np.concatenate(
            [
                found[np.isin(found >> REGION_BITS, own)],
                before[~np.isin(before >> REGION_BITS, own)],
            ]
        )
        leaf_keys.sort()
        return leaf_keys

    def _find_crossed(self, reached: Keys, means: MeanRays, around: Keys, num_threads: int) -> Keys:
        """Keys of the leaf cells of the regions `around` that rays cross near their returns: found anew in blocks `reached`."""
        first, last = leaves_of(reached)
        rays = means.select(between(means.keys, *leaves_of(_blocks_round(reached))))
        found = rays.leaf_keys(self._config.leaf_size_m, self._config.metres(BAND_CELLS), num_threads)
        before = self._crossed.gather(around)["keys"]
        crossed = Replacement.of(before, found[between(found, first, last)], first, last).keys
        self._crossed.put(around, {"keys": crossed})
        return crossed

    def _blocks_anew(self, reached: Keys, before: Keys, after: Keys) -> Keys:
        """Keys of the blocks with cells in which a corner may differ, if the table's leaf cells were `before` and are `after`."""
        # A cell that came or went tells which rays count at the corners of those round it.
        came_or_went = np.setxor1d(after, before, assume_unique=True)
        changed = np.union1d(reached, np.unique(shifted(came_or_went, ROUND) >> BLOCK_BITS))
        there = np.union1d(after >> BLOCK_BITS, before >> BLOCK_BITS)
        found: Keys = np.intersect1d(self._blocks_smoothed_with(changed), there, assume_unique=True)
        return found

    def _blocks_smoothed_with(self, blocks: Keys) -> Keys:
        """Keys of these blocks, and of those that smoothing may reach from them, or them from."""
        # By larger blocks, of 16³ leaf cells: to step from all to all takes longer than what is smoothed too far away.
        steps = steps_round(math.ceil(CELLS_SMOOTHED / _LARGE_CELLS))
        large = shifted(np.unique(blocks >> _LARGE_BITS) << (BLOCK_BITS + _LARGE_BITS), steps * _LARGE_CELLS)
        large = np.unique(large >> (BLOCK_BITS + _LARGE_BITS))
        found: Keys = ((large << _LARGE_BITS)[:, None] | np.arange(8, dtype=np.uint64)).reshape(-1)
        return found

    def _made(
        self, blocks: Keys, leaf_keys: Keys, returns: TrueReturns, num_threads: int
    ) -> tuple[Keys, dict[str, NDArray[np.generic]]]:
        """Keys (C,), ascending, and columns of the leaf cells in these blocks.

        `leaf_keys`, `returns`: of all leaf cells in these blocks, and of those round them that smoothing carries something from.
        """
        config = self._config
        own = between(leaf_keys, *leaves_of(blocks))
        table = VertexTable(leaf_keys, config.leaf_size_m, 1, Encoding.OCTREE, num_threads)
        distances_m = average_at_corners(
            table, returns.means, returns.told, returns.normals, config, num_threads
        )
        _, vertices = table.leaf_vertices()
        values = distances_m[vertices[own]]
        crossed = (values.min(axis=1, initial=np.inf) <= 0) & (values.max(axis=1, initial=-np.inf) > 0)
        information, detections = sums_round(returns.told, leaf_keys[own], num_threads)
        return leaf_keys[own], {
            "values": values,
            "crossed": crossed,
            "information": information,
            "detections": detections,
        }


def _blocks_round(blocks: Keys) -> Keys:
    """Keys of these blocks, and of those round them."""
    return np.unique(shifted(blocks << BLOCK_BITS, ROUND << 3) >> BLOCK_BITS)
