# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A map that cannot be written at the end, for a reason that was not there before the work, is saved elsewhere."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from pathlib import Path

import pytest
import radarsdf
from radarsdf.io.files import write_whole

from .calls import FAST, call, files
from .disks import mounted


@pytest.fixture
def out(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    return folder / "map.safetensors"


@pytest.fixture
def spare(tmp_path, monkeypatch):
    """The temporary folder."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def full_disk(monkeypatch):
    """A function: from now on, files in these folders cannot be written."""

    def fill(*folders):
        def write(path, data):
            if Path(path).parent in folders:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            write_whole(path, data)

        monkeypatch.setattr("radarsdf.map.storage.write_whole", write)

    return fill


def after_the_fit(monkeypatch, happens):
    fit = radarsdf.fit

    def fit_then(*arguments, **settings):
        radar_map = fit(*arguments, **settings)
        happens(radar_map)
        return radar_map

    monkeypatch.setattr(radarsdf, "fit", fit_then)


def failure(capsys, *words, status=1):
    """The one line of a command that fails."""
    capsys.readouterr()
    assert call(*words) == status
    said = capsys.readouterr().err
    assert said.startswith(f"radarsdf {words[0]}: ")
    assert said.count("\n") == 1
    return said


def kept_in(folder, said):
    (name,) = files(folder)
    assert f"the map was saved in {folder / name} instead" in said
    assert name.endswith(".safetensors")
    return radarsdf.load(folder / name)


def test_the_disk_is_full(scans_file, out, spare, full_disk, capsys):
    state = out.with_name("state")
    full_disk(out.parent)
    said = failure(capsys, "fit", scans_file, "-o", out, "--checkpoint", state, *FAST)
    assert f"{out} cannot be written ({os.strerror(errno.ENOSPC)})" in said
    kept = kept_in(spare, said)
    assert kept.config.training.sdf_iterations == 40
    again = failure(capsys, "fit", scans_file, "-o", out, *FAST)  # a new name each time
    assert again != said
    assert len(files(spare)) == 2


def test_the_folder_is_removed_during_the_fit(scans_file, out, spare, monkeypatch, capsys):
    after_the_fit(monkeypatch, lambda _: shutil.rmtree(out.parent))
    said = failure(capsys, "fit", scans_file, "-o", out, *FAST)
    assert "there is no folder" in said
    assert kept_in(spare, said).has_intensity
    assert not out.parent.exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of POSIX")
def test_the_file_becomes_a_pipe_during_the_fit(scans_file, out, spare, monkeypatch, capsys):
    after_the_fit(monkeypatch, lambda _: os.mkfifo(out))
    said = failure(capsys, "fit", scans_file, "-o", out, *FAST)
    assert "not a regular file" in said
    kept_in(spare, said)


def test_nothing_can_be_written(scans_file, out, spare, full_disk, monkeypatch, capsys):
    full_disk(spare)
    after_the_fit(monkeypatch, lambda _: shutil.rmtree(out.parent))
    said = failure(capsys, "fit", scans_file, "-o", out, *FAST)
    assert "there is no folder" in said
    assert os.strerror(errno.ENOSPC) in said
    assert "the map is lost" in said
    assert files(spare) == []


def test_a_checkpoint_stays_where_the_map_was_not_written(
    scans_file, out, spare, full_disk, monkeypatch, capsys
):
    state = spare.with_name("state")
    full_disk(out.parent, spare)
    after_the_fit(monkeypatch, lambda _: state.write_bytes(b"the state of the fit"))
    failure(capsys, "fit", scans_file, "-o", out, "--checkpoint", state, *FAST)
    assert state.exists()


def test_an_interrupted_map(scans_file, out, spare, full_disk, monkeypatch, capsys):
    def interrupt(radar_map):
        raise radarsdf.Interrupted(radar_map)

    full_disk(out.parent)
    after_the_fit(monkeypatch, interrupt)
    said = failure(capsys, "fit", scans_file, "-o", out, *FAST, status=130)
    assert said.startswith("radarsdf fit: interrupted while training; ")
    kept_in(spare, said)


def test_the_demo(out, spare, full_disk, capsys):
    full_disk(out.parent)
    said = failure(capsys, "demo", "--frames", 4, "--out", out.parent, *FAST)
    assert "map.safetensors cannot be written" in said
    kept_in(spare, said)


def test_the_map_of_the_demo_is_written_before_what_may_fail(out, monkeypatch, capsys):
    def mesh(*_, **__):
        msg = "the mesh is too large"
        raise MemoryError(msg)

    monkeypatch.setattr(radarsdf.RadarMap, "mesh", mesh)
    assert "too large" in failure(capsys, "demo", "--frames", 4, "--out", out.parent, *FAST)
    radarsdf.load(out)


@pytest.mark.parametrize("command", ["fit", "mesh", "demo"])
def test_a_small_disk(scans_file, map_file, out, spare, capsys, command):
    mesh = out.with_name("mesh.ply")
    words = {
        "fit": [scans_file, "-o", out, *FAST],
        "mesh": [map_file, "-o", mesh, "--voxel", 0.2],
        "demo": ["--frames", 4, "--out", out.parent, *FAST],
    }[command]
    with mounted(out.parent, "size=8k"):
        said = failure(capsys, command, *words)
        assert os.strerror(errno.ENOSPC) in said
        assert str(mesh if command == "mesh" else out) in said
        assert files(out.parent) == []
    if command != "mesh":
        kept_in(spare, said)
