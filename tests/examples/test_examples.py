# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Each example runs as a user runs it, writes what it says, and is short."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
# What an example needs beside the package, and what it writes.
NEEDS = {"ros_bag": "rosbags", "novel_views": "matplotlib", "rerun_logging": "rerun"}
WRITES = {
    "numpy_arrays": {"mesh.ply", "map.safetensors"},
    "folder": {"drive", "poses.tum", "map.safetensors"},
    "ros_bag": {"drive_bag", "map.safetensors"},
    "novel_views": {"view.png", "aside.ply"},
    "live": set(),
    "tiles": {"city", "city.ply"},
    "uncertainty_for_planning": set(),
    "rerun_logging": {"drive.rrd"},
}
MAX_LINES = 80
FILES = sorted(EXAMPLES.glob("*.py"))


def test_each_example_is_known_and_in_the_table():
    table = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert {path.stem for path in FILES} == set(WRITES)
    assert [
        path.name
        for path in EXAMPLES.iterdir()
        if path.name not in table and path.suffix in (".py", ".ipynb")
    ] == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) < MAX_LINES


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_example_runs_and_runs_again(path, tmp_path, monkeypatch, capsys):
    if path.stem in NEEDS:
        pytest.importorskip(NEEDS[path.stem])
    monkeypatch.setattr(sys, "argv", [str(path), *([str(tmp_path)] if WRITES[path.stem] else [])])
    for _ in range(1 + bool(WRITES[path.stem])):
        runpy.run_path(str(path), run_name="__main__")
    assert {written.name for written in tmp_path.iterdir()} == WRITES[path.stem]
    assert capsys.readouterr().out


def test_the_notebook_runs(tmp_path, monkeypatch):
    """Its cells run in order as a script: no kernel is needed."""
    display = pytest.importorskip("IPython.display", reason="a notebook needs IPython")
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((EXAMPLES / "map.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names = {"__name__": "notebook"}
    for cell in cells:
        exec("".join(cell["source"]), names)  # noqa: S102
    assert isinstance(names["Image"]("mesh.png"), display.Image)


def test_the_notebook_shows_what_its_cells_gave():
    """It was run from the first cell to the last, without an error, and its pictures are small."""
    path = EXAMPLES / "map.ipynb"
    cells = [
        cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"
    ]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells[1:] for output in cell["outputs"]]
    assert all(cell["outputs"] for cell in cells[1:])
    assert {output["output_type"] for output in outputs} == {"execute_result", "stream"}
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    assert path.stat().st_size < 200_000
