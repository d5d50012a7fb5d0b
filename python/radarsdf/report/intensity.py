# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The section of intensities, measured against predicted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radarsdf.evaluation import KNNIntensity, intensity_metrics
from radarsdf.report import plots
from radarsdf.report.page import Section, Sentence, grid, image, note, paragraph, table
from radarsdf.report.subject import Subject
from radarsdf.returns.movers import rays_as_measured
from radarsdf.returns.rays import Rays
from radarsdf.tiles.tiled_map import predicted

_Floats = NDArray[np.float64]

_MOST_RETURNS = 100_000  # evenly spread; more change no plot
_UNIT = "sensor units"
_ANGLE_BIN_DEG = 7.5
_RANGE_BINS = 16
_WORDS = {"Nearest neighbours": "the nearest neighbours", "Always the median": "the median of all"}


def intensity_section(subject: Subject) -> tuple[Section, list[tuple[str, str]], list[Sentence]]:
    """Errors of the intensities on scans that the fit left out, else on those that it was given; and what they say."""
    anchor, title = "intensity", "Intensity"
    scans = subject.scans if subject.held_out is None else subject.held_out
    if not subject.radar_map.has_intensity:
        return Section(anchor, title, [paragraph("The map was fitted without intensities.")]), [], []
    if scans is None or scans.intensities is None:
        why = "This report was made without scans." if scans is None else "The scans have no intensities."
        return Section(anchor, title, [paragraph(f"Not compared with measurements. {why}")]), [], []
    rays = rays_as_measured(scans, subject.radar_map.config)
    given = len(rays)
    rays = rays.select(rays.with_intensity)
    total = len(rays)
    rays = rays.select(np.linspace(0, total - 1, min(total, _MOST_RETURNS)).astype(np.int64))
    chosen = len(rays)
    rays, found = predicted(subject.radar_map, rays)
    assert rays.intensities is not None
    measured = rays.intensities.astype(np.float64)
    metrics = intensity_metrics(found, measured)
    others = _others(subject, rays, measured)
    if subject.held_out is not None:
        on = "scans that the fit left out"
        which = f"{len(scans)} scan{'s' * (len(scans) > 1)} that the fit left out"
        honest = ""
    else:
        on = "scans that it may have been trained on"
        which = "scans of this report"
        honest = " The fit may have been trained on them: errors on new scans are larger. --holdout 10 leaves some out."
    if chosen > len(rays):
        which += f"; {chosen - len(rays):,} more are in no tile"
    if total < given:
        which += f"; intensities of {given - total:,} more cannot belong to the others"
    count = f"all {total:,}" if len(rays) == total else f"{len(rays):,} of the {total:,}"
    rows = [
        (name, f"{mean:.2f}", f"{median:.2f}")
        for name, (mean, median) in {"This map": (metrics["mae"], metrics["medae"]), **others}.items()
    ]
    body = [
        paragraph(f"On {count} returns of the {which}.{honest}"),
        table("", (f"error, {_UNIT}", "mean", "median"), rows),
        _plots(subject, rays, measured, found),
        note(
            "Lines are medians, the band holds the middle two thirds of the measured values, grey bars are mean absolute "
            "errors. A prediction has less spread than a measurement, since the noise of a single return cannot be predicted."
        ),
    ]
    compared = " and ".join(f"{mean:.2f} of {_WORDS[name]}" for name, (mean, _) in others.items())
    sentence = Sentence(
        "good" if metrics["mae"] < min(mean for mean, _ in others.values()) else "warning",
        "Intensity",
        f"The mean error is {metrics['mae']:.2f} {_UNIT}, beside {compared}, on {on}.",
    )
    return Section(anchor, title, body), [(f"Intensity error, {_UNIT}", f"{metrics['mae']:.2f}")], [sentence]


def _others(subject: Subject, rays: Rays, measured: _Floats) -> dict[str, tuple[float, float]]:
    """Mean and median error of what a map must be better than, by the names of :data:`_WORDS`."""
    found = {}
    if subject.held_out is not None and subject.scans is not None:
        known = rays_as_measured(subject.scans, subject.radar_map.config)
        known = known.select(known.with_intensity)
        assert known.intensities is not None
        knn = KNNIntensity.chosen(*known.in_world(), known.intensities, known.scans)
        nearest = intensity_metrics(knn.predict(*rays.in_world()), measured)
        found["Nearest neighbours"] = nearest["mae"], nearest["medae"]
    off = np.abs(measured - np.median(measured))
    return found | {"Always the median": (float(off.mean()), float(np.median(off)))}


def _plots(subject: Subject, rays: Rays, measured: _Floats, found: _Floats) -> str:
    """Predicted over measured, and both by angle of incidence and by range."""
    angle_deg = _incidence_deg(subject, rays.in_world()[0], rays.directions.astype(np.float64))
    known = np.isfinite(angle_deg)
    farthest_m = float(np.percentile(rays.ranges_m, 99.5))
    by_angle = plots.by_bins(
        np.arange(0, 90 + _ANGLE_BIN_DEG, _ANGLE_BIN_DEG),
        angle_deg[known],
        measured[known],
        found[known],
        label="angle of incidence, degrees",
        unit=_UNIT,
    )
    by_range = plots.by_bins(
        np.linspace(0, farthest_m, _RANGE_BINS + 1),
        rays.ranges_m.astype(np.float64),
        measured,
        found,
        label="range, m",
        unit=_UNIT,
    )
    return grid(
        image(
            plots.measured_predicted(measured, found, _UNIT),
            "Density of predicted over measured intensities.",
            "Predicted over measured. On the line, both are equal.",
        ),
        image(
            by_angle,
            "Measured and predicted intensities by angle of incidence, and mean errors.",
            "By angle of incidence: 0 is perpendicular to the surface.",
        ),
        image(by_range, "Measured and predicted intensities by range, and mean errors.", "By range."),
    )


def _incidence_deg(subject: Subject, x: _Floats, directions: _Floats) -> _Floats:
    """(N,) angle between the rays and the normals of the field at returns x (N, 3), degrees. NaN where it has none."""
    normal = np.asarray(subject.radar_map.gradient(x, extrapolate=True), np.float64)
    length = np.linalg.norm(normal, axis=1)
    cosine = np.abs((normal * directions).sum(axis=1)) / np.where(length > 0, length, np.nan)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))))
