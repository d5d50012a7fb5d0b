# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf check`, and what `radarsdf fit` does with the same findings."""

from __future__ import annotations

import json

import numpy as np
import pytest
import radarsdf
from radarsdf.io.npz import write_scans
from radarsdf.io.scans import Scans

from .calls import FAST, call, refusal


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Good scans, the same with inverted poses, and with a copy of a scan."""
    scans = radarsdf.simulate.wall(frames=10)
    path = tmp_path_factory.mktemp("checked")
    write_scans(path / "good.npz", Scans(scans.points, scans.poses, scans.intensities))
    write_scans(path / "inverted.npz", Scans(scans.points, np.linalg.inv(scans.poses), scans.intensities))
    copied = ([*values[:5], values[4], *values[6:]] for values in (scans.points, scans.intensities))
    points, intensities = copied
    write_scans(path / "copied.npz", Scans(points, scans.poses, intensities))
    return path


def test_good_scans_have_notes_and_a_next_command(folder, capsys):
    assert call("check", folder / "good.npz") == 0
    *findings, following = capsys.readouterr().out.splitlines()
    assert findings
    assert all(line.startswith("note: ") for line in findings)
    assert following == f"next: radarsdf fit {folder / 'good.npz'} -o good.safetensors"


def test_the_next_command_has_the_settings_that_were_checked(folder, capsys):
    settings = ["--quick", "--set", "returns.max_range_m=30"]
    assert call("check", folder / "good.npz", *settings) == 0
    following = capsys.readouterr().out.splitlines()[-1]
    assert following.endswith("good.npz --quick --set returns.max_range_m=30 -o good.safetensors")


def test_an_error_is_the_first_line_and_the_status(folder, capsys):
    assert call("check", folder / "inverted.npz") == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("error: poses_inverted: ")
    assert lines[-1].startswith("next: mend the errors")


def test_json_has_the_same(folder, capsys):
    assert call("check", folder / "inverted.npz", "--json") == 1
    said = json.loads(capsys.readouterr().out)
    assert said["findings"][0]["name"] == "poses_inverted"
    assert set(said["findings"][0]) == {"name", "severity", "evidence", "mend"}
    assert said["next"].startswith("radarsdf check ")


def test_a_fit_of_nonsense_is_refused(folder, capsys):
    said = refusal(capsys, folder, "fit", folder / "inverted.npz", "-o", folder / "map.safetensors", *FAST)
    assert "poses_inverted" in said
    assert "--no-check" in said


def test_a_fit_of_nonsense_can_be_had(folder, tmp_path, capsys):
    out = tmp_path / "map.safetensors"
    assert call("fit", folder / "inverted.npz", "-o", out, "--no-check", *FAST) == 0
    assert out.exists()
    assert capsys.readouterr().err == ""


def test_a_fit_warns_and_goes_on(folder, tmp_path, capsys):
    out = tmp_path / "map.safetensors"
    assert call("fit", folder / "copied.npz", "-o", out, *FAST) == 0
    assert out.exists()
    assert capsys.readouterr().err.startswith("radarsdf fit: warning: duplicate_scans: ")
