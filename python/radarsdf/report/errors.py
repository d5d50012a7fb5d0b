"""Errors of surface, uncertainty and intensity."""

from __future__ import annotations

from typing import Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.evaluation import intensity_metrics, surface_metrics, uncertainty_metrics
from radarsdf.report import plots
from radarsdf.report.subject import Subject
from radarsdf.report.surface import colored_picture
from radarsdf.returns.moving import rays_as_measured
from radarsdf.threads import resolve_num_threads
from radarsdf.tiles.tiled_map import predicted
from radarsdf.view.surface import Scale

_SAMPLES = 1_000_000
_MATCH_M = 0.4  # a vertex farther from the truth is an outlier rather than an inaccurate surface
_MIN_MATCHES = 100
_MAX_RETURNS = 100_000  # evenly spread; more would not change a plot


def error_values(subject: Subject) -> dict[str, Any] | None:
    """Values of the section of surface errors, or None without a truth or a surface."""
    truth, mesh = subject.ground_truth, subject.mesh
    if truth is None or len(mesh.faces) == 0:
        return None
    metrics = surface_metrics(mesh, truth, box=subject.box, samples=_SAMPLES)
    shown, _ = subject.shown
    shown_m, _ = subject.truth_tree.query(shown.vertices, workers=resolve_num_threads(0))
    pictured = colored_picture(shown, shown_m, "distance to the truth, m", Scale(0.0, _MATCH_M))
    return {"metrics": metrics, **pictured, "in_box": subject.box is not None}


def uncertainty_values(subject: Subject) -> dict[str, Any] | None:
    """Values of the uncertainty section, or None if there is no surface."""
    mesh, (shown, _) = subject.mesh, subject.shown
    if len(mesh.faces) == 0:
        return None
    sigma_m = np.asarray(mesh.vertex_attributes["uncertainty_m"], np.float64)
    shown_m = shown.vertex_attributes["uncertainty_m"]
    percentiles, confidence = [10, 50, 90], mesh.vertex_attributes["confidence"]
    return {
        **colored_picture(shown, shown_m, "standard error, m", Scale.of(sigma_m)),
        "percentiles": percentiles,
        "rows": [
            ("Uncertainty, m", *(f"{x:.3f}" for x in np.nanpercentile(sigma_m, percentiles))),
            ("Confidence", *(f"{x:.2f}" for x in np.nanpercentile(confidence, percentiles))),
        ],
        "against_truth": _calibration(subject, sigma_m),
    }


def _calibration(subject: Subject, sigma_m: Floats) -> dict[str, Any] | None:
    """Errors compared with predicted uncertainties, or None if too little of the surface is near the truth."""
    mesh, truth = subject.mesh, subject.ground_truth
    if truth is None:
        return None
    vertices = np.asarray(mesh.vertices, np.float64)
    distance_m, nearest = subject.truth_tree.query(vertices, workers=resolve_num_threads(0))
    error_m = ((truth[nearest] - vertices) * np.asarray(mesh.vertex_normals)).sum(axis=1)
    error_m[distance_m > _MATCH_M] = np.nan
    if np.count_nonzero(np.isfinite(error_m) & np.isfinite(sigma_m)) < _MIN_MATCHES:
        return None
    metrics = uncertainty_metrics(error_m, sigma_m)
    return {
        "plot": plots.reliability(metrics["decile_predicted_m"], metrics["decile_rmse_m"]),
        "matched": metrics["num_points"] / len(vertices),
        "match_m": _MATCH_M,
        "coverage_68": float(metrics["coverage_68"]),
        "coverage_95": float(metrics["coverage_95"]),
    }


def intensity_values(subject: Subject) -> dict[str, Any] | None:
    """Values of the intensity section, on held-out scans if there are any. None if there is nothing to compare."""
    scans = subject.scans if subject.held_out is None else subject.held_out
    if not subject.radar_map.has_intensity or scans is None or scans.intensities is None:
        return None
    every_ray = rays_as_measured(scans, subject.radar_map.config)
    usable = every_ray.select(every_ray.with_intensity)
    rows = np.linspace(0, len(usable) - 1, min(len(usable), _MAX_RETURNS)).astype(np.int64)
    rays, found = predicted(subject.radar_map, usable.select(rows))
    assert rays.intensities is not None
    measured = rays.intensities.astype(np.float64)
    metrics = intensity_metrics(found, measured)
    deviation = np.abs(measured - np.median(measured))
    return {
        "held_out": subject.held_out is not None,
        "scans": len(scans),
        "returns": len(rays),
        "left_out": {"outliers": len(every_ray) - len(usable), "in no tile": len(rows) - len(rays)},
        "errors": {
            "This map": (metrics["mae"], metrics["medae"]),
            "Median of all returns": (float(deviation.mean()), float(np.median(deviation))),
        },
        "density": plots.predicted_over_measured(measured, found),
    }
