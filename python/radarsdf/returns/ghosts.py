# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Ghosts: returns behind a surface that their own rays passed through.

A radar sees an object by way of a mirror, such as a metal wall, and places it straight on, behind the mirror. Such returns
agree with each other from every position. So neither their number nor the rays that other returns sent betray them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import SurfelMap
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.noise import beam_noise
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import NEIGHBOUR_WEIGHT, Surfels

# Measured on simulated and real scans; see docs/levers.md.
_NOISE_RETURNS_OF_MEANS = 20_000  # tell the noise to 2 %, which is enough where time counts
_MARGIN = 0.25  # surfel cells. This, and the next, behind a surface: a noisy return of the surface itself is no ghost.
_SIGMAS = 2.0
_MIN_OPACITY = 0.5  # of a surface: share of the rays to it that end there. A hedge lets most of them through.
_MIN_SHARE = 0.5  # of the returns round it: ghosts are among ghosts, a noisy return is not


def find_ghosts(
    surfels: Surfels, rays: Rays, means: MeanRays | None = None, num_threads: int = 0
) -> NDArray[np.bool_]:
    """Which returns are ghosts.

    Parameters
    ----------
    surfels : Surfels
        The planes through the returns of `rays`.
    rays : Rays
        N rays.
    means : MeanRays, optional
        For less work: only the first ray of each of these cells is followed, and stands for all returns of the cell.
    num_threads : int
        0: as many as OpenMP uses.

    Returns
    -------
    ndarray
        (N,) bool.
    """
    cells, all_cell_of_ray = surfels.cells, surfels.cells.cell_of_ray
    if means is None:
        cell_of_ray, weights = all_cell_of_ray, None
        returns = cells.moments[:, 0]
        noise = beam_noise(surfels, rays, cell_of_ray)
    else:
        rays, cell_of_ray, weights = rays.select(means.first), all_cell_of_ray[means.first], means.counts
        returns = np.bincount(cell_of_ray, weights, len(cells.keys)).astype(np.float64)
        noise = beam_noise(surfels, rays, cell_of_ray, _NOISE_RETURNS_OF_MEANS)
    table = np.concatenate([surfels.centres, surfels.normals, np.sqrt(surfels.variances[:, :1])], 1)
    table = table.astype(np.float32)

    def crossed(planes: NDArray[np.int64], rays: Rays) -> NDArray[np.int32]:
        """Row among `planes` of the first plane that each ray crosses from its front; -1 where there is none."""
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
    # Few rays cross a surface at all, and fewer one that is not opaque. Only those may yet cross another.
    behind = first >= 0
    through = np.flatnonzero(behind)[~opaque[first[behind]]]
    behind[through] = crossed(flat[opaque], rays.select(through)) >= 0
    behind_in_cell = count(cell_of_ray, behind, len(cells.keys))
    sums = cells.blocks.sum_round(cells.keys, np.stack([behind_in_cell, returns], 1), 1.0, num_threads)
    ghosts: NDArray[np.bool_] = (sums[:, 0] > _MIN_SHARE * sums[:, 1])[all_cell_of_ray]
    return ghosts
