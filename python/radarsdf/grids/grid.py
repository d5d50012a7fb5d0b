"""Voxel grid of a box of the world, occupied, free and unknown, and the quantities that planners derive from it."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.ndimage import distance_transform_edt

from radarsdf.arrays import ArrayLike, Bools, Floats, Floats32, Ints, NDArray
from radarsdf.checks import AnyPath, check, number, path_of, real_array
from radarsdf.grids.files import write_map_server, write_octomap, write_vdb
from radarsdf.io.files import checked_suffix
from radarsdf.io.npz import write_arrays
from radarsdf.map.map import as_positions
from radarsdf.settings import settings

UNKNOWN, FREE, OCCUPIED = -1, 0, 1
LETHAL = 100
"""Cost of a column that the vehicle cannot enter, as in ROS."""
DISTANCE_SUFFIXES = (".npz", ".vdb")
_Metres = Annotated[float, Field(gt=0, le=100)]

# Voxels behind a surface with negative distances: √3 from the centre of an occupied one, which is up to 0.75 from the surface.
_BEHIND = 2.5
_FAR_M = np.float32(1e30)  # stands for infinity, whose differences are NaN


@settings
class Wheels:
    """Limits of a vehicle. Costs are relative to them."""

    max_slope_rad: Annotated[float, Field(gt=0, lt=1.5)] = 0.35
    """Steepest ground that the vehicle climbs, rad."""
    max_step_m: _Metres = 0.15
    """Highest step that its wheels climb, m."""
    clearance_m: _Metres = 2.0
    """Its height, m: overhanging objects must be higher above the ground."""


@dataclass(frozen=True)
class Costmap:
    """Ground and costs by column of a grid. NaN, and a cost of -1, where the ground is unknown."""

    height_m: Floats32
    """(X, Y) height of the ground, world, m: the lowest surface that faces upwards."""
    slope_rad: Floats32
    """(X, Y) slope of the plane fitted to the heights of a column and its eight neighbours, rad."""
    step_m: Floats32
    """(X, Y) largest residual of these heights, m."""
    clearance_m: Floats32
    """(X, Y) distance from the ground to the first occupied voxel above it, m. Infinite where there is none."""
    cost: NDArray[np.int8]
    """(X, Y) 0 to 99: larger ratio of slope and step to their limits; 100: beyond a limit, or too low; -1: unknown."""


@dataclass(frozen=True)
class FlatGrid:
    """Two-dimensional grid of occupied, free and unknown columns."""

    origin: Floats
    """(2,) lower corner of column (0, 0), world, m."""
    cell_size: float
    """Edge of a column, m."""
    state: NDArray[np.int8]
    """(X, Y) -1: unknown, 0: free, 1: occupied."""
    ground_m: float
    """Median height of the ground, world, m."""

    def save(self, path: AnyPath) -> None:
        """Write the grid in the format of ROS's map_server: ``NAME.yaml``, which is `path`, and the image ``NAME.pgm``.

        Raises a ValueError for another suffix, an OSError if a file cannot be written.
        """
        write_map_server(path_of(path, "path"), self.state, self.origin, self.cell_size)


@dataclass(frozen=True)
class DistanceField:
    """Euclidean distances from the centre of each voxel of a grid."""

    origin: Floats
    """(3,) lower corner of the grid, world, m."""
    voxel_size: float
    """Edge of a voxel, m."""
    known: Bools
    """(X, Y, Z) whether the voxel is free or occupied."""
    occupied_m: Floats32
    """(X, Y, Z) distance to the centre of the nearest occupied voxel, m; in occupied voxels the negative distance to the
    nearest other one. Unknown voxels do not count: infinite if nothing is occupied."""
    not_free_m: Floats32
    """(X, Y, Z) distance to the centre of the nearest voxel that is not free or outside the grid, m; 0 if not free."""
    surface_m: Floats32
    """(X, Y, Z) distance to the surface in the nearest occupied voxel, or to the obstacle there, m. Negative inside obstacles
    and up to 2.5 voxels behind the surface; infinite if nothing is occupied."""
    error_m: float
    """Half a diagonal of a voxel plus the position error of the surface, m. False returns and missing surface add to it."""

    def at(self, x: ArrayLike) -> tuple[Floats32, Floats32]:
        """Interpolate :attr:`surface_m` trilinearly at positions `x` (N, 3), world, m. Raises a ValueError for another shape.

        Returns
        -------
        distance_m : (N,) float32
            NaN in unknown voxels, outside the grid, and at non-finite positions.
        gradient : (N, 3) float32
            Its derivatives along x, y and z, NaN where it is; 0 if nothing is occupied.
        """
        values, known = self._padded
        i, j, k = (n // values.itemsize for n in values.strides)
        place = (as_positions(x)[0].T.copy() - self.origin[:, None]) / self.voxel_size + 0.5
        # Positions outside, and NaN, are moved into the padding, which is unknown.
        place = np.fmax(np.fmin(place, np.array(self.known.shape)[:, None] + 0.999), 0)
        voxels = place.astype(np.int64)
        u, v, w = across = (place - voxels).astype(np.float32)
        first = i * voxels[0] + j * voxels[1] + k * voxels[2]
        steps = np.array([a * i + b * j + c * k for a, b, c in np.ndindex(2, 2, 2)])
        corners = values.take(first + steps[:, None], mode="clip").reshape(2, 2, 2, -1)
        # Derivatives along z and y at the corners that remain, then values and derivatives at the positions.
        along_z = corners[:, :, 1] - corners[:, :, 0]
        corners = corners[:, :, 0] + w * along_z
        along_y = corners[:, 1] - corners[:, 0]
        corners = corners[:, 0] + v * along_y
        along_z = along_z[:, 0] + v * (along_z[:, 1] - along_z[:, 0])
        along_x = corners[1] - corners[0]
        slopes = [along_x, *(low + u * (high - low) for low, high in (along_y, along_z))]
        found = np.stack([corners[0] + u * along_x, *slopes])
        found[1:] /= self.voxel_size
        if values[0, 0, 0] >= _FAR_M:
            found[0] = np.inf
        nearest = across >= 0.5
        found[:, ~known.take(first + i * nearest[0] + j * nearest[1] + k * nearest[2])] = np.nan
        return found[0], found[1:].T

    @cached_property
    def _padded(self) -> tuple[Floats32, Bools]:
        surface_m = np.minimum(self.surface_m, _FAR_M)
        return np.pad(surface_m, 1, mode="reflect", reflect_type="odd"), np.pad(self.known, 1)


@dataclass(frozen=True)
class Grid:
    """Voxel grid of a box of the world, created by :func:`radarsdf.grid`.

    Voxel (i, j, k) spans ``origin + [i, j, k] * voxel_size`` to ``origin + [i + 1, j + 1, k + 1] * voxel_size``.
    """

    origin: Floats
    """(3,) lower corner of voxel (0, 0, 0), world, m: a multiple of the voxel along each axis."""
    voxel_size: float
    """Edge of a voxel, m."""
    state: NDArray[np.int8]
    """(X, Y, Z) -1: unknown, 0: free, 1: occupied."""
    probability: Floats32
    """(X, Y, Z) probability of a surface in the voxel. NaN without rays and returns there."""
    distance_m: Floats32
    """(X, Y, Z) signed distance of the map at the voxel's centre, m, positive in free space; NaN where not observed."""
    position_error_m: float
    """95 % quantile, over occupied voxels, of the half width of the 95 % confidence interval of the surface's position, m."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        x, y, z = self.state.shape
        return x, y, z

    @property
    def free(self) -> Bools:
        """(X, Y, Z) whether rays crossed the voxel and nothing is in it."""
        return np.equal(self.state, FREE)

    @property
    def occupied(self) -> Bools:
        """(X, Y, Z) whether the voxel probably contains a surface."""
        return np.equal(self.state, OCCUPIED)

    @property
    def unknown(self) -> Bools:
        """(X, Y, Z) whether the voxel is neither free nor occupied."""
        return np.equal(self.state, UNKNOWN)

    def centres(self, which: Bools | None = None) -> Floats:
        """Return the centres (N, 3) float64, world, m, in C order, of all voxels, or of a mask (X, Y, Z), such as :attr:`free`."""
        voxels = np.argwhere(np.ones(self.shape, bool) if which is None else which)
        return self.origin + (voxels + 0.5) * self.voxel_size

    def at(self, x: ArrayLike) -> NDArray[np.int8]:
        """Return the :attr:`state` (N,) int8 of the voxels that contain positions `x` (N, 3), world, m.

        It is unknown outside the grid, and at non-finite positions. Raises a ValueError for another shape.
        """
        positions, _ = as_positions(x)
        voxels = np.nan_to_num(np.floor((positions - self.origin) / self.voxel_size), nan=-1)
        inside = ((voxels >= 0) & (voxels < self.shape)).all(axis=1)
        found = np.full(len(positions), UNKNOWN, np.int8)
        found[inside] = self.state[tuple(voxels[inside].astype(np.int64).T)]
        return found

    def distances(self, obstacles: ArrayLike | None = None) -> DistanceField:
        """Compute Euclidean distances to the surface, to occupied voxels, and to voxels that are not free.

        Parameters
        ----------
        obstacles : (K, 3) or (K, 2, 3) array_like, optional
            Known obstacles that the map lacks, world, m: points, or boxes with the lower corner first. Voxels that they touch
            count as occupied; outside the grid they are ignored. Others raise a ValueError.
        """

        def to_nearest(others: Bools, beyond: bool) -> Floats32:
            """Return distances to the nearest voxel outside the mask `others`. `beyond`: the outside of the grid counts."""
            mask = np.pad(others, 1, constant_values=not beyond)
            return distance_transform_edt(mask, self.voxel_size)[1:-1, 1:-1, 1:-1].astype(np.float32)

        stamped, size = _checked_obstacles(obstacles), self.voxel_size
        points, normals = self._surface()
        state, rows = self.state.copy(), np.full(self.shape, -1)
        rows[self.occupied] = np.arange(len(points))
        corners = np.floor((stamped - self.origin) / size).clip(-1, self.shape).astype(np.int64)
        for k, (first, last) in enumerate(corners):
            touched = tuple(map(slice, first.clip(0), last + 1))
            state[touched], rows[touched] = OCCUPIED, len(points) + k
        boxes = np.concatenate([np.stack([points, points], axis=1), stamped])
        normals = np.concatenate([normals, np.zeros((len(stamped), 3))])
        occupied, free = state == OCCUPIED, state == FREE
        occupied_m, surface_m = np.full((2, *self.shape), np.inf, np.float32)
        if occupied.any():
            away_m, nearest = distance_transform_edt(~occupied, size, return_indices=True)
            occupied_m = np.where(occupied, -to_nearest(occupied, True), away_m.astype(np.float32))
            nearest, centres = rows[tuple(nearest)], self.centres().reshape(*self.shape, 3)
            for x, columns in enumerate(centres):  # memory
                surface_m[x] = _distances_to_boxes(columns, boxes, normals, nearest[x], free[x], size)
        error_m = math.sqrt(3) / 2 * size + self.position_error_m
        of_space = state != UNKNOWN, occupied_m, to_nearest(free, True), surface_m
        return DistanceField(self.origin, size, *of_space, error_m)

    def _surface(self) -> tuple[Floats, Floats]:
        """Return points (N, 3), world, m, on the surface in the occupied voxels, and its unit normals, 0 where unknown."""
        voxels, distance_m = np.argwhere(self.occupied), np.nan_to_num(self.distance_m[self.occupied])
        padded = np.pad(self.distance_m, 1, constant_values=np.nan)
        normals = np.zeros(voxels.shape)
        for axis in range(3):
            line = [padded[tuple((voxels + 1 + step * np.eye(3, dtype=int)[axis]).T)] for step in (-1, 0, 1)]
            slopes = np.diff(line, axis=0)  # one of both is unknown where the surface ends
            normals[:, axis] = np.nansum(slopes, axis=0) / np.isfinite(slopes).sum(axis=0).clip(1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
        return self.centres(self.occupied) - distance_m[:, None] * normals, normals

    def costmap(self, wheels: Wheels | None = None) -> Costmap:
        """Compute heights of the ground, and costs for a vehicle with these limits; by default, those of a car."""
        wheels = Wheels() if wheels is None else wheels
        height, clearance = self._ground()
        # A column with walls alone has no ground, but cannot be entered.
        blocked = np.isnan(height) & self.occupied.any(axis=2)
        with np.errstate(invalid="ignore"):
            blocked |= clearance < wheels.clearance_m
        slope, step = _planes(height, self.voxel_size)
        effort = np.fmax(slope / wheels.max_slope_rad, step / wheels.max_step_m)
        cost = np.full(height.shape, -1, np.int8)
        known = np.isfinite(effort)
        cost[known] = np.minimum(99, np.floor(99 * effort[known])).astype(np.int8)
        cost[(known & (effort > 1)) | blocked] = LETHAL
        return Costmap(height, slope, step, clearance, cost)

    def flat(self, lower_m: float = 0.3, upper_m: float = 2.0) -> FlatGrid:
        """Project the voxels between two heights above the ground to a two-dimensional grid for ROS's map_server.

        Raises a ValueError if the heights are not ascending, or no column of the grid shows ground.

        Parameters
        ----------
        lower_m, upper_m : float
            Heights above the ground of the column, or of the nearest with known ground, m, of what the vehicle may hit.

        Returns
        -------
        FlatGrid
            A column is occupied if any voxel between the heights is, free if all are.
        """
        ascending = number(lower_m, "lower_m") < number(upper_m, "upper_m")
        check(ascending, f"upper_m must be above lower_m, {lower_m}, not {upper_m}")
        height, _ = self._ground()
        top_m = float(self.origin[2] + self.shape[2] * self.voxel_size)
        ground = np.isfinite(height).any()
        check(ground, "no column of the grid shows ground: choose a box from below it to above it")
        nearest = distance_transform_edt(np.isnan(height), return_distances=False, return_indices=True)
        base = height[tuple(nearest)]
        above, half = self._z() - base[..., None], self.voxel_size / 2
        # Whole voxels: one that extends below `lower_m` may belong to the ground.
        between = (above - half >= lower_m) & (above - half < upper_m)
        free = np.where(between, self.free, True).all(axis=2) & between.any(axis=2)
        # A column with `upper_m` above the top of the box is not free: the box does not cover it.
        free &= base + upper_m <= top_m + half
        state = np.full(height.shape, UNKNOWN, np.int8)
        state[free], state[(self.occupied & between).any(axis=2)] = FREE, OCCUPIED
        return FlatGrid(self.origin[:2].copy(), self.voxel_size, state, float(np.nanmedian(height)))

    def save(self, path: AnyPath) -> None:
        """Write the grid to a file: ``.npz``, all arrays by name, or ``.bt``, OctoMap's binary octree of occupied and free voxels.

        An existing file is replaced only once the new one is complete. Raises a ValueError for another suffix, or a ``.bt`` beyond
        32,768 voxels from the world's origin, or not at a multiple of its voxels; an OSError if the file cannot be written.
        """
        if checked_suffix(path, (".npz", ".bt"), "grids") == ".npz":
            write_arrays(path, vars(self), compressed=True)
        else:
            write_octomap(Path(path), self.state, self.origin, self.voxel_size)

    def _z(self) -> Floats:
        """Return the heights (Z,) of the voxels' centres, world, m."""
        return np.asarray(self.origin[2] + (np.arange(self.shape[2]) + 0.5) * self.voxel_size)

    def _ground(self) -> tuple[Floats32, Floats32]:
        """Return the heights (X, Y) of the ground, world, m, and the clearance above it, m. NaN in columns without ground."""
        # The lowest surface on which the signed distance increases upwards, at its zero crossing between two voxels.
        z = self._z()
        # Nothing is known above the top voxels.
        lower, occupied = self.distance_m, np.pad(self.occupied, ((0, 0), (0, 0), (0, 1)))
        upper = np.concatenate([lower[..., 1:], np.full_like(lower[..., :1], np.nan)], axis=2)
        with np.errstate(invalid="ignore"):
            up = (lower <= 0) & (upper > 0) & (occupied[..., :-1] | occupied[..., 1:])
            share = np.divide(lower, lower - upper, out=np.zeros_like(lower), where=up)
        found = np.asarray(up.any(axis=2))
        first = up.argmax(axis=2)
        share = np.take_along_axis(share, first[..., None], 2)[..., 0]
        height = np.where(found, z[first] + share * self.voxel_size, np.nan).astype(np.float32)
        # Exclude the voxels of the ground itself, one or two.
        above = np.arange(len(z)) > np.asarray(first + 2)[..., None]
        hanging = self.occupied & above & found[..., None]
        room = np.where(hanging.any(axis=2), z[hanging.argmax(axis=2)] - self.voxel_size / 2 - height, np.inf)
        return height, np.where(found, room, np.nan).astype(np.float32)


def save_arrays(path: Path, grid: Grid, found: Costmap | DistanceField) -> None:
    """Write costs or distances, with the grid's `origin` and `voxel_size`, to an ``.npz``; distances also to a ``.vdb``."""
    if path.suffix.lower() == ".vdb" and isinstance(found, DistanceField):
        write_vdb(path, found.surface_m, found.known, found.origin, found.voxel_size)
        return
    arrays = {name: values for name, values in vars(found).items() if not name.startswith("_")}
    write_arrays(path, {"origin": grid.origin, "voxel_size": grid.voxel_size, **arrays}, compressed=True)


def _planes(height: Floats32, size: float) -> tuple[Floats32, Floats32]:
    """Fit a plane to each column and its eight neighbours: slope and largest residual. NaN with fewer than three heights."""
    padded = np.pad(height.astype(np.float64), 1, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*height.shape, 9)
    known = np.isfinite(around)
    design = np.array([[1.0, i * size, j * size] for i, j in np.ndindex(3, 3)])
    normal = np.einsum("xyk,ka,kb->xyab", known.astype(np.float64), design, design)
    right = np.einsum("xyk,ka->xya", np.where(known, around, 0), design)
    fits = (np.linalg.det(normal) > 1e-6 * size**4) & known[..., 4]  # index 4: the column itself
    plane = np.full((*height.shape, 3), np.nan)
    plane[fits] = np.linalg.solve(normal[fits], right[fits, :, None])[..., 0]
    step = np.fmax.reduce(np.abs(around - np.einsum("ka,xya->xyk", design, plane)), axis=-1)
    slope = np.arctan(np.hypot(plane[..., 1], plane[..., 2]))
    return slope.astype(np.float32), step.astype(np.float32)


def _checked_obstacles(obstacles: ArrayLike | None) -> Floats:
    boxes: Floats = real_array(np.zeros((0, 2, 3)) if obstacles is None else obstacles, "obstacles")
    if boxes.ndim == 2:
        boxes = np.stack([boxes, boxes], axis=1)
    fits = boxes.shape[1:] == (2, 3) and np.isfinite(boxes).all() and (boxes[:, 0] <= boxes[:, 1]).all()
    check(fits, f"obstacles must be finite, (K, 3) or (K, 2, 3) with lower corners first, not {boxes.shape}")
    return boxes


def _distances_to_boxes(
    centres: Floats, boxes: Floats, normals: Floats, of_voxels: Ints, free: Bools, voxel_m: float
) -> Floats32:
    """Compute signed distances (Y, Z), m, from centres (Y, Z, 3) to boxes (K, 2, 3), by their rows `of_voxels` (Y, Z).

    A box without extent is a point of a surface with its normal (K, 3), with negative distances behind it unless `free` (Y, Z).
    """
    lower, upper = np.moveaxis(boxes[of_voxels], -2, 0)
    away = centres - np.clip(centres, lower, upper)
    found_m = np.linalg.norm(away, axis=-1)
    behind = ~free & (np.einsum("yzi,yzi->yz", away, normals[of_voxels]) < 0)
    found_m[behind & (found_m < _BEHIND * voxel_m)] *= -1
    depth_m = np.minimum(centres - lower, upper - centres).min(axis=-1)
    return np.where(depth_m > 0, -depth_m, found_m).astype(np.float32)
