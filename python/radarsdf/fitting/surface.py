# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the surface is learnt from: the returns without those that are false, moved onto the planes that they make."""

from __future__ import annotations

from dataclasses import dataclass

from radarsdf.config import FitConfig
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import Surfels


@dataclass(frozen=True)
class SurfaceReturns:
    """Returns of surfaces."""

    rays: Rays
    """Without ghosts; the returns lie on planes where they make one."""
    surfels: Surfels | None
    """The planes through all returns. None: nothing asks for them."""
    means: MeanRays | None
    """The mean ray of each leaf cell, without ghosts. None: the training does not start from an average."""

    @classmethod
    def of(cls, rays: Rays, config: FitConfig, num_threads: int) -> SurfaceReturns:
        """What of `rays` the surface is learnt from."""
        averages = config.training.start == "average"
        # An average that is not trained on has distances to planes in any case.
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
