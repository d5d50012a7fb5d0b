"""Distances from the voxels of a grid to its surface and to obstacles, and their interpolation for planners."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.arrays import Bools, Floats, Floats32, Ints
from radarsdf.checks import check, real_array

# Voxels behind a surface with negative distances: √3 from the centre of an occupied one, which is up to 0.75 from the surface.
_BEHIND = 2.5
_FAR_M = np.float32(1e30)  # stands for infinity, whose differences are NaN


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
    """Half a diagonal of a voxel plus the position error of the surface, m. Not an upper bound: false returns and missing
    surface add to it."""

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
        place = (checked_positions(x).T.copy() - self.origin[:, None]) / self.voxel_size + 0.5
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
        """Return :attr:`surface_m`, extrapolated by a voxel, and :attr:`known`."""
        surface_m = np.minimum(self.surface_m, _FAR_M)
        return np.pad(surface_m, 1, mode="reflect", reflect_type="odd"), np.pad(self.known, 1)


def checked_positions(x: ArrayLike) -> Floats:
    """Convert to positions (N, 3) float64. Raises a ValueError for another shape."""
    positions: Floats = real_array(x, "positions")
    rows = positions.ndim == 2 and positions.shape[1] == 3
    check(rows, f"positions must have shape (N, 3), not {positions.shape}")
    return positions


def checked_obstacles(obstacles: ArrayLike | None) -> Floats:
    """Convert points (K, 3) or boxes (K, 2, 3) to boxes. Raises a ValueError if they are neither."""
    boxes: Floats = real_array(np.zeros((0, 2, 3)) if obstacles is None else obstacles, "obstacles")
    if boxes.ndim == 2:
        boxes = np.stack([boxes, boxes], axis=1)
    fits = boxes.shape[1:] == (2, 3) and np.isfinite(boxes).all() and (boxes[:, 0] <= boxes[:, 1]).all()
    check(
        fits,
        f"obstacles must be finite points (K, 3) or boxes (K, 2, 3), not {boxes.shape} or upper corners first",
    )
    return boxes


def distances_to_boxes(
    centres: Floats, boxes: Floats, normals: Floats, of_voxels: Ints, free: Bools, voxel_m: float
) -> Floats32:
    """Compute signed distances (Y, Z), m, from centres (Y, Z, 3) to boxes (K, 2, 3), by their rows `of_voxels` (Y, Z).

    A box without extent is a point of a surface with its normal (K, 3). Behind it, distances are negative in voxels that are
    not `free` (Y, Z).
    """
    lower, upper = np.moveaxis(boxes[of_voxels], -2, 0)
    away = centres - np.clip(centres, lower, upper)
    found_m = np.linalg.norm(away, axis=-1)
    behind = ~free & (np.einsum("yzi,yzi->yz", away, normals[of_voxels]) < 0)
    found_m[behind & (found_m < _BEHIND * voxel_m)] *= -1
    depth_m = np.minimum(centres - lower, upper - centres).min(axis=-1)
    return np.where(depth_m > 0, -depth_m, found_m).astype(np.float32)
