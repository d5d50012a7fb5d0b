# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Grids in two dimensions: heights of the ground, where wheels can go, and what ROS's map_server reads."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from radarsdf.checks import number
from radarsdf.grids.files import write_map_server
from radarsdf.settings import settings

if TYPE_CHECKING:
    from radarsdf.grids.grid import Grid

LETHAL = 100
"""Cost of a column that no wheel can enter, as in ROS."""

_Metres = Annotated[float, Field(gt=0, le=100)]


@settings
class Wheels:
    """Limits of a vehicle, of which costs are shares."""

    max_slope_rad: Annotated[float, Field(gt=0, lt=1.5)] = 0.35
    """The steepest ground that it climbs, rad."""
    max_step_m: _Metres = 0.15
    """The highest step that its wheels climb, m."""
    clearance_m: _Metres = 2.0
    """Its height, m: nothing may hang lower over the ground."""


@dataclass(frozen=True)
class Costmap:
    """Ground and costs in the columns of a grid. NaN, and a cost of -1, where the ground is unknown."""

    height_m: NDArray[np.float32]
    """(X, Y) height of the ground, world, m: the lowest surface with room for the vehicle above it."""
    slope_rad: NDArray[np.float32]
    """(X, Y) of a plane through the heights of a column and its eight neighbours."""
    step_m: NDArray[np.float32]
    """(X, Y) largest difference of height from that plane among them, m."""
    clearance_m: NDArray[np.float32]
    """(X, Y) from the ground to the first occupied voxel above it, m. Infinite where there is none."""
    cost: NDArray[np.int8]
    """(X, Y) 0 to 99, the larger of the shares of the slope and of the step that the vehicle can do; 100 where one of
    them or the clearance is too much for it, -1: unknown."""


@dataclass(frozen=True)
class FlatGrid:
    """Occupied, free and unknown columns of a grid."""

    origin: NDArray[np.float64]
    """(2,) lower corner of column (0, 0), world, m."""
    cell_size: float
    """Edge of a column, m."""
    state: NDArray[np.int8]
    """(X, Y) -1: unknown, 0: free, 1: occupied."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write the grid as ROS's map_server reads it.

        Parameters
        ----------
        path : path-like
            ``NAME.yaml``. The image is written next to it, as ``NAME.pgm``.

        Raises
        ------
        ValueError
            For another suffix.
        OSError
            If a file cannot be written.
        """
        write_map_server(path, self.state, self.origin, self.cell_size)


def costmap(grid: Grid, wheels: Wheels) -> Costmap:
    """See :meth:`Grid.costmap`."""
    height, clearance = _ground(grid)
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


def flat_grid(grid: Grid, lower_m: float, upper_m: float) -> FlatGrid:
    """See :meth:`Grid.flat`."""
    lower_m, upper_m = number(lower_m, "lower_m"), number(upper_m, "upper_m")
    if lower_m >= upper_m:
        msg = f"upper_m must be above lower_m, {lower_m}, not {upper_m}"
        raise ValueError(msg)
    height, _ = _ground(grid)
    top_m = float(grid.origin[2] + grid.shape[2] * grid.voxel_size)
    if not np.isfinite(height).any():
        msg = (
            f"no column shows ground between z = {grid.origin[2]:.2f} and {top_m:.2f} m: choose a box from below the "
            "ground to two voxels or more above it"
        )
        raise ValueError(msg)
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    nearest = distance_transform_edt(np.isnan(height), return_distances=False, return_indices=True)
    base = height[tuple(nearest)]
    above = _z(grid) - base[..., None]
    half = grid.voxel_size / 2
    # Whole voxels: one that only reaches into the heights from below may be of the ground.
    between = (above - half >= lower_m) & (above - half < upper_m)
    occupied = (grid.occupied & between).any(axis=2)
    free = np.where(between, grid.free, True).all(axis=2) & between.any(axis=2)
    # A column whose heights reach out of the box is free only as far as the box is known.
    free &= base + upper_m <= top_m + half
    state = np.full(height.shape, -1, np.int8)
    state[free], state[occupied] = 0, 1
    return FlatGrid(grid.origin[:2].copy(), grid.voxel_size, state)


def _z(grid: Grid) -> NDArray[np.float64]:
    """(Z,) heights of the voxels' centres, world, m."""
    return np.asarray(grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * grid.voxel_size)


def _ground(grid: Grid) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Heights of the ground (X, Y), world, m, and the room above it, m. NaN in columns without.

    The ground of a column is the lowest surface on which the signed distance rises upwards. Its height is where the
    distance is zero, interpolated between the voxels above and below.
    """
    size, z = grid.voxel_size, _z(grid)
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
    # Not the voxels of the ground itself, which are one or two.
    above = np.arange(len(z)) > np.asarray(first + 2)[..., None]
    hanging: NDArray[np.bool_] = grid.occupied & above & found[..., None]
    lowest = hanging.argmax(axis=2)
    room = np.where(hanging.any(axis=2), z[lowest] - size / 2 - height, np.inf)
    clearance = np.where(found, room, np.nan).astype(np.float32)
    return height, clearance


def _planes(height: NDArray[np.float32], size: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slope and largest residual of a plane through each column and its eight neighbours. NaN with fewer than three."""
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
    step = np.fmax.reduce(residual, axis=0)
    slope = np.arctan(np.hypot(plane[..., 1], plane[..., 2]))
    slope, step = (np.where(fits, values, np.nan).astype(np.float32) for values in (slope, step))
    return slope, step
