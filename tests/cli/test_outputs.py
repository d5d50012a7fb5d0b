# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Every output of a command is checked before its work."""

from __future__ import annotations

import pytest

from .calls import FAST, refusal


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
