# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How many scans looked at a place, said plainly: by the interval of each ray in each cube."""

from __future__ import annotations

import numpy as np

CUBE_CELLS = 8


def looks_at(cells, leaf_size_m, points, directions, ranges_m, scans):
    """(C,) number of scans with a ray through the cube of each leaf cell, or to there.

    `cells` (C, 3): lattice coordinates; `points`, `directions` (N, 3), `ranges_m`, `scans` (N,).
    """
    cubes, cube_of_cell = np.unique(np.floor_divide(cells, CUBE_CELLS), axis=0, return_inverse=True)
    counts = np.zeros(len(cubes), np.int64)
    for scan in np.unique(scans):
        own = scans == scan
        counts += rays_in_cubes(
            cubes, CUBE_CELLS * leaf_size_m, points[own], directions[own], ranges_m[own]
        ).any(axis=0)
    return counts[cube_of_cell.reshape(-1)]


def rays_in_cubes(cubes, size_m, points, directions, ranges_m):
    """(N, C) bool, whether the piece of each ray from its sensor to its point is partly in each cube."""
    points, directions = points.astype(np.float64), directions.astype(np.float64)
    begin_m = np.repeat(-ranges_m.astype(np.float64)[:, None], len(cubes), axis=1)
    end_m = np.zeros_like(begin_m)
    for axis in range(3):
        at, speed = points[:, axis, None], directions[:, axis, None]
        low, high = cubes[:, axis] * size_m, (cubes[:, axis] + 1) * size_m
        with np.errstate(divide="ignore", invalid="ignore"):
            faces_m = np.stack([(low - at) / speed, (high - at) / speed])
        inside = (at >= low) & (at < high)
        still = np.broadcast_to(speed == 0, inside.shape)  # along this axis the ray is inside always or never
        begin_m = np.maximum(begin_m, np.where(still, np.where(inside, -np.inf, np.inf), faces_m.min(axis=0)))
        end_m = np.minimum(end_m, np.where(still, np.where(inside, np.inf, -np.inf), faces_m.max(axis=0)))
    return begin_m <= end_m
