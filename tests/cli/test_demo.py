# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf demo`."""

from __future__ import annotations

import argparse
import sys

import pytest
import radarsdf
import trimesh
from radarsdf.cli import demo
from radarsdf.cli.demo import SCENES

from .calls import FAST, call, files, refusal


def test_it_writes_everything_and_prints_the_errors(tmp_path, capsys, monkeypatch):
    out = tmp_path / "demo"
    settings = ["--set", "training.sdf_iterations=100"]
    shown = []
    monkeypatch.setattr("radarsdf.cli.view.show", lambda *what, **how: shown.append((what, how)))
    monkeypatch.setattr(demo, "ends_with_viewer", lambda _: True)
    assert call("demo", "--frames", 4, "--out", out, *FAST, *settings) == 0
    ((radar_map, scans), how) = shown[0]
    assert (len(scans), how["voxel_size"]) == (4, 0.1)
    printed = capsys.readouterr()
    assert files(out) == ["map.safetensors", "mesh.ply", "picture.png", "scans.npz"]
    for word in ("accuracy", "completion", "F-score", "held-out intensity error", "kNN      intensity error"):
        assert word in printed.out
    assert printed.err == ""
    assert radarsdf.load(out / "map.safetensors").config.training.sdf_iterations == 100
    assert radar_map.config.training.sdf_iterations == 100
    assert len(trimesh.load_mesh(out / "mesh.ply", process=False).faces) > 0
    assert (out / "picture.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("view", "json", "terminal", "screen", "shown"),
    [
        (None, False, True, True, True),
        (None, False, True, False, False),
        (None, False, False, True, False),
        (None, True, True, True, False),
        (False, False, True, True, False),
        (True, False, False, False, True),
    ],
)
def test_the_viewer_ends_it_where_somebody_looks(monkeypatch, view, json, terminal, screen, shown):
    """It waits until Ctrl-C, so elsewhere it must not begin."""
    pytest.importorskip("viser", reason="the extra view is not installed")
    monkeypatch.setattr("radarsdf.view.serving.has_display", lambda: screen)
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal, raising=False)
    assert demo.ends_with_viewer(argparse.Namespace(view=view, json=json)) == shown


def test_without_the_viewer_it_ends_without(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr("radarsdf.view.serving.has_display", lambda: True)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert not demo.ends_with_viewer(argparse.Namespace(view=None, json=False))
    with pytest.raises(ImportError, match="pip install"):
        demo.ends_with_viewer(argparse.Namespace(view=True, json=False))


def test_it_offers_every_scene():
    assert sorted(SCENES) == sorted(radarsdf.simulate.SCENES)


@pytest.mark.parametrize("frames", [1, 0, -3])
def test_too_few_frames(tmp_path, capsys, frames):
    said = refusal(capsys, tmp_path, "demo", "--frames", frames, "--out", tmp_path / "demo")
    assert f"at least 2, one of them to be held out, not {frames}" in said
    assert not (tmp_path / "demo").exists()
