# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How good is a map: its surface against lidar, its intensity against held-out radar frames.

Nothing here knows how a map was made, so that meshes and predictions of other programs can be measured alike.
"""

from ._report import format_metrics
from .intensity import INTENSITY_PROTOCOL, IntensityMetrics, KNNIntensity, holdout, intensity_metrics
from .surface import PROTOCOL, SurfaceMetrics, adjacent_angles, gamma_from_moments, surface_metrics

__all__ = [
    "INTENSITY_PROTOCOL",
    "PROTOCOL",
    "IntensityMetrics",
    "KNNIntensity",
    "SurfaceMetrics",
    "adjacent_angles",
    "format_metrics",
    "gamma_from_moments",
    "holdout",
    "intensity_metrics",
    "surface_metrics",
]
