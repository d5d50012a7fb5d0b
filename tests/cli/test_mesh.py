# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf mesh`."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.map.threshold import Threshold

from .calls import call, refusal

BOX = ["--box", 9, -4, -1, 18, 4, 1]


def test_a_part_in_colour_with_a_picture(map_file, tmp_path, capsys):
    fitted = radarsdf.load(map_file).mesh(0.2, box=np.reshape(BOX[1:], (2, 3)), progress=False)
    ply, png = tmp_path / "mesh.ply", tmp_path / "mesh.png"
    view = ["--viewpoint", 2, 0, 1.5, "--picture", png]
    assert call("mesh", map_file, "-o", ply, "--voxel", 0.2, *BOX, *view, "--quiet") == 0
    mesh = trimesh.load_mesh(ply, process=False)
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [
        f"{len(mesh.vertices)} vertices and {len(mesh.faces)} triangles written to {ply}",
        f"{Threshold.of_mesh(fitted.metadata)}",
        f"picture written to {png}",
    ]
    assert printed.err == ""
    assert (mesh.bounds[0] >= [8.9, -4.1, -1.1]).all()
    assert (mesh.bounds[1] <= [18.1, 4.1, 1.1]).all()
    assert "intensity" in mesh.metadata["_ply_raw"]["vertex"]["properties"]
    assert png.read_bytes().startswith(b"\x89PNG")


def test_less_is_left_where_more_is_asked(map_file, tmp_path):
    def triangles(*words):
        path = tmp_path / "mesh.ply"
        assert call("mesh", map_file, "-o", path, "--voxel", 0.2, *BOX, "--quiet", *words) == 0
        return len(trimesh.load_mesh(path, process=False).faces)

    default = triangles()
    assert 0 < triangles("--min-confidence", 0.995) < default
    assert triangles("--min-confidence", 0) >= default
    assert 0 < triangles("--max-uncertainty", 0.015) < default


@pytest.mark.parametrize("viewpoint", [[], ["--viewpoint", 0, 0, 1]])
def test_a_mesh_without_triangles(map_file, tmp_path, capsys, viewpoint):
    far = ["--box", 900, 900, 900, 901, 901, 901]
    words = ["mesh", map_file, "-o", tmp_path / "mesh.ply", "--quiet", *far, *viewpoint]
    assert "no surface here" in refusal(capsys, tmp_path, *words)


def test_a_viewpoint_for_a_map_without_intensities(scans_file, tmp_path, capsys):
    path = tmp_path / "map.safetensors"
    assert call("fit", scans_file, "-o", path, "--quick", "--geometry-only") == 0
    words = ["mesh", path, "-o", tmp_path / "mesh.ply", "--viewpoint", 0, 0, 0]
    assert "viewpoint" in refusal(capsys, tmp_path, *words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--voxel", 0], "voxel"),
        (["--box", 1, 1, 1, 0, 0, 0], "box must be a lower and an upper corner"),
        (["--min-confidence", 2], "min_confidence"),
        (["--min-confidence", -0.1], "min_confidence"),
        (["--min-confidence", "nan"], "min_confidence"),
    ],
)
def test_values_that_make_no_sense(map_file, tmp_path, capsys, words, said):
    assert said in refusal(capsys, tmp_path, "mesh", map_file, "-o", tmp_path / "mesh.ply", *words)


@pytest.mark.parametrize("name", ["mesh.txt", "mesh", "absent/mesh.ply"])
def test_files_that_cannot_be_written(map_file, tmp_path, capsys, name):
    refusal(capsys, tmp_path, "mesh", map_file, "-o", tmp_path / name, "--voxel", 0.2, *BOX, "--quiet")


def test_files_that_are_no_map(scans_file, garbage, tmp_path, capsys):
    for path in (tmp_path / "absent.safetensors", garbage(".safetensors"), scans_file):
        assert str(path) in refusal(capsys, tmp_path, "mesh", path, "-o", tmp_path / "mesh.ply")
