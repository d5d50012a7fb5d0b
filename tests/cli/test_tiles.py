"""``radarsdf tiles``, and the other commands given its folder as a map."""

import shutil

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.io.npz import read_scans

from .calls import QUICK, call, refusal, values

PLAN = ["--tile-size", 12.8, "--halo", 6.4, "--set", "num_threads=1", *QUICK]
VOXEL = ["--voxel", 0.2]
POSE = ["--pose", 1.3, 0.4, 1.5]


@pytest.fixture(scope="module")
def city(scans_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("tiles") / "city"
    assert call("tiles", scans_file, "-o", out, *VOXEL, *PLAN) == 0
    return out


@pytest.fixture
def copied(city, tmp_path):
    """A copy of the city, without its mesh."""
    out = tmp_path / "city"
    shutil.copytree(city, out, ignore=shutil.ignore_patterns("mesh*"))
    return out


def test_separate_steps_give_the_same_mesh(city, scans_file, tmp_path, capsys):
    out, ply = tmp_path / "city", tmp_path / "mesh.ply"
    said = values(capsys, "tiles", "plan", scans_file, "-o", out, *PLAN)
    assert said["tiles"] > 2
    assert said["tile_m"] == 12.8
    names = sorted(path.name for path in (out / "tiles").iterdir())
    assert call("tiles", "fit", out, "--tile", names[0], "--quiet") == 0
    capsys.readouterr()
    assert call("tiles", "status", out) == 1
    printed = capsys.readouterr()
    assert printed.out == f"1 of {len(names)} tiles are done\n"
    assert printed.err.count("not yet done") == len(names) - 1
    assert call("tiles", "fit", out, "--quiet") == 0
    assert call("tiles", "mesh", out, "-o", ply, *VOXEL, "--quiet") == 0
    assert ply.read_bytes() == (city / "mesh.ply").read_bytes()
    assert values(capsys, "tiles", "status", out)["missing"] == {}


@pytest.mark.usefixtures("small_pictures")
def test_a_tile_that_failed_is_named_by_every_command(copied, scans_file, tmp_path, capsys):
    name = max(radarsdf.load(copied).plan.tiles, key=lambda tile: tile.returns).name
    (copied / "tiles" / name / "map.safetensors").unlink()
    (copied / "tiles" / name / "rays.bin").write_bytes(b"")
    capsys.readouterr()
    assert call("tiles", "fit", copied, "--quiet") == 1
    assert capsys.readouterr().err.startswith(f"error: {name}: ")
    assert values(capsys, "info", copied)["missing_tiles"] == [name]
    page = tmp_path / "report.html"
    assert call("report", copied, scans_file, "-o", page, *VOXEL, "--quiet") == 0
    assert capsys.readouterr().err.startswith(f"warning: {copied} lacks 1 of 4 tiles")
    assert call("eval", copied, scans_file, "--holdout", 3, "--samples", 20000, *VOXEL) == 0
    assert " held-out returns are skipped: outliers, or in no tile" in capsys.readouterr().out


def test_the_city_is_a_map(city, scans_file, tmp_path, capsys):
    assert values(capsys, "info", city)["scans"] == 6
    ply = tmp_path / "mesh.ply"
    assert call("mesh", city, "-o", ply, *VOXEL, "--viewpoint", 2, 0, 1.5, "--quiet") == 0
    expected = radarsdf.load(city).mesh(0.2, progress=False)
    np.testing.assert_array_equal(trimesh.load_mesh(ply, process=False).faces, expected.faces)
    found = values(capsys, "eval", city, scans_file, "--samples", 20000, "--holdout", 3, *VOXEL)
    assert found["surface"]["f_score_all"] > 0.3
    assert found["held_out"]["mae"] < found["knn"]["mae"] + 1
    out = tmp_path / "view.npz"
    assert call("render", city, *POSE, "--pose", 1e6, 0, 0, "-o", out) == 0
    assert len(read_scans(out).points) == 1


def test_invalid_folders_and_arguments_are_rejected(city, tmp_path, capsys):
    nothing, planned, ply = tmp_path / "nothing", tmp_path / "planned", tmp_path / "x.ply"
    for folder in (nothing, planned):
        folder.mkdir()
    shutil.copy(city / "plan.json", planned)
    for words, named in (
        (["info", nothing], f"{nothing} is not a map"),
        (["mesh", planned, "-o", ply], "radarsdf tiles fit"),
        (["mesh", city, "-o", ply, "--voxel", 0.15], "0.1 or 0.2"),
        (["tiles", "status", tmp_path / "nowhere"], "nowhere"),
        (["tiles", "mesh", tmp_path / "nowhere"], "nowhere"),
        (["tiles", "fit", city, "--tile", "99_99"], "99_99"),
        (["tiles", tmp_path / "nowhere.npz", "-o", tmp_path / "new"], "nowhere.npz"),
    ):
        assert named in refusal(capsys, tmp_path, *words)
