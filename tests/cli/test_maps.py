# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf info``, ``mesh`` and ``render``; `test_eval.py` has ``eval``, other folders ``grid`` and ``compare``."""

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf import _core

from .calls import call, refusal, values

BOX = ["--box", 9, -4, -1, 18, 4, 1]
POSE = ["--pose", 1.3, 0.4, 1.5]


def test_info(map_file, capsys):
    assert call("info") == 0
    names = ["radarsdf", "python", "torch", "compiler", "openmp", "instruction set"]
    lines = capsys.readouterr().out.splitlines()
    for name, line in zip(names, lines, strict=True):
        assert line.startswith(f"{name} ")
    assert _core.__version__ in lines[0]
    of_map = values(capsys, "info", map_file)
    assert set(of_map) > {name.replace(" ", "_") for name in names}
    assert (of_map["scans"], of_map["returns"], of_map["leaf_size_m"]) == (4, 6000, 0.2)
    assert call("info", map_file) == 0
    assert str(of_map["leaf_cells"]) in capsys.readouterr().out


def test_a_mesh_of_a_part_in_colour_with_a_picture(map_file, tmp_path, capsys):
    ply, png = tmp_path / "mesh.ply", tmp_path / "mesh.png"
    view = ["--viewpoint", 2, 0, 1.5, "--picture", png]
    said = values(capsys, "mesh", map_file, "-o", ply, "--voxel", 0.2, *BOX, *view, "--quiet")
    mesh = trimesh.load_mesh(ply, process=False)
    assert (said["triangles"], said["out"]) == (len(mesh.faces), str(ply))
    assert (mesh.bounds[0] >= [8.9, -4.1, -1.1]).all()
    assert (mesh.bounds[1] <= [18.1, 4.1, 1.1]).all()
    assert "intensity" in mesh.metadata["_ply_raw"]["vertex"]["properties"]
    assert png.read_bytes().startswith(b"\x89PNG")


def test_a_mesh_is_smaller_where_more_is_asked(map_file, tmp_path, capsys):
    def triangles(*words):
        out = tmp_path / "mesh.ply"
        return values(capsys, "mesh", map_file, "-o", out, "--voxel", 0.2, *BOX, "--quiet", *words)[
            "triangles"
        ]

    default = triangles()
    assert 0 < triangles("--min-confidence", 0.995) < default
    assert triangles("--min-confidence", 0) >= default
    assert 0 < triangles("--max-uncertainty", 0.015) < default


def test_meshes_that_cannot_be_made(map_file, scans_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.ply").symlink_to(map_file)
    out = ["-o", "mesh.ply"]
    for words, named in (
        ([map_file, *out, "--voxel", 0], "voxel"),
        ([map_file, *out, "--box", 1, 1, 1, 0, 0, 0], "box"),
        ([map_file, *out, "--box", 900, 900, 900, 901, 901, 901], "no surface"),
        ([map_file, *out, "--min-confidence", "nan"], "min_confidence"),
        ([map_file, "-o", "mesh.txt"], "mesh.txt"),
        ([map_file, "-o", "absent/mesh.ply"], "absent"),
        ([map_file, *out, "--picture", "mesh.ply"], "same file"),
        ([map_file, "-o", "link.ply"], "same file"),
        (["absent.safetensors", *out], "absent.safetensors"),
        ([scans_file, *out], str(scans_file)),
    ):
        assert named in refusal(capsys, tmp_path, "mesh", *words)


def test_scans_of_several_poses(map_file, tmp_path, capsys):
    poses, out = tmp_path / "poses.tum", tmp_path / "view.npz"
    poses.write_text("0 1.3 0.4 1.5 0 0 0 1\n5 2.0 0.4 1.5 0 0 0 1\n")
    said = values(capsys, "render", "--pose", poses, *POSE, 0, 0, 0, 1, "-o", out, map_file)
    scans = radarsdf.io.read_scans(out)
    assert (said["returns"], said["scans"]) == (sum(map(len, scans.points)), 3)
    np.testing.assert_allclose(scans.poses[:, :3, 3], [[1.3, 0.4, 1.5], [2, 0.4, 1.5], [1.3, 0.4, 1.5]])
    expected = radarsdf.load(map_file).render(scans.poses[0])
    np.testing.assert_array_equal(np.sort(scans.points[0], axis=0), np.sort(expected.points, axis=0))
    assert scans.intensities is not None


def test_a_view_as_points_and_as_a_picture(map_file, tmp_path):
    ply, png = tmp_path / "view.ply", tmp_path / "view.png"
    assert call("render", map_file, *POSE, "-o", ply, "--returns", 40, "--noise", "--seed", 3) == 0
    assert 0 < len(trimesh.load(ply).vertices) <= 40
    assert call("render", map_file, "--pose", "-1.3", 0.4, 1.5, "-o", png) == 0
    assert png.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--pose", "nowhere.tum"], "nowhere.tum"),
        (["--pose", "nan", 0, 0], "rigid"),
        ([*POSE, "--returns", -1], "returns"),
        (["--pose", 900, 900, 900], "nothing written"),
    ],
)
def test_views_that_make_no_sense(map_file, tmp_path, capsys, words, named):
    assert named in refusal(capsys, tmp_path, "render", map_file, "-o", tmp_path / "view.npz", *words)
