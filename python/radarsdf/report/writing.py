# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Puts the sections together, and writes the page."""

from __future__ import annotations

from os import PathLike

from radarsdf.report.conclusion import conclusion_section
from radarsdf.report.extras import require_extras
from radarsdf.report.intensity import intensity_section
from radarsdf.report.page import write_page
from radarsdf.report.subject import Subject
from radarsdf.report.surface import surface_section
from radarsdf.report.training import (
    configuration_section,
    findings_section,
    skipped_section,
    training_section,
    versions_section,
)
from radarsdf.report.trajectory import trajectory_section
from radarsdf.report.truth import truth_section, uncertainty_section


def write_report(path: str | PathLike[str], subject: Subject) -> int:
    """Write a page about a map, whole or not at all. It holds all that it shows.

    Parameters
    ----------
    path : path-like
        The HTML file. An old file is replaced once the new one is complete.
    subject : Subject
        What it is about.

    Returns
    -------
    int
        Size of the file, bytes.

    Raises
    ------
    ImportError
        If matplotlib or viser is missing.
    ValueError
        As :meth:`Map.mesh`.
    MemoryError
        If the voxels of the mesh need too much memory.
    OSError
        If the file cannot be written.
    """
    require_extras()
    errors, error_facts, of_surface = truth_section(subject)
    uncertainty, of_uncertainty = uncertainty_section(subject)
    intensity, intensity_facts, of_intensity = intensity_section(subject)
    poses, of_poses = trajectory_section(subject)
    sections = [
        conclusion_section(subject, [*of_poses, *of_surface, *of_uncertainty, *of_intensity]),
        findings_section(subject),
        *poses,
        surface_section(subject),
        errors,
        uncertainty,
        intensity,
        training_section(subject),
        skipped_section(subject),
        configuration_section(subject),
        versions_section(),
    ]
    facts = [*_facts(subject), *error_facts, *intensity_facts]
    return write_page(path, subject.name, "report", facts, sections)


def _facts(subject: Subject) -> list[tuple[str, str]]:
    """What stands above all."""
    report = subject.radar_map.report
    facts = []
    if subject.scans is not None:
        facts.append(("Scans", f"{len(subject.scans):,}"))
    if "returns" in report:
        facts.append(("Returns", f"{report['returns']:,}"))
        facts.append(
            ("Fit", f"{sum(v for k, v in report.items() if k.endswith('_s') and k != 'skipped_s'):.1f} s")
        )
    facts.append(("Surface", f"{subject.mesh.area:,.0f} m²"))
    facts.append(("Map", f"{subject.radar_map.file_bytes / 1e6:.1f} MB"))
    return facts
