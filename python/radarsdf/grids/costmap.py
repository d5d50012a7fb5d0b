# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Heights of the ground in a grid, and where wheels can go."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from radarsdf.settings import settings

if TYPE_CHECKING:
    from radarsdf.grids.grid import Grid

LETHAL = 100
"""Cost of a column that no wheel can enter, as in ROS."""

_Metres = Annotated[float, Field(gt=0, le=100)]


@settings
class Wheels:
    """What a vehicle can do."""

    max_slope_rad: Annotated[float, Field(gt=0, lt=1.5)] = 0.35
    """The steepest ground that it climbs, rad."""
    max_step_m: _Metres = 0.15
    """The highest step that its wheels climb, m."""
    clearance_m: _Metres = 2.0
    """Its height, m: nothing may hang lower over the ground."""


@dataclass(frozen=True)
class Costmap:
    """Columns of a grid. NaN, and a cost of -1, where the ground is unknown."""

    height_m: NDArray[np.float32]
    """(X, Y) height of the ground, world, m: the lowest surface with room for the vehicle above it."""
    slope_rad: NDArray[np.float32]
    """(X, Y) of a plane through the heights of a column and the eight round it."""
    step_m: NDArray[np.float32]
    """(X, Y) largest difference of height from that plane among them, m."""
    clearance_m: NDArray[np.float32]
    """(X, Y) from the ground to what is occupied above it, m. Infinite where nothing is."""
    cost: NDArray[np.int8]
    """(X, Y) 0 to 99, the larger of the shares of the slope and of the step that the vehicle can do; 100 where one of
    them or the clearance is too much for it, -1: unknown."""


def costmap(grid: Grid, wheels: Wheels) -> Costmap:
    """See :meth:`Grid.costmap`."""
    height, clearance = ground(grid)
    # A column of walls alone has no ground, but nothing can stand there.
    blocked = np.isnan(height) & grid.occupied.any(axis=2)
    with np.errstate(invalid="ignore"):
        blocked |= clearance < wheels.clearance_m
    slope, step = _planes(height, grid.voxel_size)
    effort = np.fmax(slope / wheels.max_slope_rad, step / wheels.max_step_m)
    cost = np.full(height.shape, -1, np.int8)
    known = np.isfinite(effort)
    cost[known] = np.minimum(99, np.floor(99 * effort[known])).astype(np.int8)
    cost[(known & (effort > 1)) | blocked] = LETHAL
    return Costmap(height, slope, step, clearance, cost)


def ground(grid: Grid) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Heights of the ground (X, Y), world, m, and the room above it, m. NaN in columns without.

    The ground of a column is the lowest surface on which the signed distance rises upwards. Its height is where the
    distance is zero, by the two voxels above and below: finer than a voxel.
    """
    size = grid.voxel_size
    z = grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * size
    # Above the uppermost voxels nothing is known.
    lower, occupied = grid.distance_m, np.pad(grid.occupied, ((0, 0), (0, 0), (0, 1)))
    upper = np.concatenate([lower[..., 1:], np.full_like(lower[..., :1], np.nan)], axis=2)
    with np.errstate(invalid="ignore"):
        up = (lower <= 0) & (upper > 0) & (occupied[..., :-1] | occupied[..., 1:])
        share = np.where(up, lower / (lower - upper), 0)
    found: NDArray[np.bool_] = np.asarray(up.any(axis=2))
    first = up.argmax(axis=2)
    share = np.take_along_axis(share, first[..., None], 2)[..., 0]
    height = np.where(found, z[first] + share * size, np.nan).astype(np.float32)
    # What is occupied above: not the voxels of the ground itself, which are one or two.
    above = np.arange(grid.shape[2]) > np.asarray(first + 2)[..., None]
    hanging: NDArray[np.bool_] = grid.occupied & above & found[..., None]
    lowest = hanging.argmax(axis=2)
    room = np.where(hanging.any(axis=2), z[lowest] - size / 2 - height, np.inf)
    clearance = np.where(found, room, np.nan).astype(np.float32)
    return height, clearance


def _planes(height: NDArray[np.float32], size: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slope and largest residual of a plane through each column and the eight round it. NaN with fewer than three."""
    padded = np.pad(height.astype(np.float64), 1, constant_values=np.nan)
    x, y = height.shape
    shifts = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    stack = np.stack([padded[1 + i : 1 + i + x, 1 + j : 1 + j + y] for i, j in shifts])  # (9, X, Y)
    known = np.isfinite(stack)
    design = np.array([[1.0, i * size, j * size] for i, j in shifts])
    weights = known.astype(np.float64)
    normal = np.einsum("kxy,ka,kb->xyab", weights, design, design)
    right = np.einsum("kxy,ka->xya", np.where(known, stack, 0), design)
    fits = np.linalg.det(normal) > 1e-6 * size**4
    fits &= known[4]  # the column itself
    safe = np.where(fits[..., None, None], normal, np.eye(3))
    plane = np.linalg.solve(safe, right[..., None])[..., 0]
    residual = np.abs(stack - np.einsum("ka,xya->kxy", design, plane))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns without a height
        step = np.nanmax(residual, axis=0)
    slope = np.arctan(np.hypot(plane[..., 1], plane[..., 2]))
    return (
        np.where(fits, slope, np.nan).astype(np.float32),
        np.where(fits, step, np.nan).astype(np.float32),
    )
