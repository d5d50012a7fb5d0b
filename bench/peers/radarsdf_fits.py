# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""This package as a peer among the others: the default, the published configurations and SHINE's representation."""

from __future__ import annotations

from typing import Any

import numpy as np
import radarsdf

from .child import ScanArrays


def radarsdf_fit(scans: ScanArrays, base: str, changes: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, int]:
    """Fit and mesh. `base` is "default" or "paper"; intensities are used where `scans` has them."""
    config = radarsdf.FitConfig.paper(**changes) if base == "paper" else radarsdf.FitConfig(**changes)
    frames = [np.flatnonzero(scans.frame == i) for i in range(len(scans.poses))]
    radar_map = radarsdf.fit(
        [scans.points[own] for own in frames],
        scans.poses,
        None if scans.intensities is None else [scans.intensities[own] for own in frames],
        config=config,
        progress=False,
    )
    mesh = radar_map.mesh(progress=False)
    return mesh.vertices, mesh.faces, radar_map.nbytes
