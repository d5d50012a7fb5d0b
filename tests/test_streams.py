# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Standard output and error closed, full or without a reader, or of few characters; a wrong environment variable."""

from __future__ import annotations

import io
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf import FitConfig
from radarsdf.io.npz import write_scans
from radarsdf.io.scans import Scans

from .cli.calls import call
from .warm_python import warm_python

SOURCES = str(Path(radarsdf.__file__).parents[1])  # the commands run in another folder
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX")


def no_stream():
    return None


def closed_stream():
    stream = io.StringIO()
    stream.close()
    return stream


@pytest.mark.parametrize("stream", [no_stream, closed_stream])
@pytest.mark.parametrize("progress", [None, True, False])
def test_no_standard_error(scene, monkeypatch, stream, progress):
    monkeypatch.setattr(sys, "stderr", stream())
    config = FitConfig(training={"sdf_iterations": 2, "batch_size": 64})
    radar_map = radarsdf.fit(scene.points, scene.poses, config=config, progress=progress)
    radar_map.mesh(0.1, progress=progress)


@pytest.fixture
def files(tmp_path, scene):
    return with_scans(tmp_path, scene)


def with_scans(folder, scene):
    truth = np.column_stack([np.random.default_rng(0).uniform([9, -5], [19, 5], (500, 2)), np.zeros(500)])
    write_scans(folder / "scans.npz", Scans(scene.points, scene.poses, scene.intensities, truth))
    return folder


def shell(folder, words):
    return run(folder, f"{sys.executable} -c '{MAIN}' {words}")


def run(folder, command):
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return subprocess.run(
        command,
        shell=True,
        cwd=folder,
        env=buffered | {"PYTHONPATH": SOURCES},
        capture_output=True,
        text=True,
        check=False,
    )


MAIN = "import sys; from radarsdf.cli import main; sys.exit(main())"
QUICK = ["--quick", "--set", "training.intensity_iterations=5", "--set", "num_threads=1"]
COMMANDS = {
    "info": ["info"],
    "config": ["config"],
    "fit": ["fit", "scans.npz", "-o", "map.safetensors", "--holdout", "3", *QUICK],
    "mesh": ["mesh", "map.safetensors", "-o", "mesh.ply", "--voxel", "0.4"],
    "eval": ["eval", "map.safetensors", "scans.npz", "--holdout", "3", "--samples", "1000"],
    "demo": ["demo", "--scene", "wall", "--frames", "3", "--out", "demo", *QUICK],
    "wrong": ["fit", "scans.npz", "-o", "other.safetensors", "--set", "nonsense=1"],
}
# One process for all commands; the demo, whose sizes have no options, is made smaller.
DRIVER = """
import functools, json, os, sys
from radarsdf import evaluation
from radarsdf.cli import main
from radarsdf.render import picture
picture.save_picture = functools.partial(picture.save_picture, width=160, height=100)
surface_metrics = evaluation.surface_metrics
evaluation.surface_metrics = lambda *given, samples, **named: surface_metrics(*given, samples=min(samples, 1000), **named)
commands, before_all, before_each = json.load(open("commands.json"))
exec(before_all)
statuses = {}
for name, words in commands.items():
    exec(before_each)
    statuses[name] = main(words)
json.dump(statuses, open("statuses.json", "w"))
"""
# As Python leaves a stream that was closed when it began: the next file that is opened has its number.
NO_OUTPUT, NO_ERRORS = "os.close(1); sys.stdout = None", "os.close(2); sys.stderr = None"
FULL = "os.dup2(os.open('/dev/full', os.O_WRONLY), 1)"
NO_READER = "r, w = os.pipe(); os.close(r); os.dup2(w, 1)"


def all_commands(folder, redirections="", before_all="", before_each=""):
    """Status, output and errors of all commands, run by one process in the folder."""
    (folder / "commands.json").write_text(json.dumps([COMMANDS, before_all, before_each]))
    (folder / "driver.py").write_text(DRIVER)
    # With streams that are closed from the start, a process of its own.
    python = sys.executable if "&-" in redirections else shlex.join(warm_python())
    done = run(folder, f"{python} driver.py {redirections}")
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "statuses.json").read_text()), done.stdout, done.stderr


def check_maps(folder, usual):
    for name in ("map.safetensors", "demo/map.safetensors"):
        ours, theirs = radarsdf.load(folder / name).field, radarsdf.load(usual / name).field
        for value, expected in zip(ours.parameters(), theirs.parameters(), strict=True):
            assert value.numpy().tobytes() == expected.numpy().tobytes()


@pytest.fixture(scope="module")
def usual(scene, tmp_path_factory):
    """A folder in which all commands have run, what they printed, and the one error."""
    folder = with_scans(tmp_path_factory.mktemp("usual"), scene)
    statuses, printed, said = all_commands(folder)
    assert statuses == dict.fromkeys(COMMANDS, 0) | {"wrong": 1}
    return folder, printed, said


@POSIX
@pytest.mark.parametrize(
    ("redirections", "before_all"),
    [("", NO_OUTPUT), ("", NO_ERRORS), (">&- 2>&-", ""), ("2>/dev/full", "")],
    ids=["no output", "no errors", "neither from the start", "errors to a full disk"],
)
def test_every_command_without_streams(files, usual, redirections, before_all):
    folder, printed, said = usual
    statuses, output, errors = all_commands(files, redirections, before_all)
    assert statuses == dict.fromkeys(COMMANDS, 0) | {"wrong": 1}
    assert errors == ("" if "2>" in redirections or before_all == NO_ERRORS else said)
    assert said.strip() not in output  # of an error without a standard error
    # All but seconds, and threads: a fork of the warm Python has one.
    found, expected = (
        [line for line in text.splitlines() if " s" not in line and not line.endswith(" threads")]
        for text in (output, printed)
    )
    assert found == ([] if redirections.startswith(">&-") or before_all == NO_OUTPUT else expected)
    check_maps(files, folder)
    for name in ("mesh.ply", "demo/mesh.ply"):
        assert (files / name).read_bytes() == (folder / name).read_bytes()


@POSIX
@pytest.mark.parametrize("before_each", [FULL, NO_READER])
def test_every_command_with_an_output_that_nothing_can_be_written_to(files, usual, before_each):
    statuses, _, errors = all_commands(files, before_each=before_each)
    assert statuses == dict.fromkeys(COMMANDS, 1)
    *lines, wrong = errors.splitlines(keepends=True)
    assert wrong == usual[2]
    assert [line.split(":")[0] for line in lines] == [
        f"radarsdf {name}" for name in COMMANDS if name != "wrong"
    ]
    assert all(": standard output: " in line for line in lines)
    # The files were written before, but for the demo, which says something before its work.
    assert (files / "mesh.ply").read_bytes() == (usual[0] / "mesh.ply").read_bytes()
    assert list((files / "demo").iterdir()) == []


@POSIX
@pytest.mark.parametrize("words", ["config", "--help", "config --help"])
def test_a_process_whose_output_cannot_be_written_ends_with_one_line(tmp_path, words):
    done = shell(tmp_path, f"{words} > /dev/full")
    assert done.returncode == 1
    assert done.stderr.startswith("radarsdf")
    assert done.stderr.endswith(": standard output: No space left on device\n")
    assert done.stderr.count("\n") == 1
    assert shell(tmp_path, f"{words} > /dev/full 2>&1").returncode == 1


def test_characters_that_the_output_lacks(tmp_path, monkeypatch):
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    printed = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, encoding="ascii"))
    assert call("eval", tmp_path / "mesh.ply", tmp_path / "mesh.ply", "--samples", 1000) == 0
    sys.stdout.flush()
    assert b"rad?" in printed.getvalue()


@POSIX
def test_an_unknown_instruction_set_is_said_once():
    # Each child loads the core anew; PyTorch, which takes seconds, is there already.
    code = """
import os, sys, torch
for name in ("nonsense", "", "baseline"):
    print(f"<{name}>", file=sys.stderr, flush=True)
    if (child := os.fork()) == 0:
        os.environ["RADARSDF_ISA"] = name
        import radarsdf.evaluation, radarsdf.map.radar_map, radarsdf.threads
        os._exit(17)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 17
"""
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", code]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    wrong, right = said.split("<>\n")
    assert wrong.count("RADARSDF_ISA=nonsense is none of baseline") == 1
    assert right == "<baseline>\n"
