# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A report of the small scene, with scans held out and ground truth, written once."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.io import Scans

from .reading import Page

HOSTILE = """<script>alert("$title")</script>'&amp;.safetensors"""


@pytest.fixture(scope="session")
def subject(scene, radar_map):
    pytest.importorskip("viser", reason="the extra view is not installed")
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from radarsdf.report.subject import Subject  # noqa: PLC0415

    truth = np.stack(np.meshgrid(np.arange(9, 19, 0.5), np.arange(-5, 5, 0.5), [0.0]), -1).reshape(-1, 3)
    scans = Scans(scene.points, scene.poses, scene.intensities, truth)
    train, test = np.arange(1, 6), np.arange(1)
    findings = [radarsdf.Finding("made_up", "warning", "<b>1 of 2</b>", "Mend <i>it</i>.")]
    return Subject(
        radar_map,
        HOSTILE,
        scans.select(train),
        scans.select(test),
        findings,
        voxel_size_m=0.25,
        progress=False,
    )


@pytest.fixture(scope="session", autouse=True)
def small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("radarsdf.report.surface._WIDTH", 160)
        patch.setattr("radarsdf.report.surface._HEIGHT", 100)
        patch.setattr("radarsdf.report.truth._SAMPLES", 20_000)
        yield


@pytest.fixture(scope="session")
def written(subject, tmp_path_factory):
    """The file of the report, and its page as it is read."""
    from radarsdf.report.writing import write_report  # noqa: PLC0415

    path = tmp_path_factory.mktemp("report") / "report.html"
    assert write_report(path, subject) == path.stat().st_size
    return path, Page(path.read_text("utf-8"))
