# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The returns that the sdf stage uses: without ghosts, and moved onto surfels."""

from __future__ import annotations

from dataclasses import dataclass

from radarsdf.config import FitConfig
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import Surfels


@dataclass(frozen=True)
class SurfaceReturns:
    """The returns that the sdf stage uses, and what the average as a start needs."""

    rays: Rays
    """Rays without ghosts. Returns are moved onto the flat surfel of their cell if there is one."""
    surfels: Surfels | None
    """Surfels of all returns. None if the configuration needs none."""
    means: MeanRays | None
    """Mean rays of the leaf cells, without ghosts. None if the training does not start from an average."""

    @classmethod
    def of(cls, rays: Rays, config: FitConfig, num_threads: int) -> SurfaceReturns:
        """Cleans `rays` as ``config.returns`` says."""
        averages = config.training.start == "average"
        # Without an sdf stage, only the average uses the surface, and it takes distances to surfels anyway.
        onto_planes = config.returns.onto_planes and config.training.sdf_iterations != 0
        means = MeanRays.of(rays, config.leaf_size_m, num_threads) if averages else None
        if not (config.returns.drop_ghosts or onto_planes or averages):
            return cls(rays, None, means)
        surfels = Surfels.of(rays, config.leaf_size_m, num_threads)
        kept = None
        if config.returns.drop_ghosts:
            kept = ~find_ghosts(surfels, rays, means, num_threads)
            means = None if means is None else means.select(kept[means.first])
        if onto_planes:
            rays = surfels.onto_planes(rays)
        return cls(rays if kept is None else rays.select(kept), surfels, means)
