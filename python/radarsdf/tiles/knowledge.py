# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How far points lie inside what a tile observed, so that its weight falls to zero where it stops knowing."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from radarsdf._core import cell_keys
from radarsdf.map import queries
from radarsdf.map.contents import MapContents

_Floats = NDArray[np.float64]
_ROUND = np.array([way for way in itertools.product((-1, 0, 1), repeat=3) if any(way)])
_LEAST = 1e-6  # of points on the border itself, which are observed, and which were moved inwards


def knowledge(contents: MapContents, points: Tensor) -> tuple[_Floats, _Floats]:
    """What a tile counts at points (M, 3), local frame, m: (M,) in [0, 1], and the derivatives (M, 3), 1/m.

    It is the distance to the nearest leaf cell that the tile has not observed, in leaf cells and along the axis where it is
    largest, at most one. Outside of the observed cells it is 0.
    """
    known, slopes = np.zeros(len(points)), np.zeros((len(points), 3))
    inside = np.flatnonzero(queries.occupied(contents, points).numpy())
    size_m = contents.field.cells.table.leaf_size_m
    place = points.numpy()[inside] * np.float32(1 / size_m)  # rounded as the core does it: in the same cell
    cell = np.floor(place)
    _, first, of_point = np.unique(
        cell_keys(points.numpy()[inside], size_m), return_index=True, return_inverse=True
    )
    centres = (cell[first][:, None, :] + (_ROUND + 0.5).astype(np.float32)) * np.float32(size_m)
    lacks = ~queries.occupied(contents, torch.from_numpy(centres.reshape(-1, 3)))
    lacks_round: NDArray[np.bool_] = lacks.numpy().reshape(-1, len(_ROUND))
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
