"""``radarsdf info``, ``mesh``, ``render`` and ``eval``; other folders have ``grid`` and ``compare``."""

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf import _core
from radarsdf.io.npz import write_scans
from radarsdf.scans import Scans

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


def test_mesh_writes_a_coloured_box_with_a_picture(map_file, tmp_path, capsys):
    ply, png = tmp_path / "mesh.ply", tmp_path / "mesh.png"
    view = ["--viewpoint", 2, 0, 1.5, "--picture", png]
    said = values(capsys, "mesh", map_file, "-o", ply, "--voxel", 0.2, *BOX, *view, "--quiet")
    mesh = trimesh.load_mesh(ply, process=False)
    assert (said["triangles"], said["out"]) == (len(mesh.faces), str(ply))
    assert (mesh.bounds[0] >= [8.9, -4.1, -1.1]).all()
    assert (mesh.bounds[1] <= [18.1, 4.1, 1.1]).all()
    assert "intensity" in mesh.metadata["_ply_raw"]["vertex"]["properties"]
    assert png.read_bytes().startswith(b"\x89PNG")


def test_stricter_limits_make_smaller_meshes(map_file, tmp_path, capsys):
    def triangles(*words):
        out = tmp_path / "mesh.ply"
        said = values(capsys, "mesh", map_file, "-o", out, "--voxel", 0.2, *BOX, "--quiet", *words)
        return said["triangles"]

    default = triangles()
    assert 0 < triangles("--min-confidence", 0.98) < default
    assert triangles("--min-confidence", 0) >= default
    assert 0 < triangles("--max-uncertainty", 0.015) < default


def test_impossible_meshes_are_rejected(map_file, scans_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.ply").symlink_to(map_file)
    out = ["-o", "mesh.ply"]
    for words, named in (
        ([map_file, *out, "--box", 900, 900, 900, 901, 901, 901], "no surface"),
        ([map_file, "-o", "mesh.txt"], "mesh.txt"),
        ([map_file, "-o", "absent/mesh.ply"], "absent"),
        ([map_file, *out, "--picture", "mesh.ply"], "same file"),
        ([map_file, *out, "--picture", "mesh.jpg"], "mesh.jpg"),
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


def test_a_view_is_written_as_points_and_as_a_picture(map_file, tmp_path):
    ply, png = tmp_path / "view.ply", tmp_path / "view.png"
    assert call("render", map_file, *POSE, "-o", ply, "--returns", 40, "--noise", "--seed", 3) == 0
    assert 0 < len(trimesh.load(ply).vertices) <= 40
    assert call("render", map_file, "--pose", "-1.3", 0.4, 1.5, "-o", png) == 0
    assert png.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "named"),
    [(["--pose", "nowhere.tum"], "nowhere.tum"), (["--pose", 900, 900, 900], "nothing written")],
)
def test_invalid_views_are_rejected(map_file, tmp_path, capsys, words, named):
    assert named in refusal(capsys, tmp_path, "render", map_file, "-o", tmp_path / "view.npz", *words)


SAMPLES = ["--samples", 20000]


@pytest.fixture(scope="module")
def mesh_file(map_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "mesh.ply"
    assert call("mesh", map_file, "-o", path, "--quiet") == 0
    return path


def row(printed, name):
    return next(line for line in printed.splitlines() if line.startswith(name))


def test_a_map_and_its_mesh_have_the_same_surface_errors(map_file, mesh_file, scans_file, capsys):
    rows = []
    for what in (mesh_file, map_file):
        capsys.readouterr()
        assert call("eval", what, scans_file, *SAMPLES, *BOX) == 0
        printed = capsys.readouterr()
        assert printed.err == ""
        assert "intensity" not in printed.out
        rows.append(row(printed.out, "F-score"))
    assert rows[0] == rows[1]


def test_errors_of_held_out_intensities_exclude_outliers(map_file, scene, tmp_path, capsys):
    intensities = [np.where(np.arange(len(scan)) % 100, scan, -9999) for scan in scene.intensities]
    path = tmp_path / "scans.npz"
    write_scans(path, Scans(scene.points, scene.poses, intensities))
    assert "lidar points" in refusal(capsys, tmp_path, "eval", map_file, path)
    found = values(capsys, "eval", map_file, path, "--holdout", 3)  # the scans 0 and 3
    assert "surface" not in found
    assert found["not_compared"] == 30
    assert found["held_out"]["num_returns"] == found["knn"]["num_returns"] == 2970


def test_unusable_files_are_rejected(map_file, mesh_file, scans_file, tmp_path, capsys):
    garbage, cloud = tmp_path / "garbage.ply", tmp_path / "cloud.ply"
    garbage.write_bytes(b"\x93 nothing \x00\xff")
    trimesh.PointCloud(np.eye(3)).export(cloud)
    for words, named in (
        ([garbage, scans_file], "garbage.ply"),
        ([mesh_file, garbage], "garbage.ply"),
        ([cloud, scans_file], "no surface"),
        ([tmp_path / "absent.ply", scans_file], "absent.ply"),
        ([mesh_file, tmp_path / "absent.ply"], "absent.ply"),
        ([mesh_file, scans_file, *SAMPLES, "--box", 900, 900, 900, 901, 901, 901], "box"),
    ):
        assert named in refusal(capsys, tmp_path, "eval", *words)
    for words in ([mesh_file, scans_file], [map_file, mesh_file]):
        assert "--holdout 3" in refusal(capsys, tmp_path, "eval", *words, "--holdout", 3, status=2)


PLANE = trimesh.Trimesh([[9, -4, 0], [18, -4, 0], [18, 4, 0], [9, 4, 0]], [[0, 1, 2], [0, 2, 3]])


def test_a_surface_is_ground_truth_everywhere_on_its_triangles(mesh_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("radarsdf.io.meshes._SAMPLES", 20_000)
    path = tmp_path / "plane.ply"
    PLANE.export(path)
    printed = values(capsys, "eval", mesh_file, path, *SAMPLES)["surface"]
    assert printed["num_ground_truth"] == 20_000
    assert printed["completion_ratio"] > 0.9  # none of its four vertices is near a return
