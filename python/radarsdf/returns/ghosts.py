# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Finds ghosts: returns behind a surface that their rays crossed.

A mirror, such as a metal wall, reflects the radar's beam to an object. The radar places the object behind the
mirror, in the direction of the beam. From all sensor positions, these returns are at the same place. So
neither the number of returns there nor the rays of other returns show that they are false.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import SurfelMap
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import NEIGHBOUR_WEIGHT, Surfels

# Measured on simulated and real scans; see bench/history/surface.md.
# A ghost is farther behind the surface than these two together, since noise puts returns of the surface
# itself behind it.
_MARGIN = 0.25  # cells of surfels
_SIGMAS = 2.0  # standard deviations of the noise
_MIN_OPACITY = 0.5  # of a surface: share of the rays to it that end there. A hedge lets most rays through.
# Share of the returns round a ghost that are behind a surface too. Round a noisy return it is lower.
_MIN_SHARE = 0.5


def find_ghosts(
    surfels: Surfels, rays: Rays, noise: SensorNoise, means: MeanRays | None = None, num_threads: int = 0
) -> NDArray[np.bool_]:
    """Finds the returns that are ghosts.

    Parameters
    ----------
    surfels : Surfels
        Surfels of the returns of `rays`.
    rays : Rays
        N rays.
    noise : SensorNoise
        Noise of the returns.
    means : MeanRays, optional
        Makes it faster: only the first ray of each of these cells is followed, for all returns of the cell.
    num_threads : int
        0: as many as OpenMP uses.

    Returns
    -------
    ndarray
        (N,) bool, True for ghosts.
    """
    cells, all_cell_of_ray = surfels.cells, surfels.cells.cell_of_ray
    if means is None:
        cell_of_ray, weights = all_cell_of_ray, None
        returns = cells.counts
    else:
        rays, cell_of_ray, weights = rays.select(means.first), all_cell_of_ray[means.first], means.counts
        returns = np.bincount(cell_of_ray, weights, len(cells.keys)).astype(np.float64)
    table = np.concatenate([surfels.centres, surfels.normals, np.sqrt(surfels.variances[:, :1])], 1)
    table = table.astype(np.float32)

    def crossed(planes: NDArray[np.int64], rays: Rays) -> NDArray[np.int32]:
        """(N,) row in `planes` of the first plane that each ray crosses from its front, or -1."""
        surfel_map = SurfelMap(cells.keys[surfels.cell_of_plane[planes]], table[planes], surfels.cell_size_m)
        return surfel_map.first_crossings(
            np.ascontiguousarray(rays.points),
            np.ascontiguousarray(rays.directions),
            np.ascontiguousarray(rays.ranges_m),
            noise.range_m,
            noise.angle_rad,
            _MARGIN * surfels.cell_size_m,
            _SIGMAS,
            num_threads,
        )

    def count(rows: NDArray[np.int32], of: NDArray[np.bool_], size: int) -> NDArray[np.float64]:
        counted = np.bincount(rows[of], None if weights is None else weights[of], size)
        return counted.astype(np.float64)

    flat = np.flatnonzero(surfels.is_flat())
    first = crossed(flat, rays)
    passed = np.zeros((len(cells.keys), 1))
    flat_cells = surfels.cell_of_plane[flat]
    passed[flat_cells, 0] = count(first, first >= 0, len(flat))
    support = surfels.support[flat_cells]
    passed_round = cells.blocks.sum_round(cells.keys[flat_cells], passed, NEIGHBOUR_WEIGHT, num_threads)[:, 0]
    opaque = support / (support + passed_round) > _MIN_OPACITY
    # A ray through a surface that is not opaque may cross an opaque one behind it. There are few such rays.
    behind = first >= 0
    through = np.flatnonzero(behind)[~opaque[first[behind]]]
    behind[through] = crossed(flat[opaque], rays.select(through)) >= 0
    behind_in_cell = count(cell_of_ray, behind, len(cells.keys))
    sums = cells.blocks.sum_round(cells.keys, np.stack([behind_in_cell, returns], 1), 1.0, num_threads)
    ghosts: NDArray[np.bool_] = (sums[:, 0] > _MIN_SHARE * sums[:, 1])[all_cell_of_ray]
    return ghosts
