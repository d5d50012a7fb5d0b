# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The part of a map in tiles that a radar can see from a pose."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from radarsdf.budget.estimate import check_views
from radarsdf.map.mesh import Surface
from radarsdf.map.view import ViewedMap
from radarsdf.tiles.blend import TileBlend
from radarsdf.tiles.grid import Tile
from radarsdf.tiles.pieces import PieceSettings, piece_of

_Floats = NDArray[np.float64]


def tiles_within(city: TileBlend, position: _Floats, range_m: float) -> list[Tile]:
    """The tiles that are done and within a horizontal range of a position (3,), world, m."""
    grid = city.plan.grid
    first, last = (grid.tiles_of(position[None] + way)[0] for way in (-range_m, range_m))
    found = []
    for planned in city.plan.tiles:
        tile = planned.tile
        if (np.array(tile) >= first).all() and (np.array(tile) <= last).all() and city.has(tile):
            lower = grid.lower_corner(tile)
            nearest = np.clip(position[:2], lower, lower + grid.tile_m)
            if np.linalg.norm(nearest - position[:2]) <= range_m:
                found.append(tile)
    return found


def viewed_tiles(
    city: TileBlend, tiles: list[Tile], intensity: Callable[[_Floats, _Floats], NDArray[np.float64]] | None
) -> ViewedMap:
    """What views need of some tiles. `intensity`: of points (N, 3) seen from a sensor (3,), both in the world, m."""
    config = city.config
    cells = sum(len(city.contents_of(tile).evidence.looks) for tile in tiles)
    check_views(config.max_memory_bytes, cells=cells)
    origin = config.lattice.position(city.plan.origin_cells(tiles[0]))
    everything = PieceSettings(1, None, math.inf)
    pieces = [piece_of(city, tile, everything) for tile in tiles]
    before = np.cumsum([0, *[len(piece.vertices) for piece in pieces]])
    together = np.concatenate([piece.vertices for piece in pieces])
    # Pieces share the vertices on their borders, to the bit.
    vertices, rows = np.unique(together, axis=0, return_inverse=True)
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, before, strict=False)])
    surface = Surface.told_by(
        city.any_contents,
        vertices - origin,
        rows.ravel()[faces].astype(np.int32),
        city.evidence(vertices),
        cells,
    )

    def local_intensity(points: _Floats, position: _Floats) -> NDArray[np.float32]:
        assert intensity is not None
        return intensity(points + origin, position + origin).astype(np.float32)

    return ViewedMap.of_surface(
        surface,
        city.any_contents,
        origin,
        lambda points: city.evidence(points + origin),
        None if intensity is None else local_intensity,
    )
