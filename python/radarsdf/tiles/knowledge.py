# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How far points are from what a tile lacks and others observed, so that its weight falls to zero there."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from radarsdf._core import cell_keys
from radarsdf.map import queries
from radarsdf.map.contents import MapContents

_Floats = NDArray[np.float64]
_Cells = NDArray[np.int64]
_ROUND = np.array([way for way in itertools.product((-1, 0, 1), repeat=3) if any(way)])
_LEAST = 1e-6  # of points on the border itself, which are observed, and which were moved inwards


def cells_of(contents: MapContents, points: Tensor) -> _Cells:
    """(M, 3) the leaf cells of points (M, 3), local frame, m, from the origin of their map."""
    size_m = contents.field.table.leaf_size_m
    return np.floor(_places(points, size_m)).astype(np.int64)


def holds(contents: MapContents, cells: _Cells) -> NDArray[np.bool_]:
    """(M,) whether a tile observed these leaf cells (M, 3), from its origin."""
    size_m = contents.field.table.leaf_size_m
    centres = (cells + 0.5).astype(np.float32) * np.float32(size_m)
    # The core looks them up on all threads: queries would start threads of their own.
    return contents.field.occupied(torch.from_numpy(centres)).numpy()


def knowledge(
    contents: MapContents, points: Tensor, counts: Callable[[_Cells], NDArray[np.bool_]]
) -> tuple[_Floats, _Floats]:
    """What a tile counts at points (M, 3), local frame, m: (M,) in [0, 1], and the derivatives (M, 3), 1/m.

    It is the distance to the nearest leaf cell that another tile has observed and this one has not, in leaf cells and along
    the axis where it is largest, at most one. Outside of the cells that it observed it is 0.

    `counts`: of cells (K, 3) from the tile's origin, which are observed in the city, (K,) bool.
    """
    known, slopes = np.zeros(len(points)), np.zeros((len(points), 3))
    inside = np.flatnonzero(queries.occupied(contents, points).numpy())
    size_m = contents.field.table.leaf_size_m
    place = _places(points[torch.from_numpy(inside)], size_m)
    cell = np.floor(place)
    _, first, of_point = np.unique(
        cell_keys(points.numpy()[inside], size_m), return_index=True, return_inverse=True
    )
    cells = cell[first].astype(np.int64)
    observed = counts(cells)[of_point]
    inside, of_point, place, cell = inside[observed], of_point[observed], place[observed], cell[observed]
    around = (cells[:, None, :] + _ROUND).reshape(-1, 3)
    lacks = counts(around)
    lacks[lacks] = ~holds(contents, around[lacks])
    lacks_round: NDArray[np.bool_] = lacks.reshape(-1, len(_ROUND))
    known[inside] = 1 - queries.INWARD
    near = np.any(lacks_round, axis=1)[of_point]
    inside, of_point = inside[near], of_point[near]
    below = (place - cell)[near].astype(np.float64)
    nearest, ways = np.ones(len(inside)), np.zeros((len(inside), 3))
    for way, lacked in zip(_ROUND, lacks_round.T, strict=True):
        to_cell = np.where(way < 0, below, 1 - below) * (way != 0)
        axis = to_cell.argmax(axis=1)
        distance = to_cell.max(axis=1)
        rows = np.flatnonzero(lacked[of_point] & (distance < nearest))
        nearest[rows] = distance[rows]
        ways[rows] = 0
        ways[rows, axis[rows]] = -way[axis[rows]]
    known[inside] = np.maximum(nearest - queries.INWARD, _LEAST)
    slopes[inside] = ways / size_m
    return known, slopes


def _places(points: Tensor, size_m: float) -> NDArray[np.float32]:
    """(M, 3) in leaf cells. Rounded as the core does it: in the same cell."""
    places: NDArray[np.float32] = points.numpy() * np.float32(1 / size_m)
    return places
