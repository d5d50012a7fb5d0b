# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf report`, and `radarsdf fit --report`."""

from __future__ import annotations

import sys

import pytest

from .calls import FAST, call, files, refusal


@pytest.fixture
def no_work(monkeypatch):
    for function in ("radarsdf.fitting.fit.prepare", "radarsdf.map.storage.load_contents"):
        monkeypatch.setattr(function, lambda *_, **__: pytest.fail("the work began"))


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        (["viser"], 'a report needs viser: pip install "viser>=1.1"'),
        (["matplotlib"], 'a report needs matplotlib: pip install "matplotlib>=3.7"'),
        (
            ["matplotlib", "viser"],
            'a report needs matplotlib and viser: pip install "matplotlib>=3.7" "viser>=1.1"',
        ),
    ],
)
@pytest.mark.parametrize("command", ["fit", "report"])
@pytest.mark.usefixtures("no_work")
def test_what_to_install_is_said_before_the_work(
    scans_file, map_file, tmp_path, capsys, monkeypatch, command, missing, said
):
    for name in ("matplotlib", "viser"):
        if name in missing:
            monkeypatch.setitem(sys.modules, name, None)
        else:
            pytest.importorskip(name)
    page = tmp_path / "report.html"
    words = {
        "fit": ["fit", scans_file, "-o", tmp_path / "map.safetensors", "--report", page, *FAST],
        "report": ["report", map_file, scans_file, "-o", page],
    }[command]
    assert refusal(capsys, tmp_path, *words) == f"radarsdf {command}: {said}\n"


@pytest.mark.usefixtures("small_pictures", "no_work")
def test_outputs_are_checked_before_the_work(scans_file, map_file, tmp_path, capsys):
    out = tmp_path / "map.safetensors"
    words = ["fit", scans_file, "-o", out, *FAST, "--report"]
    assert "same file" in refusal(capsys, tmp_path, *words, out)
    assert "same file" in refusal(capsys, tmp_path, *words, scans_file)
    assert "absent" in refusal(capsys, tmp_path, *words, tmp_path / "absent" / "report.html")
    assert "same file" in refusal(capsys, tmp_path, "report", map_file, "-o", map_file)
    assert "same file" in refusal(capsys, tmp_path, "report", map_file, scans_file, "-o", scans_file)
    said = refusal(capsys, tmp_path, "report", map_file, "--holdout", 3, "-o", tmp_path / "report.html")
    assert "--holdout needs the scans" in said
    dry = ["fit", scans_file, "--dry-run", "--report", tmp_path / "report.html"]
    assert "leave out one of them" in refusal(capsys, tmp_path, *dry)


@pytest.mark.usefixtures("small_pictures")
def test_a_fit_with_its_report(scans_file, tmp_path, capsys):
    out, page = tmp_path / "map.safetensors", tmp_path / "report.html"
    assert call("fit", scans_file, "-o", out, "--report", page, "--holdout", 3, *FAST) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].startswith("report ")
    assert printed[-1].endswith(f" MB written to {page}")
    assert len([line for line in printed if "viser" in line]) == 0
    assert files(tmp_path) == ["map.safetensors", "report.html"]
    text = page.read_text("utf-8")
    assert "all 3,000 returns of the 2 scans that the fit left out" in text
    assert "<title>map.safetensors</title>" in text
    assert "intensity_constant" not in text
    assert "<b>cost</b>" in text


@pytest.mark.usefixtures("small_pictures")
def test_the_map_is_kept_if_the_report_fails(scans_file, tmp_path, capsys, monkeypatch):
    out, page = tmp_path / "map.safetensors", tmp_path / "report.html"

    def fail(*_):
        raise OSError(28, "No space left on device", str(page))

    monkeypatch.setattr("radarsdf.report.page.write_whole", fail)
    assert call("fit", scans_file, "-o", out, "--report", page, *FAST) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert files(tmp_path) == ["map.safetensors"]


@pytest.mark.usefixtures("small_pictures")
def test_a_report_of_a_map_and_scans(map_file, scans_file, tmp_path):
    page = tmp_path / "report.html"
    words = ["report", map_file, scans_file, "-o", page, "--holdout", 3, "--voxel", 0.4, "--quiet"]
    assert call(*words, "--box", 8, -6, -1, 21, 6, 5) == 0
    text = page.read_text("utf-8")
    assert "all 3,000 returns of the 2 scans that the fit left out" in text
    assert "F-score, nothing discarded" in text
    assert "Everything counts" not in text
