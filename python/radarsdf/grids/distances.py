# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Euclidean distances in a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from radarsdf.grids.grid import Grid


@dataclass(frozen=True)
class DistanceField:
    """Euclidean distances from the centre of each voxel of a grid."""

    occupied_m: NDArray[np.float32]
    """(X, Y, Z) to the centre of the nearest occupied voxel, m; in occupied ones minus that to the nearest other one. It
    says nothing of what is unknown: infinite if nothing is occupied."""
    not_free_m: NDArray[np.float32]
    """(X, Y, Z) to the centre of the nearest voxel that is not free, m: what is unknown, and what is beyond the grid,
    counts as occupied. 0 in voxels that are not free. So far a robot may go whatever is in the unknown."""
    unknown: NDArray[np.bool_]
    """(X, Y, Z) voxels that are unknown."""
    error_m: float
    """Half a diagonal of a voxel, and the error of the surface's position, m: what voxels and noise add where the map has the
    surface right. It is no bound on the distance to the truth: false returns that are called occupied make `occupied_m` too
    small, and surface that the map does not have makes it too large."""


def distance_field(grid: Grid) -> DistanceField:
    """See :meth:`Grid.distances`. Exact between centres of voxels: Felzenszwalb's transform by SciPy."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    occupied, free, size = grid.occupied, grid.free, grid.voxel_size
    outside = np.full(grid.shape, np.inf, np.float32)
    if occupied.any():
        outside = distance_transform_edt(~occupied, size).astype(np.float32)
        inside = distance_transform_edt(np.pad(occupied, 1), size)[1:-1, 1:-1, 1:-1]
        outside[occupied] = -inside[occupied]
    not_free = distance_transform_edt(np.pad(free, 1), size)[1:-1, 1:-1, 1:-1]
    return DistanceField(
        outside,
        not_free.astype(np.float32),
        grid.unknown,
        math.sqrt(3) / 2 * size + grid.position_error_m,
    )
