"""Help, usage errors, exit statuses and streams of all commands."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.cli import Results, main, message_of
from radarsdf.cli.inputs import read_scans
from radarsdf.cli.options import COMMANDS, OPTIONS, TILE_STEPS, Parser
from radarsdf.cli.settings import load_config

from .calls import call, refusal

NAMES = [name for commands in COMMANDS.values() for name in commands]

IMPORTED = """
import sys
before = set(sys.modules)
from radarsdf.cli import main
main(sys.argv[1:])
print("imported:", *sorted({name.partition(".")[0] for name in set(sys.modules) - before} - sys.stdlib_module_names))
"""


def python(code, *words):
    words = [sys.executable, "-c", code, *words]
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)


def test_the_overview_lists_every_command_and_imports_nothing():
    done = python(IMPORTED, "--help")
    *said, imported = done.stdout.splitlines()
    assert imported == "imported: radarsdf"
    assert [line.split()[0] for line in said if line.startswith("  ")] == NAMES
    assert python(IMPORTED).stdout == done.stdout
    assert python(IMPORTED, "fit", "--help").stdout.splitlines()[-1] == imported


@pytest.mark.parametrize(
    "words", [*([name] for name in NAMES), *(["tiles", step] for step in TILE_STEPS)], ids=" ".join
)
def test_help(words, capsys):
    assert call(*words, "--help") == 0
    said = capsys.readouterr().out
    assert f"sage: radarsdf {' '.join(words)} " in said
    assert ("--json" in said) == (words[-1] not in ("config", "view", "tiles"))
    makes_a_mesh = words[-1] in ("demo", "mesh", "view", "report", "eval", "run")
    assert ("--min-confidence" in said) == makes_a_mesh


def test_the_version(capsys):
    assert call("--version") == 0
    assert capsys.readouterr().out == f"radarsdf {radarsdf.__version__}\n"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["paint"], "paint"),
        (["fit", "scans"], "-o"),
        (["fit", "-o", "map.safetensors"], "scans"),
        (["fit", "scans", "-o", "map.safetensors", "--dry-run"], "--dry-run"),
        (["fit", "scans", "-o", "map"], ".safetensors"),
        (["fit", "scans", "-o", "map.safetensors", "--quick", "--paper"], "--paper"),
        (["fit", "scans", "-o", "map.safetensors", "--set", "seed"], "--set takes NAME=VALUE, not 'seed'"),
        (["check", "scans", "--field", "intensity"], "--field"),
        (["mesh", "map", "-o", "mesh", "--box", "1"], "--box"),
        (["eval", "mesh"], "truth"),
        (["demo", "--frames", "1"], "--frames"),
        (["render", "map", "-o", "a.jpg", "--pose", "1", "2", "3"], ".npz, .ply, .png"),
        (["render", "map", "-o", "a.npz", "--pose", "1", "2"], "--pose"),
        (["report", "map", "-o", "a.html", "--holdout", "3"], "--holdout"),
        (["tiles", "scans"], "--out"),
        (["tiles", "status", "city", "--quick"], "--quick"),
        (["tiles", "fit", "city", "--processes", "0"], "--processes"),
    ],
    ids=" ".join,
)
def test_wrong_usage_is_status_2(words, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert named in refusal(capsys, tmp_path, *words, status=2)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("no such\nthing"), "no such thing"),
        (FileNotFoundError(2, "No such file", "scans.npz"), "scans.npz: No such file"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (MemoryError("needs 80 GB"), "needs 80 GB"),
        (MemoryError("Unable to allocate 4.04 MiB for an array"), "there is not enough memory"),
    ],
)
def test_an_error_is_one_line(error, said):
    assert message_of(error) == said


def test_ctrl_c_is_status_130(monkeypatch, capsys):
    def interrupt(_):
        raise radarsdf.Interrupted

    monkeypatch.setattr("radarsdf.cli.inputs.load_map", interrupt)
    assert call("info", "map.safetensors") == 130
    assert capsys.readouterr().err.startswith("error: interrupted")


def test_a_bug_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("radarsdf.cli.inputs.load_map", lambda _: {}["missing"])
    with pytest.raises(KeyError, match="missing"):
        main(["info", "map.safetensors"])


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
def test_a_broken_pipe_is_no_error():
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, "-m", "radarsdf", "config"]
    done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, timeout=60, check=False)
    os.close(write)
    assert done.stderr == b""


def test_numpy_types_and_infinity_are_converted_to_json(capsys):
    results = Results(json=True)
    results.add("a line for people", number=np.float32(0.5), row=np.arange(2), deep=[np.inf], name="word")
    assert capsys.readouterr().out == ""
    results.end()
    found = json.loads(capsys.readouterr().out)
    assert found == {"number": 0.5, "row": [0, 1], "deep": [None], "name": "word"}


def given(command, *words):
    """Parsed options of a command."""
    return Parser(command).parse_args([str(word) for word in words])


def config(*words):
    return load_config(given("config", *words))


def test_settings_override_a_file_and_a_file_a_preset(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("seed = 3\n[training]\nsdf_iterations = 7\nbatch_size = 64\n")
    changes = "training.batch_size=32 encoding.kind=octree returns.max_range_m=None networks.normals=true"
    assert config() == FitConfig()
    assert config("--paper") == FitConfig.paper()
    words = [word for change in changes.split() for word in ("--set", change)]
    assert config("--quick", "--config", path, *words) == FitConfig.quick(
        seed=3,
        training={"sdf_iterations": 7, "batch_size": 32},
        encoding={"kind": "octree"},
        returns={"max_range_m": None},
        networks={"normals": True},
    )


@pytest.mark.parametrize("preset", [[], ["--quick"], ["--paper"]])
def test_config_prints_a_file_that_reproduces_the_configuration(capsys, tmp_path, preset):
    path = tmp_path / "settings.toml"
    words = [*preset, "--set", "networks.intensity_hidden=(8, 4)"]
    assert call("config", *words) == 0
    path.write_text(capsys.readouterr().out)
    assert call("config", "--config", path) == 0
    assert capsys.readouterr().out == path.read_text()


def test_options_are_the_parameters_of_read(tmp_path):
    (tmp_path / "scans").mkdir()
    for i in range(4):
        row = np.array([[9, 5 + i, 1, 2], [9, 6 + i, 2, 3]], "<f4")
        row.tofile(tmp_path / "scans" / f"{100 + 2 * i}.0.bin")
    poses = tmp_path / "poses.tum"
    poses.write_text("".join(f"{100 + 4 * i} {i} 0 0 0 0 0 1\n" for i in range(3)))
    words = [tmp_path / "scans", poses, "--columns", "power,x,y,z"]
    for gap, count in (([], 2), (["--max-gap", 5.0], 4)):
        scans = read_scans(given("check", *words, *gap))
        assert len(scans) == count
        np.testing.assert_array_equal(scans.points[0], [[5, 1, 2], [6, 2, 3]])
    with pytest.raises(ValueError, match="world_frame"):
        read_scans(given("check", *words, "--world-frame", "map"))
    with pytest.raises(ValueError, match=r"poses\.tum"):
        read_scans(given("check", *words, "--extrinsic", poses))


def test_negative_numbers_are_not_parsed_as_options():
    words = ("map.safetensors", "-o", "mesh.ply", "--box", "-1e-05", "-.5", "-2", "-1e+00", "5", "6")
    assert given("mesh", *words).box == [[-1e-05, -0.5, -2.0], [-1.0, 5.0, 6.0]]


def test_the_help_states_the_actual_defaults():
    stated = {}
    for name, (kind, words) in OPTIONS.items():
        default = kind.get("default")
        if isinstance(default, (float, int, tuple)):
            shown = " ".join(f"{value:.10g}" for value in np.atleast_1d(default))
            stated[name] = shown if f"default: {shown}" in words else default
    assert {name: default for name, default in stated.items() if not isinstance(default, str)} == {
        "--rate": 1.0, "--seed": 0, "--align": True
    }  # fmt: skip
    assert {"--max-gap", "--voxel", "grid --voxel", "--samples", "--min-area", "--heights"} <= set(stated)
