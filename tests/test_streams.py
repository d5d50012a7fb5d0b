# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Without a standard error, with a standard output of few characters, with a wrong variable in the environment."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
import radarsdf
import trimesh
from radarsdf import FitConfig
from radarsdf.io.scans import Scans, write_scans

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
    write_scans(tmp_path / "scans.npz", Scans(scene.points, scene.poses, scene.intensities, None))
    return tmp_path


def shell(folder, words, **environment):
    code = "import sys; from radarsdf.cli import main; sys.exit(main())"
    command = f"{sys.executable} -c '{code}' {words}"
    return subprocess.run(
        command,
        shell=True,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": SOURCES} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@POSIX
def test_a_fit_without_standard_error_keeps_the_map(files):
    done = shell(files, "fit scans.npz -o map.safetensors --quick 2>&-")
    assert done.returncode == 0
    assert "written to map.safetensors" in done.stdout
    radarsdf.load(files / "map.safetensors")
    done = shell(files, "fit scans.npz -o map.txt --set nonsense=1 2>&-")
    assert (done.returncode, done.stdout) == (1, "")


@POSIX
def test_a_fit_without_standard_output_keeps_the_map(files):
    assert shell(files, "fit scans.npz -o map.safetensors --quick >&-").returncode == 0
    radarsdf.load(files / "map.safetensors")


@POSIX
def test_characters_that_the_output_lacks(files):
    trimesh.creation.box().export(files / "mesh.ply")
    done = shell(files, "eval mesh.ply mesh.ply --samples 1000", PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert "rad?" in done.stdout


def test_an_unknown_instruction_set_is_said_once():
    code = "import radarsdf.evaluation, radarsdf.map.radar_map, radarsdf.threads"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"RADARSDF_ISA": "nonsense"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr.count("RADARSDF_ISA=nonsense is none of baseline") == 1
    for known in ("", "baseline"):
        environment = os.environ | {"RADARSDF_ISA": known}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stderr == ""
