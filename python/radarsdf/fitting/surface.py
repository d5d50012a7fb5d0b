# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The returns that the sdf stage uses: without ghosts, and moved towards surfels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf.config.fit_config import FitConfig
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.noise import SensorNoise, onto_surfels, sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MeanRays, ReturnCells, ScanSums


@dataclass(frozen=True)
class SurfaceReturns:
    """The returns that the sdf stage uses, and what is known of them before the training."""

    rays: Rays
    """Rays without ghosts. Returns are moved towards the flat surfel of their cell if there is one."""
    surfels: Surfels
    """Surfels of all returns."""
    noise: SensorNoise
    """Noise of the returns."""
    means: MeanRays | None
    """Mean rays of the leaf cells, without ghosts. None if the training does not start from an average."""
    true: NDArray[np.bool_] | None
    """(N,) which of all rays end at no ghost. None: it was not asked."""

    @classmethod
    def of(
        cls,
        rays: Rays,
        config: FitConfig,
        num_threads: int,
        inside: NDArray[np.bool_] | None = None,
        given: ScanSums | None = None,
    ) -> SurfaceReturns:
        """Cleans `rays` as ``config.returns`` says, and keeps those that are `inside`, (N,). None: all."""
        averages = config.training.start != "noise"
        # Without an sdf stage, only the average uses the surface, and it takes distances to surfels anyway.
        onto_planes = config.returns.onto_planes and config.training.sdf_iterations != 0
        sums = ScanSums.of(rays, config.leaf_size_m, num_threads) if given is None else given
        surfels = Surfels.of_sums(sums, num_threads)
        means = MeanRays.of_sums(sums) if averages else None
        del sums  # frees memory: a hundred bytes a cell
        noise = sensor_noise(surfels, rays, config.returns, num_threads)
        kept, true = inside, None
        if means is not None and inside is not None:
            leaf_cells = ReturnCells.of(rays.select(inside), config.leaf_size_m, num_threads)
            means = means.select(leaf_cells.blocks.rows(means.keys, num_threads) >= 0)
        if config.returns.drop_ghosts:
            of_ghosts = find_ghosts(surfels, rays if means is None else means, noise, num_threads)
            true = ~of_ghosts[surfels.cells_at(rays.points, num_threads)]
            kept = true if inside is None else true & inside
            if means is not None:
                means = means.select(~of_ghosts[surfels.cells_of_leaves(means.keys, num_threads)])
        if onto_planes:
            rays = onto_surfels(surfels, rays, noise, num_threads)
        return cls(rays if kept is None else rays.select(kept), surfels, noise, means, true)
