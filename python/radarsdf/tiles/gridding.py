# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What tiles know place by place, each of its own places: leaf cells in a box, and echoes."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from radarsdf.map.queries import CellsInBox, dense_cells
from radarsdf.returns.view_statistics import EchoesAt
from radarsdf.tiles.blend import TileBlend


def cells_of_tiles(tiles: TileBlend, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> CellsInBox:
    """See :meth:`Map.cells_round`. Each cell is that of the tile that it lies in; of a tile that is not done, unknown."""
    lattice, edge = tiles.config.lattice, tiles.plan.tile_cells
    first = np.floor(lattice.cells(lower)).astype(np.int64)
    last = np.floor(lattice.cells(upper)).astype(np.int64) + 1
    shape = tuple((last - first).tolist())
    passed, returns, observed = np.zeros(shape, np.uint8), np.zeros(shape, bool), np.zeros(shape, bool)
    begin, end = first[:2] // edge, (last[:2] - 1) // edge
    for x, y in itertools.product(range(begin[0], end[0] + 1), range(begin[1], end[1] + 1)):
        if not tiles.has((x, y)):
            continue
        own = np.array([x, y]) * edge
        start = np.array([*np.maximum(own, first[:2]), first[2]])
        stop = np.array([*np.minimum(own + edge, last[:2]), last[2]])
        place = tuple(slice(a, b) for a, b in zip(start - first, stop - first, strict=True))
        count_x, count_y, count_z = (stop - start).tolist()
        found = dense_cells(
            tiles.contents_of((x, y)), start - tiles.plan.origin_cells((x, y)), (count_x, count_y, count_z)
        )
        passed[place], returns[place], observed[place] = found
    return CellsInBox(lattice.position(first), passed, returns, observed)


def echoes_of_tiles(tiles: TileBlend) -> EchoesAt:
    """See :meth:`Map.echoes`. Each is that of the tile that it lies in."""
    scale = tiles.intensity_scale
    ends = (0.0, 1.0) if scale is None else (scale.low, scale.high)
    found = []
    for planned in tiles.tiles:
        contents = tiles.contents_of(planned.tile)
        echoes = contents.echoes.in_world(contents.origin, *ends)
        cells = np.floor(tiles.config.lattice.cells(echoes.points)[:, :2])
        found.append(echoes.select((cells // tiles.plan.tile_cells == planned.tile).all(axis=1)))
    return EchoesAt.together(found)
