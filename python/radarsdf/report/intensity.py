# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The section of intensities, measured against predicted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radarsdf.evaluation import KNNIntensity, intensity_metrics
from radarsdf.report import plots
from radarsdf.report.page import Section, Verdict, grid, image, note, paragraph, table
from radarsdf.report.subject import Subject
from radarsdf.returns.movers import rays_as_measured
from radarsdf.tiles.any_map import predicted

_Floats = NDArray[np.float64]

_MOST_RETURNS = 100_000  # evenly spread; more change no plot
_UNIT = "sensor units"
_ANGLE_BIN_DEG = 7.5
_RANGE_BINS = 16


def intensity_section(subject: Subject) -> tuple[Section, list[tuple[str, str]], list[Verdict]]:
    """Errors of the intensities on scans that the fit left out, else on those that it was given; and what they say."""
    anchor, title = "intensity", "Intensity"
    scans = subject.scans if subject.held_out is None else subject.held_out
    if not subject.radar_map.has_intensity:
        return Section(anchor, title, [paragraph("The map was fitted without intensities.")]), [], []
    if scans is None or scans.intensities is None:
        why = "This report was made without scans." if scans is None else "The scans have no intensities."
        return Section(anchor, title, [paragraph(f"Not compared with measurements. {why}")]), [], []
    radar_map, config = subject.radar_map, subject.radar_map.config
    rays = rays_as_measured(scans, config)
    given = len(rays)
    rays = rays.select(rays.with_intensity)
    total = len(rays)
    rays = rays.select(np.linspace(0, total - 1, min(total, _MOST_RETURNS)).astype(np.int64))
    chosen = len(rays)
    rays, found = predicted(radar_map, rays)
    (x, sensors), values = rays.in_world(), rays.intensities
    assert values is not None
    measured = values.astype(np.float64)
    metrics = intensity_metrics(found, measured)
    rows = [("This map", f"{metrics['mae']:.2f}", f"{metrics['medae']:.2f}")]
    others = {}
    if subject.held_out is not None and subject.scans is not None:
        known = rays_as_measured(subject.scans, config)
        known = known.select(known.with_intensity)
        assert known.intensities is not None
        knn = KNNIntensity.chosen(*known.in_world(), known.intensities, known.scans)
        nearest = intensity_metrics(knn.predict(x, sensors), measured)
        others["the nearest neighbours"] = nearest["mae"]
        rows.append(("Nearest neighbours", f"{nearest['mae']:.2f}", f"{nearest['medae']:.2f}"))
        which = f"{len(scans)} scan{'s' * (len(scans) > 1)} that the fit left out"
    else:
        which = "scans of this report"
    spread = others["the median of all"] = float(np.abs(measured - np.median(measured)).mean())
    rows.append(
        ("Always the median", f"{spread:.2f}", f"{np.median(np.abs(measured - np.median(measured))):.2f}")
    )
    angle_deg = _incidence_deg(subject, x, rays.directions.astype(np.float64))
    known_angle = np.isfinite(angle_deg)
    farthest_m = float(np.percentile(rays.ranges_m, 99.5))
    count = f"all {total:,}" if len(rays) == total else f"{len(rays):,} of the {total:,}"
    if chosen > len(rays):
        which += f"; {chosen - len(rays):,} more are in no tile"
    if total < given:
        which += f"; intensities of {given - total:,} more cannot belong to the others"
    honest = (
        ""
        if subject.held_out is not None
        else " The fit may have been trained on them: errors on new scans are larger. --holdout 10 leaves some out."
    )
    body = [
        paragraph(f"On {count} returns of the {which}.{honest}"),
        table("", (f"error, {_UNIT}", "mean", "median"), rows),
        grid(
            image(
                plots.measured_predicted(measured, found, _UNIT),
                "Density of predicted over measured intensities.",
                "Predicted over measured. On the line, both are equal.",
            ),
            image(
                plots.by_bins(
                    np.arange(0, 90 + _ANGLE_BIN_DEG, _ANGLE_BIN_DEG),
                    angle_deg[known_angle],
                    measured[known_angle],
                    found[known_angle],
                    label="angle of incidence, degrees",
                    unit=_UNIT,
                ),
                "Measured and predicted intensities by angle of incidence, and mean errors.",
                "By angle of incidence: 0 is perpendicular to the surface.",
            ),
            image(
                plots.by_bins(
                    np.linspace(0, farthest_m, _RANGE_BINS + 1),
                    rays.ranges_m.astype(np.float64),
                    measured,
                    found,
                    label="range, m",
                    unit=_UNIT,
                ),
                "Measured and predicted intensities by range, and mean errors.",
                "By range.",
            ),
        ),
        note(
            "Lines are medians, the band holds the middle two thirds of the measured values, grey bars are mean absolute "
            "errors. A prediction has less spread than a measurement, since the noise of a single return cannot be predicted."
        ),
    ]
    compared = " and ".join(f"{mae:.2f} of {name}" for name, mae in others.items())
    on = (
        "scans that the fit left out"
        if subject.held_out is not None
        else "scans that it may have been trained on"
    )
    verdict = Verdict(
        "good" if metrics["mae"] < min(others.values()) else "warning",
        "Intensity",
        f"The mean error is {metrics['mae']:.2f} {_UNIT}, beside {compared}, on {on}.",
    )
    return Section(anchor, title, body), [(f"Intensity error, {_UNIT}", f"{metrics['mae']:.2f}")], [verdict]


def _incidence_deg(subject: Subject, x: _Floats, directions: _Floats) -> _Floats:
    """(N,) angle between the rays and the normals of the field at returns x (N, 3), degrees. NaN where it has none."""
    normal = np.asarray(subject.radar_map.gradient(x, extrapolate=True), np.float64)
    length = np.linalg.norm(normal, axis=1)
    cosine = np.abs((normal * directions).sum(axis=1)) / np.where(length > 0, length, np.nan)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))))
