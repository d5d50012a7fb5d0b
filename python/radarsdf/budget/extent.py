# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How far out returns may lie: what has no cells is refused before anything is counted."""

from __future__ import annotations

import numpy as np

from radarsdf.config.fit_config import FitConfig
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN


def check_extent(rays: Rays, config: FitConfig) -> None:
    """A single outlier must not be met in the middle of the work, nor by an error that does not say what it is."""
    limit_m = MAX_CELLS_FROM_ORIGIN * config.leaf_size_m
    reach_m = max(config.near_band_m, config.leaf_size_m)  # smoothing asks a leaf cell away from a return
    if config.training.start != "noise":
        reach_m = max(reach_m, config.truncation_m)
    if np.abs(rays.points).max() + reach_m > limit_m:
        distance_m = np.abs(rays.points).max(axis=1) + reach_m
        outside = int((distance_m > limit_m).sum())
        msg = (
            f"{outside} of {len(rays)} returns are not within a million cells of {config.leaf_size_m} m of the sensors' mean "
            f"position, the furthest {distance_m.max():.3g} m away: drop them (max_range_m), use larger cells, or split "
            "scans so far apart"
        )
        raise ValueError(msg)
