# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf demo`."""

from __future__ import annotations

import pytest
import radarsdf
import trimesh
from radarsdf.cli.demo import SCENES

from .calls import FAST, call, files, refusal


def test_it_writes_everything_and_prints_the_errors(tmp_path, capsys):
    out = tmp_path / "demo"
    settings = ["--set", "training.sdf_iterations=100"]
    assert call("demo", "--frames", 4, "--out", out, *FAST, *settings) == 0
    printed = capsys.readouterr()
    assert files(out) == ["map.safetensors", "mesh.ply", "picture.png", "scans.npz"]
    for word in ("accuracy", "completion", "F-score", "held-out intensity error", "kNN      intensity error"):
        assert word in printed.out
    assert printed.err == ""
    assert radarsdf.load(out / "map.safetensors").config.training.sdf_iterations == 100
    assert len(trimesh.load_mesh(out / "mesh.ply", process=False).faces) > 0
    assert (out / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_it_offers_every_scene():
    assert sorted(SCENES) == sorted(radarsdf.simulate.SCENES)


@pytest.mark.parametrize("frames", [1, 0, -3])
def test_too_few_frames(tmp_path, capsys, frames):
    said = refusal(capsys, tmp_path, "demo", "--frames", frames, "--out", tmp_path / "demo")
    assert f"at least 2, one of them to be held out, not {frames}" in said
    assert not (tmp_path / "demo").exists()
