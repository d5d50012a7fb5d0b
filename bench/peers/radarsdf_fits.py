# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""This package as a peer among the others: the default, the published configurations and SHINE's representation."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import radarsdf
import radarsdf.meshing  # with trimesh: imported by the first mesh otherwise, and counted

from .child import Made, ScanArrays


def radarsdf_fit(scans: ScanArrays, base: str, changes: dict[str, Any]) -> Made:
    """Fit and mesh. `base` is "default" or "paper"; intensities are used where `scans` has them."""
    base_config = radarsdf.FitConfig.paper() if base == "paper" else radarsdf.FitConfig()
    config = radarsdf.FitConfig.from_dict(
        base_config.to_dict() | changes
    )  # not keywords: JSON knows no tuples
    frames = [np.flatnonzero(scans.frame == i) for i in range(len(scans.poses))]
    radar_map = radarsdf.fit(
        [scans.points[own] for own in frames],
        scans.poses,
        None if scans.intensities is None else [scans.intensities[own] for own in frames],
        config=config,
        progress=False,
    )
    started = time.perf_counter()
    mesh = radar_map.mesh(progress=False)
    report = radar_map.report | {"mesh_s": time.perf_counter() - started}
    intensity = radar_map.intensity if radar_map.has_intensity else None
    return Made(mesh.vertices, mesh.faces, radar_map.nbytes, report, intensity)
