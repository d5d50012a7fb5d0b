"""The report on a map."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from radarsdf.changes.changes import CHANGED, NAMES, Changes, Region, colors_of
from radarsdf.checks import AnyPath
from radarsdf.config.fit_config import FitConfig, flat_settings, to_toml
from radarsdf.report import plots
from radarsdf.report.errors import error_values, intensity_values, uncertainty_values
from radarsdf.report.page import fixed, require_extras, write_page
from radarsdf.report.subject import MAX_VERTICES, Subject
from radarsdf.report.surface import scene, surface_values, views
from radarsdf.view.pages import MEANING, centre_of
from radarsdf.view.surface import thinned

_COUNTS = {
    "tiles": "Tiles",
    "returns": "Returns",
    "ghosts": "Ghosts, left out of the surface",
    "moving": "Moving returns, left out",
    "intensity_outliers": "Intensity outliers, left out of the reflectance",
    "leaf_cells": "Leaf cells",
    "vertices": "Cell vertices",
}
_DURATIONS = {
    "prepare_s": "Scan checks",
    "ghosts_s": "Planes, sensor noise, ghosts",
    "occupied_cells_s": "Cells and averaged surface",
    "start_s": "Initial values, evidence of the cells",
    "training_s": "Training",
}
_MAX_LISTED = 50


def write_report(path: AnyPath, subject: Subject) -> int:
    """Write a self-contained HTML page about a map atomically, and return its size, bytes. Needs matplotlib and viser."""
    require_extras()
    report = subject.radar_map.report
    settings, defaults = (flat_settings(of.to_dict()) for of in (subject.radar_map.config, FitConfig()))
    return write_page(
        path,
        "report.html",
        subject=subject,
        report=report,
        noise=report.get("noise"),
        fit_s=sum(value for name, value in report.items() if name.endswith("_s") and name != "skipped_s"),
        problems=[finding for finding in subject.findings or () if finding.severity != "note"],
        poses=pose_values(report.get("poses")),
        surface=surface_values(subject),
        errors=error_values(subject),
        uncertainty=uncertainty_values(subject),
        intensity=intensity_values(subject),
        training=_training(report),
        durations=[(name, fixed(report[key], 2, "s")) for key, name in _DURATIONS.items() if key in report],
        skipped=[
            (name, "–" if seconds is None else f"about {seconds:.1f} s")
            for name, seconds in itertools.zip_longest(report.get("skipped", []), report.get("skipped_s", []))
        ],
        changed=[(n, value, defaults[n]) for n, value in settings.items() if value != defaults[n]],
        toml=to_toml(subject.radar_map.config),
    )


def pose_values(poses: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Values of the section on estimated poses. `poses`: their part of a map's report, None for poses used as passed."""
    if poses is None:
        return None
    after = np.array(poses["after"])
    before = None if poses["before"] is None else np.array(poses["before"])
    sigma_m, sigma_deg = np.median(poses["sigma_m"]), np.degrees(np.median(poses["sigma_rad"]))
    return {
        "verdict": poses["verdict"],
        "improved": poses["improved"],
        "trajectory": plots.trajectory(before, after),
        "sigma": (sigma_m, sigma_deg) if sigma_m else None,
        "length_m": np.linalg.norm(np.diff(after, axis=0), axis=1).sum(),
        "moved_m": None if before is None else np.linalg.norm(after - before, axis=1),
    }


def _training(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [(name, f"{report[key]:,}") for key, name in _COUNTS.items() if key in report]
    if missing := report.get("missing_tiles"):
        rows.append(("Missing tiles", ", ".join(missing)))
    for stage, done in report.get("iterations_done", {}).items():
        rows.append((f"Iterations, {stage}", f"{done:,} of {report['iterations'][stage]:,}"))
    return rows


def write_changes_report(
    path: AnyPath, changes: Changes, names: tuple[str, str], edge_m: float, regions: Sequence[Region]
) -> int:
    """Write a self-contained HTML page about changes atomically, and return its size, bytes.

    `names`: of the earlier and the later map. `edge_m`: vertex spacing of their surfaces. `regions`: the changes to
    list, largest first. Raises an ImportError if matplotlib or viser is missing, an OSError if the file cannot be written.
    """
    require_extras()
    mesh: Any = thinned(changes.mesh(), MAX_VERTICES, edge_m)[0]
    surface = None
    if len(mesh.faces):
        colors = colors_of(mesh.vertex_attributes["kind"])
        vertices = np.asarray(mesh.vertices, np.float64)
        local = vertices - vertices.mean(axis=0)
        surface = {"scene": scene(local, mesh.faces, colors), "views": views(mesh, colors)}
    rows = []
    for number, region in enumerate(regions[:_MAX_LISTED], 1):
        size = "{:.1f} × {:.1f} × {:.1f}".format(*(region.box[1] - region.box[0]))
        numbers = fixed(region.area_m2, 2), fixed(region.probability, 2)
        rows.append((number, region.words, centre_of(region), size, *numbers))
    values = {"report": changes.report, "regions": regions, "rows": rows, "max_listed": _MAX_LISTED}
    kinds = [NAMES[kind] for kind in CHANGED]
    return write_page(path, "changes.html", names=names, surface=surface, key=MEANING, kinds=kinds, **values)
