# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The tiles of a plane: which of them a ray crosses, and what each counts at a point."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Tile = tuple[int, int]
"""Number of a tile along x and along y. Tile (0, 0) begins where the lattice of the world does."""

_Floats = NDArray[np.float64]
_MOST_TILES = 2**31  # to either side: far beyond what a float64 of metres tells apart


@dataclass(frozen=True)
class TileGrid:
    """Squares of the horizontal plane, of any height, and a halo round each."""

    tile_m: float
    """Edge of a tile, m: a multiple of the block."""
    halo_m: float
    """What a tile knows beyond its edges, m: at most its edge."""
    corner_m: float
    """Where tile (0, 0) begins along x and along y, world, m."""

    def lower_corner(self, tile: Tile) -> _Floats:
        """(2,) where a tile begins, world, m."""
        return self.corner_m + np.array(tile) * self.tile_m

    def tiles_of(self, positions: NDArray[Any]) -> NDArray[np.int64]:
        """(N, 2) the tile that each position (N, 3), world, m, belongs to."""
        tiles: NDArray[np.int64] = np.floor(self._along(positions) / self.tile_m).astype(np.int64)
        return tiles

    def crossed(
        self, ends: _Floats, others: _Floats
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Rows (M,) of segments between `ends` and `others` (N, 3), world, m, and the tiles (M, 2) that they cross.

        A segment crosses a tile if it comes into it or its halo. Each pair comes once.
        """
        a, b = self._along(ends), self._along(others)
        first = np.floor((np.minimum(a, b) - self.halo_m) / self.tile_m).astype(np.int64)
        last = np.floor((np.maximum(a, b) + self.halo_m) / self.tile_m).astype(np.int64)
        most = (last - first).max(axis=0, initial=-1)
        for step in itertools.product(range(most[0] + 1), range(most[1] + 1)):
            rows = np.flatnonzero((first + step <= last).all(axis=1))
            tiles = first[rows] + step
            meets = self._meets(a[rows], b[rows], tiles)
            yield rows[meets], tiles[meets]

    def _meets(self, a: _Floats, b: _Floats, tiles: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether segments, from the corner of tile (0, 0), meet the boxes of their tiles, all (M, 2), by slabs."""
        lower = tiles * self.tile_m - self.halo_m
        upper = (tiles + 1) * self.tile_m + self.halo_m
        way = b - a
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = (lower - a) / way, (upper - a) / way
        enter, leave = np.minimum(near, far), np.maximum(near, far)
        along = way == 0  # parallel to the slab, and within: the tiles are those of its own limits
        enter, leave = np.where(along, -np.inf, enter), np.where(along, np.inf, leave)
        meets: NDArray[np.bool_] = np.maximum(enter.max(axis=1), 0) <= np.minimum(leave.min(axis=1), 1)
        return meets

    def weights(self, tile: Tile, positions: _Floats) -> tuple[_Floats, _Floats]:
        """What a tile counts at positions (N, 3), world, m: (N,), and the derivatives (N, 2) by x and y, 1/m.

        The weights of all tiles add up to one. They rise smoothly within half a halo round each edge, so that the outer
        half of a halo does not count: what is known there is less than what its owner knows.
        """
        along = self._along(positions)
        factors, slopes = np.ones((len(positions), 2)), np.zeros((len(positions), 2))
        for axis in range(2):
            x = along[:, axis]
            for edge, sign in ((tile[axis], 1.0), (tile[axis] + 1, -1.0)):
                t = np.clip(sign * (x - edge * self.tile_m) / self.halo_m + 0.5, 0.0, 1.0)
                rise = t * t * (3 - 2 * t)
                slopes[:, axis] = (
                    slopes[:, axis] * rise + factors[:, axis] * sign * 6 * t * (1 - t) / self.halo_m
                )
                factors[:, axis] *= rise
        return factors[:, 0] * factors[:, 1], slopes * factors[:, ::-1]

    def counting(self, positions: _Floats) -> list[Tile]:
        """The tiles that count at any of the positions (N, 3), world, m, in ascending order."""
        found: set[Tile] = set()
        # What is no place, or too far away for a number, is in no tile.
        is_place = (np.abs(self._along(positions)) < _MOST_TILES * self.tile_m).all(axis=1)
        positions = positions if is_place.all() else positions[is_place]
        if len(positions) == 0:
            return []
        for shift in itertools.product((-0.5, 0.5), repeat=2):
            tiles = self.tiles_of(positions[:, :2] + np.array(shift) * self.halo_m)
            # Neighbours in the list are mostly of one tile: what is left to sort is a thousandth.
            changes = np.any(tiles[1:] != tiles[:-1], axis=1).nonzero()[0] + 1
            found |= set(map(tuple, np.unique(tiles[np.append(0, changes)], axis=0).tolist()))
        return sorted(found)

    def within_half_a_halo(self, tile: Tile, positions: _Floats) -> NDArray[np.int64]:
        """(M,) rows of positions (N, 3), world, m, outside of which a tile does not count."""
        from_corner = self._along(positions) - np.array(tile) * self.tile_m
        half_m = self.halo_m / 2
        return np.flatnonzero(((from_corner > -half_m) & (from_corner < self.tile_m + half_m)).all(axis=1))

    def _along(self, positions: NDArray[Any]) -> _Floats:
        """(N, 2) from the corner of tile (0, 0) to positions (N, 3), world, m."""
        along: _Floats = positions[:, :2] - self.corner_m
        return along


def neighbours(tile: Tile) -> list[Tile]:
    """A tile and the eight round it, in ascending order."""
    return [(tile[0] + dx, tile[1] + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
