# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""This package as a peer: its default, the published configurations, and the representation of SHINE-Mapping."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import radarsdf
import radarsdf.map.meshing  # else the first mesh would import it and trimesh, in the measured time

from .child import Made, ScanArrays

_BASES = {
    "default": radarsdf.FitConfig(),
    "paper": radarsdf.FitConfig.paper(),
    "quick": radarsdf.FitConfig.quick(),
}


def radarsdf_fit(scans: ScanArrays, base: str, changes: dict[str, Any], voxel_m: float = 0.1) -> Made:
    """Fit a map and extract its mesh. `base` names one of `_BASES`. Intensities are used if `scans` has them."""
    settings = _BASES[base].to_dict() | changes
    config = radarsdf.FitConfig.from_dict(settings)  # it turns the lists of JSON into tuples
    frames = [np.flatnonzero(scans.frame == i) for i in range(len(scans.poses))]
    radar_map = radarsdf.fit(
        [scans.points[own] for own in frames],
        scans.poses,
        None if scans.intensities is None else [scans.intensities[own] for own in frames],
        config=config,
        progress=False,
    )
    started = time.perf_counter()
    mesh = radar_map.mesh(voxel_m, progress=False)
    report = radar_map.report | {"mesh_s": time.perf_counter() - started}
    intensity = radar_map.intensity if radar_map.has_intensity else None
    return Made(mesh.vertices, mesh.faces, radar_map.nbytes, report, intensity)
