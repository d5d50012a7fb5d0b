# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensity errors on scans that a fit left out. This module imports NumPy: import it only where a command runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from radarsdf.cli.saying import say
from radarsdf.evaluation import KNNIntensity, format_metrics, intensity_metrics
from radarsdf.returns.rays import prepare, scan_numbers

if TYPE_CHECKING:
    from radarsdf import FitConfig, RadarMap
    from radarsdf.io.scans import Scans


def print_intensity_errors(radar_map: RadarMap, test: Scans, train: Scans) -> None:
    """Print the errors of a map, and of a kNN baseline that is as good as these scans allow; nothing if map or scans have no intensities.

    Parameters
    ----------
    radar_map
        The map.
    test
        The scans that the fit left out.
    train
        The scans that the fit used. The baseline predicts from them, and chooses its settings on them.
    """
    if not radar_map.has_intensity or test.intensities is None:
        return
    x, sensors, measured = _in_world(test, radar_map.config)
    say("held-out " + format_metrics(intensity_metrics(radar_map.intensity(x, sensors), measured)))
    returns = radar_map.config.returns
    scans = scan_numbers(train.points, min_range_m=returns.min_range_m, max_range_m=returns.max_range_m)
    knn = KNNIntensity.chosen(*_in_world(train, radar_map.config), scans)
    metrics = intensity_metrics(knn.predict(x, sensors), measured)
    say(f"kNN      {format_metrics(metrics)}, {knn.k} of {knn.candidates} neighbours")


def _in_world(scans: Scans, config: FitConfig) -> tuple[Any, Any, Any]:
    """Points, sensor positions and intensities of the returns whose range the fit accepted; world frame, m."""
    rays = prepare(
        scans.points,
        scans.poses,
        scans.intensities,
        min_range_m=config.returns.min_range_m,
        max_range_m=config.returns.max_range_m,
    )
    return *rays.in_world(), rays.intensities
