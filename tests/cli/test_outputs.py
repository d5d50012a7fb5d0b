# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Every output of a command is checked before its work."""

from __future__ import annotations

import os
import sys

import pytest

from .calls import FAST, refusal
from .disks import mounted


@pytest.fixture(autouse=True)
def no_work(monkeypatch):
    """Fails the test where a command begins to work."""
    for function in ("radarsdf.fitting.fit.prepare", "radarsdf.map.storage.load_contents"):
        monkeypatch.setattr(function, lambda *_, **__: pytest.fail("the work began"))


def test_the_checkpoint_is_not_the_map(scans_file, tmp_path, capsys):
    path = tmp_path / "map.safetensors"
    words = ["fit", scans_file, "-o", path, "--checkpoint", path, *FAST]
    assert "same file" in refusal(capsys, tmp_path, *words)


def test_the_map_is_not_the_scans(scans_file, tmp_path, capsys):
    scans = scans_file.read_bytes()
    (tmp_path / "link.npz").symlink_to(scans_file)
    for path in (scans_file, tmp_path / "link.npz"):
        assert "same file" in refusal(capsys, tmp_path, "fit", scans_file, "-o", path, *FAST)
    assert scans_file.read_bytes() == scans


@pytest.mark.parametrize("name", ["absent/map.safetensors", "folder", "n" * 300])
def test_a_map_that_cannot_be_written(scans_file, tmp_path, capsys, name):
    (tmp_path / "folder").mkdir()
    refusal(capsys, tmp_path, "fit", scans_file, "-o", tmp_path / name, *FAST)


@pytest.mark.parametrize(
    "words",
    [
        ["-o", "mesh.dae"],
        ["-o", "mesh"],
        ["-o", "absent/mesh.ply"],
        ["-o", "mesh.ply", "--picture", "absent/mesh.png"],
        ["-o", "mesh.ply", "--picture", "mesh.ply"],
    ],
)
def test_a_mesh_that_cannot_be_written(map_file, tmp_path, capsys, words):
    words = [word if word.startswith("-") else tmp_path / word for word in words]
    refusal(capsys, tmp_path, "mesh", map_file, *words)


def test_the_mesh_is_not_the_map(map_file, tmp_path, capsys):
    path = tmp_path / "mesh.ply"
    path.symlink_to(map_file)
    assert "same file" in refusal(capsys, tmp_path, "mesh", map_file, "-o", path)


@pytest.fixture(params=["read-only", "below a file"])
def closed_folder(request, tmp_path):
    """A folder in which nothing can be written."""
    if request.param == "below a file":
        (tmp_path / "file").write_bytes(b"")
        yield tmp_path / "file"
        return
    if sys.platform == "win32":
        pytest.skip("permissions of POSIX")
    folder = tmp_path / "closed"
    folder.mkdir()
    if os.geteuid() == 0:  # whom no permission stops
        with mounted(folder, "ro"):
            yield folder
    else:
        folder.chmod(0o500)
        yield folder
        folder.chmod(0o700)


@pytest.mark.parametrize(
    ("command", "outputs"),
    [
        ("fit", {"-o": "closed"}),
        ("fit", {"-o": "open", "--checkpoint": "closed"}),
        ("mesh", {"-o": "closed"}),
        ("mesh", {"-o": "open", "--picture": "closed"}),
        ("demo", {"--out": "closed"}),
        ("demo", {"--out": "closed/new"}),
    ],
)
def test_a_folder_in_which_nothing_can_be_written(
    scans_file, map_file, tmp_path, capsys, monkeypatch, closed_folder, command, outputs
):
    monkeypatch.setattr("radarsdf.simulate.scenes.hugin", lambda **_: pytest.fail("the work began"))
    words = {"fit": [scans_file, *FAST], "mesh": [map_file], "demo": ["--frames", 4, *FAST]}[command]
    for option, where in outputs.items():
        folder = tmp_path if where == "open" else closed_folder
        name = {"--out": "", "-o": f"out.{'ply' if command == 'mesh' else 'safetensors'}"}.get(
            option, "other"
        )
        words += [option, folder / where.removeprefix("closed/") if "/" in where else folder / name]
    assert str(closed_folder) in refusal(capsys, tmp_path, command, *words)
