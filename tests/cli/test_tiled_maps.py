# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Commands that read a map, on a map in tiles."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.io.npz import read_scans

from .calls import call, refusal, values

QUICK = ["--quick", "--set", "num_threads=1", "--no-check", "--quiet"]
VOXEL = ["--voxel", 0.2]
POSE = ["--pose", 1.3, 0.4, 1.5]


@pytest.fixture(scope="module")
def city(scans_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("tiles") / "city"
    assert call("tiles", "plan", scans_file, "-o", out, "--tile-size", 12.8, "--halo", 6.4, *QUICK) == 0
    assert call("tiles", "fit", out, "--quiet") == 0
    return out


@pytest.fixture(scope="module")
def whole(scans_file, tmp_path_factory):
    """The same scans in one map."""
    path = tmp_path_factory.mktemp("whole") / "map.safetensors"
    assert call("fit", scans_file, "-o", path, *QUICK) == 0
    return path


@pytest.fixture
def broken(city, tmp_path):
    """The same city, and the name of a tile that it has lost."""
    out = tmp_path / "city"
    shutil.copytree(city, out)
    name = max(radarsdf.load(out).plan.tiles, key=lambda tile: tile.returns).name
    (out / "tiles" / name / "map.safetensors").unlink()
    return out, name


def test_info(city, whole, capsys):
    of_tiles, of_one = (values(capsys, "info", path) for path in (city, whole))
    assert of_tiles["map"].startswith("TiledMap(surface and reflectance, ")
    assert of_one["map"].startswith("RadarMap(surface and reflectance, ")
    assert of_tiles["leaf_cells"] == pytest.approx(of_one["leaf_cells"], rel=0.05)
    assert of_tiles["range_m"] == pytest.approx(of_one["range_m"])
    assert of_tiles["intensities"] == pytest.approx(of_one["intensities"])
    assert of_tiles["leaf_size_m"] == of_one["leaf_size_m"] == 0.2
    assert of_tiles["returns"] == of_one["returns"] > 1000
    assert of_tiles["scans"] == of_one["scans"] > 1
    vertices = np.asarray(radarsdf.load(whole).mesh(0.2, min_component_triangles=0).vertices)
    for found in (of_tiles, of_one):
        lower, upper = np.array(found["extent"])
        assert (lower <= vertices.min(axis=0) + 0.01).all()
        assert (upper >= vertices.max(axis=0) - 0.01).all()
    np.testing.assert_allclose(of_tiles["extent"], of_one["extent"], atol=1.0)
    assert call("info", city) == 0
    assert "leaf cells      " in capsys.readouterr().out


def test_mesh(city, tmp_path, capsys):
    ply = tmp_path / "mesh.ply"
    assert call("mesh", city, "-o", ply, *VOXEL, "--viewpoint", 2, 0, 1.5, "--quiet") == 0
    mesh = trimesh.load_mesh(ply, process=False)
    assert f"{len(mesh.faces)} triangles written" in capsys.readouterr().out
    expected = radarsdf.load(city).mesh(0.2, progress=False)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    assert "intensity" in mesh.metadata["_ply_raw"]["vertex"]["properties"]


def test_eval(city, whole, scans_file, capsys):
    words = [scans_file, "--samples", 20000, "--holdout", 3, *VOXEL]
    of_tiles, of_one = (values(capsys, "eval", path, *words) for path in (city, whole))
    assert of_tiles["surface"]["f_score_all"] == pytest.approx(of_one["surface"]["f_score_all"], abs=0.02)
    assert of_tiles["held_out"]["mae"] == pytest.approx(of_one["held_out"]["mae"], rel=0.2)
    assert of_tiles["knn"] == of_one["knn"]
    assert "in_no_tile" not in of_tiles


def test_render(city, whole, tmp_path, capsys):
    counts = []
    for path in (city, whole):
        out = tmp_path / "view.npz"
        capsys.readouterr()
        assert call("render", path, *POSE, "--pose", 1e6, 0, 0, "-o", out) == 0
        (points,) = read_scans(out).points
        assert capsys.readouterr().out.startswith(f"{len(points)} returns of 2 scans written to {out}, 1 of")
        counts.append(len(points))
    assert counts[0] == pytest.approx(counts[1], rel=0.1)
    assert "nothing written" in refusal(
        capsys, tmp_path, "render", city, "--pose", 1e6, 0, 0, "-o", tmp_path / "away.npz"
    )


@pytest.mark.usefixtures("small_pictures")
def test_report(city, scans_file, tmp_path):
    page = tmp_path / "report.html"
    assert call("report", city, scans_file, "-o", page, "--holdout", 3, *VOXEL, "--quiet") == 0
    text = page.read_text("utf-8")
    assert "<title>city</title>" in text
    assert "all 3,000 returns of the 2 scans that the fit left out" in text
    assert "F-score, nothing discarded" in text
    for words in ("Tiles", "Leaf cells", "Noise in range", "the intensity network", "Training"):
        assert words in text
    assert "Missing" not in text


def test_view(city, scans_file):
    pytest.importorskip("viser", reason="the extra view is not installed")
    from radarsdf.view.viewer import Viewer  # noqa: PLC0415 - an extra

    with Viewer(
        radarsdf.load(city), read_scans(scans_file), voxel_size=0.2, port=0, progress=False
    ) as viewer:
        assert len(viewer.surface.vertices) > 1000
        viewer._clouds.show(1)
        assert np.abs(viewer._canvas._local).max() < 100  # float32 is fine enough


@pytest.mark.usefixtures("small_pictures")
def test_a_tile_that_is_missing_is_said(broken, scans_file, tmp_path, capsys):
    out, name = broken
    capsys.readouterr()
    assert call("eval", out, scans_file, "--holdout", 3, "--samples", 20000, *VOXEL) == 0
    printed = capsys.readouterr()
    assert printed.err == f"radarsdf: {out} lacks 1 of 4 tiles: radarsdf tiles status {out} says why\n"
    assert " held-out returns are in no tile\n" in printed.out
    assert values(capsys, "info", out)["missing_tiles"] == [name]
    page = tmp_path / "report.html"
    assert call("report", out, scans_file, "-o", page, *VOXEL, "--quiet") == 0
    assert "more are in no tile" in page.read_text("utf-8")
    assert "Missing tiles" in page.read_text("utf-8")


@pytest.mark.parametrize("command", ["info", "mesh", "eval", "render", "report", "view"])
def test_folders_that_are_no_map(city, tmp_path, capsys, command):
    if command in ("report", "view"):
        pytest.importorskip("viser", reason="the extra view is not installed")
        pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    more = {
        "mesh": ["-o", tmp_path / "x.ply"],
        "eval": [tmp_path],
        "render": [*POSE, "-o", tmp_path / "x.npz"],
        "report": ["-o", tmp_path / "x.html"],
    }.get(command, [])
    nothing, planned = tmp_path / "nothing", tmp_path / "planned"
    for folder in (nothing, planned):
        folder.mkdir()
    shutil.copy(city / "plan.json", planned)
    assert f"{nothing} is no map" in refusal(capsys, tmp_path, command, nothing, *more)
    assert "radarsdf tiles fit" in refusal(capsys, tmp_path, command, planned, *more)


def test_voxels_that_tiles_cannot_have(city, tmp_path, capsys):
    said = refusal(capsys, tmp_path, "mesh", city, "-o", tmp_path / "x.ply", "--voxel", 0.15)
    assert "use 0.1 or 0.2" in said


@pytest.mark.parametrize("command", ["mesh", "view", "render"])
def test_a_tile_that_is_damaged_is_named(city, tmp_path, capsys, command):
    if command == "view":
        pytest.importorskip("viser", reason="the extra view is not installed")
    out = tmp_path / "city"
    shutil.copytree(city, out, ignore=shutil.ignore_patterns("mesh-*"))
    path = max(out.glob("tiles/*/map.safetensors"), key=lambda path: path.stat().st_size)
    data = bytearray(path.read_bytes())
    tenth = len(data) // 10
    data[-tenth:] = b"\xff" * tenth  # its beginning is whole, so it counts as done
    path.write_bytes(data)
    more = {
        "mesh": ["-o", tmp_path / "x.ply"],
        "view": ["--no-open"],
        "render": [*POSE, "-o", tmp_path / "x.npz"],
    }
    capsys.readouterr()
    assert call(command, out, *more[command], *(VOXEL if command != "render" else [])) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"radarsdf {command}: ")
    assert f"{path} is not a whole radarsdf map" in said
    assert said.count("\n") == 1
