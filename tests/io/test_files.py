"""Outputs are checked before the work, and written whole; meshes in UTM coordinates survive their files."""

import os
import stat
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from radarsdf.io.files import check_outputs, whole_file, write_whole
from radarsdf.io.meshes import MESH_SUFFIXES, write_mesh

posix = pytest.mark.skipif(sys.platform == "win32", reason="links, pipes and permissions of POSIX")


@posix
def test_a_link_is_followed_and_permissions_are_kept(tmp_path):
    file, link = tmp_path / "map", tmp_path / "latest"
    file.write_bytes(b"old")
    file.chmod(0o600)
    link.symlink_to(file)
    write_whole(link, b"new")
    assert link.is_symlink()
    assert file.read_bytes() == b"new"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@posix
def test_the_next_write_removes_files_of_killed_ones(tmp_path):
    target = tmp_path / "map [1].npz"
    killed = "import os, sys, radarsdf.io.files as f\nwith f.whole_file(sys.argv[1]): os.kill(os.getpid(), 9)"
    for _ in range(2):
        subprocess.run([sys.executable, "-c", killed, str(target)], check=False)
    assert len(list(tmp_path.iterdir())) == 1  # the second one removed the file of the first
    with whole_file(target) as slow:
        write_whole(target, b"fast")
        slow.write(b"slow")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"slow"]


@posix
def test_a_pipe_is_rejected_and_kept(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for function in (lambda path: write_whole(path, b""), lambda path: check_outputs([path])):
        with pytest.raises(ValueError, match="not a regular file"):
            function(tmp_path / "pipe")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    with pytest.raises(ValueError, match="not a regular file"):
        check_outputs([os.devnull])


def test_outputs_that_cannot_be_written_are_rejected(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileNotFoundError):
        check_outputs([tmp_path / "absent" / "map"])
    with pytest.raises(IsADirectoryError):
        check_outputs([tmp_path / "folder"])
    with pytest.raises(OSError, match="too long"):
        check_outputs([tmp_path / ("n" * 256)])


def test_duplicate_outputs_are_rejected(tmp_path):
    scans = tmp_path / "scans.npz"
    scans.write_bytes(b"scans")
    with pytest.raises(ValueError, match="same file"):
        check_outputs([tmp_path / "." / "scans.npz"], [scans])
    with pytest.raises(ValueError, match="same file"):
        check_outputs([tmp_path / "map", tmp_path / "map"])
    if sys.platform != "win32":
        (tmp_path / "link").symlink_to(scans)
        with pytest.raises(ValueError, match="same file"):
            check_outputs([tmp_path / "link"], [scans])
    assert scans.read_bytes() == b"scans"


UTM_M = np.array([691_000.0, 5_335_000.0, 520.0])


def sphere(origin=UTM_M):
    mesh = trimesh.creation.icosphere(3, 5.0)
    mesh.vertices = mesh.vertices + origin
    mesh.vertex_attributes["confidence"] = np.linspace(0, 1, len(mesh.vertices), dtype=np.float32)
    return mesh


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_vertices_are_right_to_a_tenth_of_a_millimetre(tmp_path, suffix):
    mesh, path = sphere(), tmp_path / f"mesh{suffix}"
    if suffix in (".stl", ".glb"):
        with pytest.raises(ValueError, match="float32"):
            write_mesh(path, mesh)
        mesh = sphere(np.array([900.0, -300.0, 20.0]))
    write_mesh(path, mesh)
    read = trimesh.load_mesh(path, process=False)
    vertices = np.asarray(read.triangles).reshape(-1, 3)
    if suffix == ".glb":  # x right, y up, z towards the viewer
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    np.testing.assert_allclose(vertices, np.asarray(mesh.triangles).reshape(-1, 3), atol=1e-4)


def test_a_mesh_without_triangles_is_refused_as_glb_alone(tmp_path):
    empty = trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), int), process=False)
    empty.visual.vertex_colors = np.zeros((0, 4), np.uint8)
    with pytest.raises(ValueError, match="no triangle"):
        write_mesh(tmp_path / "empty.glb", empty)
    assert not list(tmp_path.iterdir())
    write_mesh(tmp_path / "empty.ply", empty)


def test_ply_keeps_attributes_colours_and_faces(tmp_path):
    mesh = sphere()
    colors = np.arange(4 * len(mesh.vertices)).reshape(-1, 4) % 256
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    write_mesh(tmp_path / "mesh.ply", mesh)
    read = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices)  # to the bit
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(read.visual.vertex_colors, mesh.visual.vertex_colors)
    assert b"property double x" in (tmp_path / "mesh.ply").read_bytes()[:500]
    confidence = read.metadata["_ply_raw"]["vertex"]["data"]["confidence"].ravel()
    np.testing.assert_array_equal(confidence, mesh.vertex_attributes["confidence"])
