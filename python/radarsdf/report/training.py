# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The sections of the training, of what was skipped, of findings, of the configuration and of versions."""

from __future__ import annotations

from typing import Any

import numpy as np

from radarsdf.config.fit_config import FitConfig, flat_settings
from radarsdf.config.toml import to_toml
from radarsdf.report import plots
from radarsdf.report.page import Section, folded, grid, image, items, note, paragraph, table
from radarsdf.report.subject import Subject
from radarsdf.versions import versions

_STEPS = {
    "prepare_s": "checks of the scans",
    "ghosts_s": "planes, noise of the sensor, false returns",
    "occupied_cells_s": "start and cells",
    "start_s": "start values, evidence of the cells",
    "training_s": "training",
}
_COUNTS = {
    "tiles": "Tiles",
    "returns": "Returns",
    "ghosts": "of these false, and left out of the surface",
    "movers": "of these moving, and left out",
    "wild_intensities": "of these with wild intensities, left out of the reflectance",
    "leaf_cells": "Leaf cells",
    "vertices": "Vertices of cells",
}
_LOSSES = {"sdf": "surface", "intensity": "intensity"}


def training_section(subject: Subject) -> Section:
    """Losses over time, what the fit had, and how long each step took."""
    report = subject.radar_map.report
    history = {
        _LOSSES[k]: v for k, v in report.get("loss_history", {}).items() if k in _LOSSES and v["losses"]
    }
    body = []
    if history:
        body.append(
            image(
                plots.losses(history),
                "The losses over the seconds of the training.",
                "Losses, on a logarithmic scale. Each point is the mean of some iterations. Once the surface is done, the "
                "intensity is trained on other samples, and its loss jumps.",
            )
        )
    else:
        body.append(paragraph("No losses: nothing was trained, or each tile has losses of its own."))
    took = [
        (words, f"{report[key]:.2f}\N{NO-BREAK SPACE}s") for key, words in _STEPS.items() if key in report
    ]
    tables = grid(table("What the fit had", (), _counts(report)), table("How long its steps took", (), took))
    return Section("training", "Training", [*body, tables])


def _counts(report: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [(words, f"{report[key]:,}") for key, words in _COUNTS.items() if key in report]
    if missing := report.get("missing_tiles"):
        rows.append(("Tiles that are missing", ", ".join(missing)))
    for name, count in report.get("iterations_done", {}).items():
        wanted = report["iterations"][name]
        stopped = "" if count == wanted else f" of {wanted:,}"
        rows.append((f"Iterations, {_LOSSES.get(name, name)}", f"{count:,}{stopped}"))
    if "noise" in report:
        n = report["noise"]
        across = [float(np.degrees(n[f"{axis}_rad"])) for axis in ("azimuth", "elevation")]
        rows.append(("Noise along the beam", f"{n['range_m']:.3f}\N{NO-BREAK SPACE}m"))
        rows.append(("Noise in azimuth", f"{across[0]:.2f}°"))
        rows.append(("Noise in elevation", f"{across[1]:.2f}°"))
    return rows


def skipped_section(subject: Subject) -> Section:
    """Parts of the method that were not run, and the time that this saved."""
    report, mesh = subject.radar_map.report, subject.mesh
    skipped = list(report.get("skipped", []))
    saved = [_saved(seconds) for seconds in report.get("skipped_s", [])]
    rows = [
        (words, saving)
        for words, saving in zip(skipped, saved + ["–"] * (len(skipped) - len(saved)), strict=True)
    ]
    if cells := mesh.metadata.get("leaf_cells"):
        away = 1 - mesh.metadata["leaf_cells_searched"] / cells
        rows.append(
            ("for the mesh, cells in which there can be no surface", f"{away:.0%} of {cells:,} cells")
        )
    body = [
        table("", ("skipped", "saved"), rows) or paragraph("Nothing was skipped."),
        note(
            "Seconds are estimates by the durations that radarsdf.estimate uses: of one machine, within a factor of two."
        ),
    ]
    return Section("skipped", "What was skipped", body)


def _saved(seconds: float | None) -> str:
    if seconds is None:
        return "unknown"
    return (
        f"about {seconds:.1f}\N{NO-BREAK SPACE}s" if seconds >= 0.05 else "less than 0.1\N{NO-BREAK SPACE}s"
    )


def findings_section(subject: Subject) -> Section:
    """What `radarsdf.check` says of the scans."""
    anchor, title = "check", "Check of the scans"
    if subject.findings is None:
        return Section(
            anchor, title, [paragraph("This report was made without scans: radarsdf check reads them.")]
        )
    bad = sum(finding.severity != "note" for finding in subject.findings)
    summary = (
        f"{bad} of {len(subject.findings)} findings need attention." if bad else "No errors and no warnings."
    )
    found = [(f.severity, f.name, f"{f.evidence} {f.mend}") for f in subject.findings]
    return Section(anchor, title, [paragraph(summary), items(found)])


def configuration_section(subject: Subject) -> Section:
    """What differs from the defaults, and all settings."""
    config = subject.radar_map.config
    ours, default = flat_settings(config.to_dict()), flat_settings(FitConfig().to_dict())
    changed = [
        (name, str(value), str(default[name])) for name, value in ours.items() if value != default[name]
    ]
    body = [
        table("Settings that are not the defaults", ("setting", "value", "default"), changed)
        or paragraph("All settings are the defaults."),
        folded("All settings, as a file for --config", to_toml(config)),
    ]
    return Section("configuration", "Configuration", body)


def versions_section() -> Section:
    """What `radarsdf info` prints, of the machine that wrote the report."""
    note_ = note("Of the program that wrote this page, as radarsdf info prints them.")
    return Section("versions", "Versions", [table("", (), versions().items()), note_])
