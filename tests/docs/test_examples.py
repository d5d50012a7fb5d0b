"""Each example runs as for a user, and writes its files."""

import json
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NEEDS = {"ros_bag": "rosbags", "novel_views": "matplotlib", "rerun_logging": "rerun"}
NOT_RUN = {"ros2_node"}  # needs ROS
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


def test_examples_are_listed():
    table = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    assert names == {*WRITES, *NOT_RUN}
    assert all(f"]({name}.py)" in table for name in names)


@pytest.mark.parametrize("name", WRITES)
def test_example_runs_twice(name, tmp_path, monkeypatch, capsys):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    path = str(EXAMPLES / f"{name}.py")
    monkeypatch.setattr(sys, "argv", [path, str(tmp_path)] if WRITES[name] else [path])
    for _ in range(2 if WRITES[name] else 1):  # the second run replaces the files of the first
        runpy.run_path(path, run_name="__main__")
    assert {written.name for written in tmp_path.iterdir()} == WRITES[name]
    assert capsys.readouterr().out


def test_notebook_runs_and_holds_its_outputs(tmp_path, monkeypatch):
    display = pytest.importorskip("IPython.display", reason="a notebook needs IPython")
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((EXAMPLES / "map.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names = {"__name__": "notebook"}
    for cell in cells:
        exec("".join(cell["source"]), names)  # noqa: S102
    assert isinstance(names["Image"]("mesh.png"), display.Image)
    assert all(cell["outputs"] for cell in cells[1:])
