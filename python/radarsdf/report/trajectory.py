# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The section about poses that were refined or found."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from radarsdf.report import plots
from radarsdf.report.page import Section, Sentence, grid, image, paragraph, table
from radarsdf.report.subject import Subject

_M, _DEG = "\N{NO-BREAK SPACE}m", "°"


def trajectory_section(subject: Subject) -> tuple[list[Section], list[Sentence]]:
    """The way before and after, and how well it is known; and what the conclusion says of it. Nothing of poses as given."""
    way = subject.radar_map.report.get("poses")
    if way is None:
        return [], []
    after, before = np.array(way["after"]), None if way["before"] is None else np.array(way["before"])
    scans, sigmas_m = np.array(way["scans"]), np.array(way["sigma_m"])
    sigmas_deg = np.degrees(way["sigma_rad"])
    known = bool(sigmas_m.any())
    pictures = [
        image(
            plots.trajectory(before, after),
            "The way of the sensor from above, and its height along the way.",
            "From above, and the height along the way. The circle is the first scan.",
        )
    ]
    if known:
        pictures.append(
            image(
                plots.along_scans(scans, {"position, m": sigmas_m, "rotation, °": sigmas_deg}),
                "Standard deviations of position and rotation over the scans.",
                "One standard deviation by axis, relative to the scan in the middle.",
            )
        )
    body = [paragraph(way["verdict"]), grid(*pictures), table("", (), _facts(way, before, after))]
    mark: Literal["warning", "good"] = "warning" if way["improved"] is False else "good"
    return [Section("poses", "Poses", body)], [Sentence(mark, "Poses", way["verdict"])]


def _facts(way: dict[str, Any], before: NDArray[Any] | None, after: NDArray[Any]) -> list[tuple[str, str]]:
    length_m = float(np.linalg.norm(np.diff(after, axis=0), axis=1).sum())
    rows = [("Length of the way", f"{length_m:.1f}{_M}")]
    if before is not None and way["improved"]:
        moved_m = np.linalg.norm(after - before, axis=1)
        rows.append(("Poses moved by, root mean square", f"{np.sqrt((moved_m**2).mean()):.3f}{_M}"))
        rows.append(("and at most", f"{moved_m.max():.3f}{_M}"))
    if way["improved"] and way["step_m"] is not None and way["step_rad"] is not None:
        step_deg = float(np.degrees(way["step_rad"]))
        rows.append(("A given step is off by", f"{way['step_m']:.3f}{_M}, {step_deg:.2f}{_DEG}"))
    if any(way["sigma_m"]):
        sigma_m, sigma_deg = np.median(way["sigma_m"]), np.degrees(np.median(way["sigma_rad"]))
        rows.append(("A pose is known to, median", f"{sigma_m:.3f}{_M}, {sigma_deg:.2f}{_DEG}"))
    return rows
