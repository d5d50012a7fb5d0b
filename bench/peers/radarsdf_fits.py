"""This package as a peer: its default, the published configurations, and the representation of SHINE-Mapping."""

from typing import Any

import numpy as np
import radarsdf
import radarsdf.fitting.fit  # else the first fit and the first mesh would import these, in the measured time
import radarsdf.map.mesh

from bench.measure import timed
from scenes.settings import PRESETS

from .child import Made, ScanArrays


def radarsdf_fit(scans: ScanArrays, base: str, changes: dict[str, Any], mesh: dict[str, Any]) -> Made:
    """Fit and mesh. `base` is one of `PRESETS`, `mesh` holds arguments of the mesh; intensities are used if there are any."""
    config = PRESETS[base].override(**changes)
    frames = [np.flatnonzero(scans.frame == i) for i in range(len(scans.poses))]
    radar_map = radarsdf.fit(
        [scans.points[own] for own in frames],
        scans.poses,
        None if scans.intensities is None else [scans.intensities[own] for own in frames],
        config=config,
        progress=False,
    )
    with timed() as taken:
        surface = radar_map.mesh(**mesh, progress=False)
    report = radar_map.report | {"mesh_s": taken.wall_s}

    def intensity(points: np.ndarray, sensors: np.ndarray) -> np.ndarray:
        # Held-out returns may lie in unobserved space; the nearest-neighbour baseline predicts there, too.
        predicted: np.ndarray = radar_map.intensity(points, sensors, extrapolate=True)
        return predicted

    answers = intensity if radar_map.has_intensity else None
    return Made(surface.vertices, surface.faces, radar_map.nbytes, report, answers)
