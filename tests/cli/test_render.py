# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf render`."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
import trimesh

from .calls import call, refusal

POSE = ["--pose", 1.3, 0.4, 1.5]


def test_scans_of_several_poses(map_file, tmp_path, capsys):
    poses, out = tmp_path / "poses.tum", tmp_path / "view.npz"
    poses.write_text("0 1.3 0.4 1.5 0 0 0 1\n5 2.0 0.4 1.5 0 0 0 1\n")
    capsys.readouterr()
    assert call("render", map_file, "--pose", poses, *POSE, 0, 0, 0, 1, "-o", out) == 0
    scans = radarsdf.io.read_scans(out)
    assert capsys.readouterr().out == f"{sum(map(len, scans.points))} returns of 3 scans written to {out}\n"
    np.testing.assert_allclose(scans.poses[:, :3, 3], [[1.3, 0.4, 1.5], [2, 0.4, 1.5], [1.3, 0.4, 1.5]])
    expected = radarsdf.load(map_file).render(scans.poses[0])
    np.testing.assert_array_equal(np.sort(scans.points[0], axis=0), np.sort(expected.points, axis=0))
    assert scans.intensities is not None


def test_points_and_a_picture(map_file, tmp_path, capsys):
    ply, png = tmp_path / "view.ply", tmp_path / "view.png"
    capsys.readouterr()
    assert call("render", map_file, *POSE, "-o", ply, "--returns", 40, "--noise", "--seed", 3) == 0
    cloud = trimesh.load(ply)
    assert capsys.readouterr().out == f"{len(cloud.vertices)} returns of 1 scan written to {ply}\n"
    assert 0 < len(cloud.vertices) <= 40
    assert call("render", map_file, *POSE, "-o", png) == 0
    assert png.read_bytes().startswith(b"\x89PNG")


def test_more_scans_than_memory_holds(map_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("radarsdf.memory.available_bytes", lambda: 10**6)
    poses = tmp_path / "poses.tum"
    poses.write_text("".join(f"{i} 1.3 0.4 1.5 0 0 0 1\n" for i in range(100)))
    said = refusal(capsys, tmp_path, "render", map_file, "--pose", poses, "-o", tmp_path / "view.npz")
    assert "ask for fewer poses or returns" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--pose", 1, 2], "--pose takes"),
        (["--pose", 1, 2, 3, 0, 0, 0, 0], "length 1"),
        (["--pose", "nowhere.tum"], "nowhere.tum"),
        (["--pose", "nan", 0, 0], "rigid"),
        ([*POSE, "--returns", -1], "returns"),
        ([*POSE, "--seed", -1], "--seed"),
        (["--pose", 900, 900, 900], "nothing written"),
    ],
)
def test_words_that_make_no_sense(map_file, tmp_path, capsys, words, said):
    assert said in refusal(capsys, tmp_path, "render", map_file, "-o", tmp_path / "view.npz", *words)


def test_an_output_of_another_kind(map_file, tmp_path, capsys):
    said = refusal(capsys, tmp_path, "render", map_file, *POSE, "-o", tmp_path / "view.jpg")
    assert ".npz, .ply, .png" in said
