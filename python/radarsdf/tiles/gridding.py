# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is known of leaf cells in a box that reaches over several tiles."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from radarsdf.map.gridding import CellsInBox, cells_of
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
        found = cells_of(
            tiles.contents_of((x, y)), start - tiles.plan.origin_cells((x, y)), (count_x, count_y, count_z)
        )
        passed[place], returns[place], observed[place] = found
    return CellsInBox(lattice.position(first), passed, returns, observed)
