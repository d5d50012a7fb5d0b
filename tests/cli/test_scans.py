"""``radarsdf check`` and ``convert``."""

import json

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.scans import Scans

from .calls import FAST, call, refusal, values


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Good scans, the same with inverted poses, and with a copy of a scan."""
    scans = radarsdf.simulate.wall(frames=10)
    path = tmp_path_factory.mktemp("checked")
    write_scans(path / "good.npz", Scans(scans.points, scans.poses, scans.intensities))
    write_scans(path / "inverted.npz", Scans(scans.points, np.linalg.inv(scans.poses), scans.intensities))
    points, powers = ([*rows[:5], rows[4], *rows[6:]] for rows in (scans.points, scans.intensities))
    write_scans(path / "copied.npz", Scans(points, scans.poses, powers))
    return path


def test_good_scans_have_only_notes(folder, capsys):
    assert call("check", folder / "good.npz", "--quick", "--set", "returns.max_range_m=30") == 0
    findings = capsys.readouterr().out.splitlines()
    assert findings
    assert all(line.startswith("note: ") for line in findings)


def test_an_error_is_the_first_line_and_the_status(folder, capsys):
    assert call("check", folder / "inverted.npz") == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("error: poses_inverted: ")
    assert call("check", folder / "inverted.npz", "--json") == 1
    said = json.loads(capsys.readouterr().out)
    assert said["findings"][0]["name"] == "poses_inverted"


def test_a_fit_of_bad_scans_is_rejected_unless_forced(folder, tmp_path, capsys):
    out = tmp_path / "map.safetensors"
    said = refusal(capsys, folder, "fit", folder / "inverted.npz", "-o", out, *FAST)
    assert "poses_inverted" in said
    assert "--no-check" in said
    assert call("fit", folder / "inverted.npz", "-o", out, "--no-check", *FAST) == 0
    assert out.exists()
    assert call("fit", folder / "copied.npz", "-o", out, *FAST) == 0
    assert capsys.readouterr().err.startswith("warning: duplicate_scans: ")


@pytest.fixture
def clouds(scans_file, tmp_path):
    """A folder of clouds with poses, and the scans in it."""
    scans = read_scans(scans_file)
    for i, (points, power) in enumerate(zip(scans.points, scans.intensities, strict=True)):
        np.save(tmp_path / f"{i}.npy", np.column_stack([points, power]))
    np.save(tmp_path / "poses.npy", scans.poses)
    return tmp_path, scans


def test_a_folder_is_converted_to_one_file(clouds, tmp_path_factory, capsys):
    path, scans = clouds
    out = tmp_path_factory.mktemp("out") / "scans.npz"
    said = values(capsys, "convert", path, "-o", out)
    assert (said["returns"], said["scans"]) == (9000, 6)
    read = read_scans(out)
    for ours, theirs in ((read.points, scans.points), (read.intensities, scans.intensities)):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(read.poses, scans.poses, atol=1e-12)


def test_a_mesh_is_converted_to_another_format(tmp_path, capsys):
    sphere = trimesh.creation.icosphere(2, 5.0)
    sphere.vertices = sphere.vertices + [900.0, -300.0, 20.0]
    radarsdf.io.write_mesh(tmp_path / "a.ply", sphere)
    for source, out in (("a.ply", "b.glb"), ("b.glb", "c.ply")):
        said = values(capsys, "convert", tmp_path / source, "-o", tmp_path / out)
        assert said["triangles"] == len(sphere.faces)
    read = radarsdf.io.read_mesh(tmp_path / "c.ply")
    np.testing.assert_allclose(read.triangles, sphere.triangles, atol=1e-3, rtol=0)


def test_unsupported_outputs_are_rejected(clouds, scans_file, tmp_path_factory, capsys):
    path, _ = clouds
    out = tmp_path_factory.mktemp("out")
    for words, said in (
        ([path, "-o", out / "cloud.xyz"], ".pcd"),
        ([path, "-o", path / "cloud.npy"], "cloud.npy"),
        ([scans_file, "-o", scans_file], "same file"),
        ([path, "-o", out], str(out)),
        ([path, "-o", out / "absent" / "scans.npz"], "absent"),
        ([out / "absent.npz", "-o", out / "scans.npz"], "absent.npz"),
    ):
        assert said in refusal(capsys, out, "convert", *words)


def test_options_for_scans_are_refused_where_none_are_read(tmp_path, capsys):
    trimesh.creation.box().export(tmp_path / "box.ply")
    for option, value in (("--topic", "/radar"), ("--max-gap", 2), ("--columns", 4)):
        words = ("convert", tmp_path / "box.ply", "-o", tmp_path / "box.stl", option, value)
        assert option in refusal(capsys, tmp_path, *words, status=2)
