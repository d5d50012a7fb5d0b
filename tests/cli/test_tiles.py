# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf tiles`."""

from __future__ import annotations

import shutil

import pytest
import radarsdf
import trimesh
from radarsdf.tiles import tasks

from .calls import call, refusal, values

FIT = ["--quick", "--set", "num_threads=1", "--geometry-only", "--quiet"]
PLAN = ["--tile-size", 12.8, "--halo", 6.4, "--no-check", *FIT]


@pytest.fixture(scope="module")
def city(scans_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("tiles") / "city"
    assert call("tiles", scans_file, "-o", out, "--voxel", 0.2, *PLAN) == 0
    return out


def test_all_steps(city):
    mesh = trimesh.load_mesh(city / "mesh.ply", process=False)
    assert len(mesh.faces) > 1000
    assert radarsdf.load(city).missing == {}


def test_step_by_step_gives_the_same_mesh(city, scans_file, tmp_path, capsys):
    out, ply = tmp_path / "city", tmp_path / "mesh.ply"
    said = values(capsys, "tiles", "plan", scans_file, "-o", out, *PLAN)
    assert said["tiles"] > 2
    assert said["tile_m"] == 12.8
    assert call("tiles", "status", out) == 1  # nothing is done
    names = sorted(path.name for path in (out / "tiles").iterdir())
    assert call("tiles", "fit", out, "--tile", names[0], "--quiet") == 0
    capsys.readouterr()
    assert call("tiles", "status", out) == 1
    printed = capsys.readouterr()
    assert printed.out == f"1 of {len(names)} tiles are done\n"
    assert printed.err.count("not yet done") == len(names) - 1
    assert call("tiles", "fit", out, "--quiet") == 0
    assert call("tiles", "mesh", out, "-o", ply, "--voxel", 0.2, "--quiet") == 0
    assert ply.read_bytes() == (city / "mesh.ply").read_bytes()
    assert values(capsys, "tiles", "status", out)["missing"] == {}


def test_a_clean_folder(city, tmp_path, capsys):
    out, ply = tmp_path / "city", tmp_path / "mesh.ply"
    shutil.copytree(city, out)
    freed = values(capsys, "tiles", "clean", out)["bytes"]
    assert freed > 20 * 9000  # at least a ray for each return
    assert not list(out.glob("tiles/*/rays.bin"))
    assert values(capsys, "tiles", "status", out)["missing"] == {}
    assert call("tiles", "fit", out, "--quiet") == 0
    assert call("tiles", "mesh", out, "-o", ply, "--voxel", 0.2, "--quiet") == 0
    assert ply.read_bytes() == (city / "mesh.ply").read_bytes()


def test_a_tile_that_failed_is_named(city, tmp_path, capsys):
    out = tmp_path / "city"
    shutil.copytree(city, out)
    name = max((out / "tiles").iterdir()).name
    (out / "tiles" / name / "map.safetensors").unlink()
    (out / "tiles" / name / "rays.bin").write_bytes(b"")
    capsys.readouterr()
    assert call("tiles", "fit", out, "--quiet") == 1
    said = capsys.readouterr().err
    assert said.startswith(f"radarsdf tiles: {name}: ")
    assert "rays instead of" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["status", "nowhere"], "no such file or folder"),
        (["mesh", "nowhere"], "there is no folder"),
        (["clean", "nowhere"], "no such file or folder"),
        (["nowhere.npz", "-o", "city"], "does not exist"),
    ],
)
def test_wrong_words(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    assert said in refusal(capsys, tmp_path, "tiles", *words)


def test_a_tile_that_is_not_in_the_plan(city, capsys, tmp_path):
    assert "has no tile 99_99" in refusal(capsys, tmp_path, "tiles", "fit", city, "--tile", "99_99")


def test_no_cluster(city, capsys, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(tasks, "_CONNECT_S", 0.5)
    words = ["tiles", "fit", city, "--cluster", "tcp://127.0.0.1:9"]
    assert "127.0.0.1:9" in refusal(capsys, tmp_path, *words)
