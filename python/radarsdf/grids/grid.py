# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A box of the world in voxels: occupied, free and unknown."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import path_of, real_array
from radarsdf.grids.costmap import Costmap, FlatGrid, Wheels, costmap, flat_grid
from radarsdf.grids.files import check_arrays_path, write_grid
from radarsdf.io.npz import write_arrays

UNKNOWN, FREE, OCCUPIED = -1, 0, 1


@dataclass(frozen=True)
class DistanceField:
    """Euclidean distances from the centre of each voxel of a grid."""

    occupied_m: NDArray[np.float32]
    """(X, Y, Z) to the centre of the nearest occupied voxel, m; in occupied ones minus that to the nearest other one. The
    unknown does not count: infinite if nothing is occupied."""
    not_free_m: NDArray[np.float32]
    """(X, Y, Z) to the centre of the nearest voxel that is not free, m: what is unknown, and what is beyond the grid,
    counts as occupied. 0 in voxels that are not free. So far a robot may go whatever is in the unknown."""
    unknown: NDArray[np.bool_]
    """(X, Y, Z) voxels that are unknown."""
    error_m: float
    """Half a diagonal of a voxel, and the error of the surface's position, m: what voxels and noise add where the map has the
    surface right. It is no bound on the distance to the truth: false returns that are called occupied make `occupied_m` too
    small, and surface that the map does not have makes it too large."""


@dataclass(frozen=True)
class Grid:
    """Voxels of a box of the world, made by :func:`radarsdf.grid`.

    Voxel (i, j, k) spans ``origin + [i, j, k] * voxel_size`` to ``origin + [i + 1, j + 1, k + 1] * voxel_size``.
    """

    origin: NDArray[np.float64]
    """(3,) lower corner of voxel (0, 0, 0), world, m: a multiple of the voxel along each axis."""
    voxel_size: float
    """Edge of a voxel, m."""
    state: NDArray[np.int8]
    """(X, Y, Z) -1: unknown, 0: free, 1: occupied."""
    probability: NDArray[np.float32]
    """(X, Y, Z) probability that there is a surface in the voxel. NaN without rays and returns there."""
    distance_m: NDArray[np.float32]
    """(X, Y, Z) the map's signed distance at the centre of the voxel, m, positive in free space. NaN where it was not
    observed."""
    position_error_m: float
    """The position of the surface in 95 % of the occupied voxels is known to so much, with 95 % confidence, m."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        x, y, z = self.state.shape
        return x, y, z

    @property
    def free(self) -> NDArray[np.bool_]:
        """(X, Y, Z) whether rays passed the voxel and nothing is in it."""
        mask: NDArray[np.bool_] = self.state == FREE
        return mask

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """(X, Y, Z) whether there probably is a surface in the voxel."""
        mask: NDArray[np.bool_] = self.state == OCCUPIED
        return mask

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """(X, Y, Z) whether the voxel is neither free nor occupied."""
        mask: NDArray[np.bool_] = self.state == UNKNOWN
        return mask

    def centres(self, which: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """Centres of voxels.

        Parameters
        ----------
        which : (X, Y, Z) ndarray of bool, optional
            Default: all voxels.

        Returns
        -------
        (N, 3) ndarray of float64
            World, m, in C order of the voxels.
        """
        voxels = np.argwhere(np.ones(self.shape, bool) if which is None else which)
        return self.origin + (voxels + 0.5) * self.voxel_size

    def at(self, x: ArrayLike) -> NDArray[np.int8]:
        """State of the voxels that positions are in.

        Parameters
        ----------
        x : (N, 3) array_like
            World, m.

        Returns
        -------
        (N,) ndarray of int8
            As :attr:`state`; unknown outside of the grid, and at positions that are not finite.

        Raises
        ------
        ValueError
            If `x` is not (N, 3).
        """
        positions = real_array(x, "positions")
        if positions.ndim != 2 or positions.shape[1] != 3:
            msg = f"positions must have shape (N, 3), not {positions.shape}"
            raise ValueError(msg)
        voxels = np.nan_to_num(np.floor((positions - self.origin) / self.voxel_size), nan=-1)
        inside = ((voxels >= 0) & (voxels < self.shape)).all(axis=1)
        found = np.full(len(positions), UNKNOWN, np.int8)
        found[inside] = self.state[tuple(voxels[inside].astype(np.int64).T)]
        return found

    def distances(self) -> DistanceField:
        """Euclidean distances to what is occupied, and to what is not free; exact between centres of voxels."""
        from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

        occupied, size = self.occupied, self.voxel_size
        outside = np.full(self.shape, np.inf, np.float32)
        if occupied.any():
            outside = distance_transform_edt(~occupied, size).astype(np.float32)
            inside = distance_transform_edt(np.pad(occupied, 1), size)[1:-1, 1:-1, 1:-1]
            outside[occupied] = -inside[occupied]
        not_free = distance_transform_edt(np.pad(self.free, 1), size)[1:-1, 1:-1, 1:-1]
        error_m = math.sqrt(3) / 2 * size + self.position_error_m
        return DistanceField(outside, not_free.astype(np.float32), self.unknown, error_m)

    def costmap(self, wheels: Wheels | None = None) -> Costmap:
        """Heights of the ground, and their costs for a vehicle.

        Parameters
        ----------
        wheels : Wheels, optional
            Limits of the vehicle. Default: those of a car.

        Returns
        -------
        Costmap
            Arrays (X, Y).
        """
        return costmap(self, Wheels() if wheels is None else wheels)

    def flat(self, lower_m: float = 0.3, upper_m: float = 2.0) -> FlatGrid:
        """The grid in two dimensions that ROS's map_server reads, of what is between two heights above the ground.

        Parameters
        ----------
        lower_m, upper_m : float
            Above the ground of each column, or of the nearest one whose ground is known, m. Below `lower_m` wheels pass,
            above `upper_m` the robot does.

        Returns
        -------
        FlatGrid
            A column is occupied if a voxel between the heights is, free if all are.

        Raises
        ------
        ValueError
            If the heights are not ascending, or no column of the grid shows ground.
        """
        return flat_grid(self, lower_m, upper_m)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the grid to a file. An old one is replaced only once the new one is complete.

        Parameters
        ----------
        path : path-like
            ``.npz``: all arrays of the grid, by name. ``.ply``: centres of the voxels that are not unknown, with state and
            probability. ``.bt``: an octree as OctoMap reads it, of what is occupied and free.

        Raises
        ------
        ValueError
            For another suffix, or if the grid is too far from the world's origin for a ``.bt``, 32,768 voxels, or its origin
            is not a multiple of its voxels.
        OSError
            If the file cannot be written.
        """
        write_grid(path, vars(self), self.centres(~self.unknown))


def save_arrays(path: str | PathLike[str], grid: Grid, found: Costmap | DistanceField) -> None:
    """Write costs or distances of a grid to an ``.npz``, by name, with the grid's `origin` and `voxel_size`."""
    target = path_of(path, "path")
    check_arrays_path(target)
    arrays: dict[str, ArrayLike] = {"origin": grid.origin, "voxel_size": grid.voxel_size}
    arrays |= {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
    write_arrays(target, arrays, compressed=True)
