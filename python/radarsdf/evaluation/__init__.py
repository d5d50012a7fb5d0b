"""Errors of a map: its surface against lidar points, its intensity against held-out radar scans, its uncertainty
and confidence against both; of a trajectory against the true one.

The functions take meshes and arrays, not maps, so they apply equally to the results of other programs.
"""

from .predictions import KNNIntensity, confidence_metrics, holdout, intensity_metrics, uncertainty_metrics
from .surface import format_metrics, surface_metrics
from .trajectory import trajectory_metrics

__all__ = [
    "KNNIntensity", "confidence_metrics", "format_metrics", "holdout", "intensity_metrics",
    "surface_metrics", "trajectory_metrics", "uncertainty_metrics",
]  # fmt: skip
