# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf convert`: the same numbers in other files."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.io.scans import Scans

from .calls import call, refusal, values

UTM_M = np.array([691_000.0, 5_335_000.0, 520.0])


@pytest.fixture
def folder(scans_file, tmp_path):
    """A folder of clouds with poses, and the scans in it."""
    scans = read_scans(scans_file)
    for i, (points, power) in enumerate(zip(scans.points, scans.intensities, strict=True)):
        np.save(tmp_path / f"{i}.npy", np.column_stack([points, power]))
    np.save(tmp_path / "poses.npy", scans.poses)
    return tmp_path, scans


def test_a_folder_becomes_our_file(folder, tmp_path_factory, capsys):
    path, scans = folder
    out = tmp_path_factory.mktemp("out") / "scans.npz"
    assert call("convert", path, "-o", out) == 0
    assert capsys.readouterr().out == f"9000 returns of 6 scans written to {out}\n"
    read = read_scans(out)
    for ours, theirs in ((read.points, scans.points), (read.intensities, scans.intensities)):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(read.poses, scans.poses, atol=1e-12)


def test_scans_become_one_cloud(scans_file, tmp_path, capsys):
    scans = read_scans(scans_file)
    write_scans(tmp_path / "far.npz", Scans(scans.points, scans.poses + _shift(UTM_M), scans.intensities))
    world = np.concatenate(
        [x @ T[:3, :3].T + T[:3, 3] + UTM_M for x, T in zip(scans.points, scans.poses, strict=True)]
    )
    for suffix in (".ply", ".pcd", ".npy", ".csv"):
        out = tmp_path / f"cloud{suffix}"
        said = values(capsys, "convert", tmp_path / "far.npz", "-o", out)
        assert (said["returns"], said["scans"], said["out"]) == (9000, 6, str(out))
        assert (said["origin"] is not None) == (suffix == ".pcd")
        np.testing.assert_allclose(radarsdf.io.read_points(out), world, atol=1e-4, rtol=0)
    assert call("convert", tmp_path / "far.npz", "-o", tmp_path / "cloud.pcd") == 0
    assert f"whose origin is in {tmp_path / 'cloud.pcd.origin.json'}" in capsys.readouterr().out


def _shift(by):
    shift = np.zeros((4, 4))
    shift[:3, 3] = by
    return shift


def test_a_mesh_in_another_format(tmp_path, capsys):
    sphere = trimesh.creation.icosphere(2, 5.0)
    sphere.vertices = sphere.vertices + UTM_M
    radarsdf.io.write_mesh(tmp_path / "a.ply", sphere)
    for source, out in (("a.ply", "b.glb"), ("b.glb", "c.ply")):
        said = values(capsys, "convert", tmp_path / source, "-o", tmp_path / out)
        assert said["triangles"] == len(sphere.faces)
    read = radarsdf.io.read_mesh(tmp_path / "c.ply")
    np.testing.assert_allclose(read.triangles, sphere.triangles, atol=1e-3, rtol=0)


def test_what_cannot_be_written(folder, scans_file, tmp_path_factory, capsys):
    path, _ = folder
    out = tmp_path_factory.mktemp("out")
    for words, said in (
        ([path, "-o", out / "cloud.xyz"], "can be written as .ply, .pcd"),
        ([path, "-o", path / "cloud.npy"], "lies in the folder of the scans"),
        ([scans_file, "-o", scans_file], "is the same file as"),
        ([path, "-o", out], "it is a folder, not a file"),
        ([path, "-o", out / "absent" / "scans.npz"], "there is no folder"),
        ([out / "absent.npz", "-o", out / "scans.npz"], "absent.npz does not exist"),
    ):
        assert said in refusal(capsys, out, "convert", *words)
