# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The section about poses."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from .reading import Page

WAY = {
    "verdict": "Poses <b>are</b> better.", "improved": True, "step_m": 0.05, "step_rad": 0.01, "scans": [0, 1, 2],
    "before": [[0.0, 0, 0], [1, 1, 0], [2, 2, 0]], "after": [[0.0, 0, 0], [1, 0, 0], [2, 0, 1]],
    "sigma_m": [0.02, 0.0, 0.02], "sigma_rad": [0.01, 0.0, 0.01],
}  # fmt: skip


def section(**changes):
    pytest.importorskip("viser", reason="the extra view is not installed")
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from radarsdf.report.trajectory import trajectory_section  # noqa: PLC0415

    report = {"poses": WAY | changes}
    sections, verdicts = trajectory_section(SimpleNamespace(radar_map=SimpleNamespace(report=report)))
    return Page("".join(sections[0].body)), verdicts[0]


def test_before_and_after_with_figures():
    page, verdict = section()
    assert (verdict.mark, verdict.text) == ("good", WAY["verdict"])
    text = page.sections[""]
    assert WAY["verdict"] in text
    for figure in ("2.4\xa0m", "1.414\xa0m", "2.236\xa0m", "0.050\xa0m, 0.57°", "0.020\xa0m, 0.57°"):
        assert figure in text
    assert len(page.all("img")) == 2


def test_poses_that_were_kept_or_found():
    page, verdict = section(improved=False, sigma_m=[0.0] * 3)
    assert verdict.mark == "warning"
    assert "moved by" not in page.sections[""]
    assert len(page.all("img")) == 1
    page, verdict = section(improved=None, before=None, step_m=None, step_rad=None)
    assert verdict.mark == "good"
    assert "A given step" not in page.sections[""]


def test_of_poses_as_given_nothing_is_said(written):
    _, page = written
    assert "poses" not in [found["id"] for found in page.all("section")]
