# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A part of a map in voxels: occupied, free and unknown."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import real_array
from radarsdf.grids.costmap import Costmap, Wheels, costmap
from radarsdf.grids.distances import DistanceField, distance_field
from radarsdf.grids.flat import FlatGrid, flat_grid

UNKNOWN, FREE, OCCUPIED = -1, 0, 1


@dataclass(frozen=True)
class Grid:
    """Voxels of a box of the world, made by :meth:`radarsdf.Map.grid`.

    Voxel (i, j, k) spans ``origin + [i, j, k] * voxel_size`` to ``origin + [i + 1, j + 1, k + 1] * voxel_size``.
    """

    origin: NDArray[np.float64]
    """(3,) lower corner of voxel (0, 0, 0), world, m: a multiple of the voxel along each axis."""
    voxel_size: float
    """Edge of a voxel, m."""
    state: NDArray[np.int8]
    """(X, Y, Z) -1: unknown, 0: free, 1: occupied."""
    probability: NDArray[np.float32]
    """(X, Y, Z) probability that there is a surface in the voxel. NaN where neither rays nor returns tell anything."""
    distance_m: NDArray[np.float32]
    """(X, Y, Z) the map's signed distance at the centre of the voxel, m, positive in free space. NaN where it was not
    observed."""
    position_error_m: float
    """95 % of the occupied voxels are on a surface whose position is known to so much, with 95 % confidence, m."""

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
        """(N, 3) centres of the voxels in a mask (X, Y, Z), world, m. None: of all, the last axis first."""
        voxels = np.argwhere(np.ones(self.shape, bool) if which is None else which)
        return self.origin + (voxels + 0.5) * self.voxel_size

    def at(self, x: ArrayLike) -> NDArray[np.int8]:
        """(N,) state of the voxels that positions (N, 3), world, m, are in. Unknown outside of the grid."""
        positions = np.asarray(real_array(x, "positions"), np.float64)
        if positions.ndim != 2 or positions.shape[1] != 3:
            msg = f"positions must have shape (N, 3), not {positions.shape}"
            raise ValueError(msg)
        voxels = np.nan_to_num(np.floor((positions - self.origin) / self.voxel_size), nan=-1)
        inside = ((voxels >= 0) & (voxels < self.shape)).all(axis=1)
        found = np.full(len(positions), UNKNOWN, np.int8)
        found[inside] = self.state[tuple(voxels[inside].astype(np.int64).T)]
        return found

    def distances(self) -> DistanceField:
        """Euclidean distances from each voxel's centre: to what is occupied, and to what is not free."""
        return distance_field(self)

    def costmap(self, wheels: Wheels | None = None) -> Costmap:
        """Heights of the ground, and what they cost `wheels`. None: a car's."""
        return costmap(self, Wheels() if wheels is None else wheels)

    def flat(self, lower_m: float = 0.3, upper_m: float = 2.0) -> FlatGrid:
        """The grid of two dimensions that ROS's map_server reads: what is between two heights above the ground.

        Parameters
        ----------
        lower_m, upper_m : float
            Above the ground of each column, or of the nearest one whose ground is known, m. Below `lower_m` wheels pass,
            above `upper_m` the robot does.

        Raises
        ------
        ValueError
            If the heights are not ascending, or no column of the grid shows ground.
        """
        return flat_grid(self, lower_m, upper_m)

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the grid to a file. An old one is replaced only once the new one is complete.

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
        from radarsdf.grids.files import save_grid  # noqa: PLC0415 - only who saves needs it

        save_grid(self, path)
