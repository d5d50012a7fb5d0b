# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The command line, in process but for one call: what it writes, prints and refuses."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf import FitConfig
from radarsdf.cli import main
from radarsdf.io.scans import Scans, write_scans

FAST = [
    "--set",
    "sdf_iterations=40",
    "--set",
    "intensity_iterations=20",
    "--set",
    "batch_size=1024",
    "--quiet",
]


def files(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


@pytest.fixture(scope="module")
def scans_file(scene, tmp_path_factory):
    truth = np.stack(np.meshgrid(np.arange(9, 19, 0.5), np.arange(-5, 5, 0.5), [0.0]), -1).reshape(-1, 3)
    path = tmp_path_factory.mktemp("scans") / "scans.npz"
    write_scans(path, Scans(scene.points, scene.poses, scene.intensities, truth))
    return path


@pytest.fixture(scope="module")
def map_file(scans_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.safetensors"
    assert main(["fit", str(scans_file), "-o", str(path), "--holdout", "3", *FAST]) == 0
    return path


def fails(capsys, arguments, folder=None):
    """Exit status 1 and one line on standard error, and nothing written; the line."""
    before = files(folder) if folder else None
    assert main([str(a) for a in arguments]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith(f"radarsdf {arguments[0]}: ")
    assert captured.err.count("\n") == 1
    if folder:
        assert files(folder) == before
    return captured.err


def test_demo_writes_everything_and_prints_the_errors(tmp_path, capsys):
    out = tmp_path / "demo"
    settings = ["--set", "min_component_triangles=20", "--set", "sdf_iterations=100"]
    command = ["demo", "--frames", "4", "--out", str(out), *FAST, *settings]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert files(out) == ["map.safetensors", "mesh.ply", "picture.png", "scans.npz"]
    for word in ("accuracy", "completion", "F-score", "held-out intensity error", "kNN      intensity error"):
        assert word in printed.out
    assert printed.err == ""
    radar_map = radarsdf.load(out / "map.safetensors")
    assert radar_map.config.training.sdf_iterations == 100
    mesh = trimesh.load_mesh(out / "mesh.ply", process=False)
    assert len(mesh.faces) > 0
    assert (out / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_fit_mesh_eval_chain(scans_file, map_file, tmp_path, capsys):
    radar_map = radarsdf.load(map_file)
    assert radar_map.has_intensity
    assert radar_map.report["returns"] == 4 * 1500  # scans 0 and 3 of six are held out
    assert (radar_map.config.training.sdf_iterations, radar_map.config.training.batch_size) == (40, 1024)

    ply, png = tmp_path / "mesh.ply", tmp_path / "mesh.png"
    box = ["--box", "9", "-4", "-1", "18", "4", "1"]
    view = ["--viewpoint", "2", "0", "1.5", "--picture", str(png)]
    assert main(["mesh", str(map_file), "-o", str(ply), "--voxel", "0.2", *box, *view, "--quiet"]) == 0
    mesh = trimesh.load_mesh(ply, process=False)
    assert f"{len(mesh.vertices)} vertices and {len(mesh.faces)} triangles" in capsys.readouterr().out
    assert (mesh.bounds[0] >= [8.9, -4.1, -1.1]).all()
    assert (mesh.bounds[1] <= [18.1, 4.1, 1.1]).all()
    assert png.stat().st_size > 1000
    sure = tmp_path / "sure.ply"
    command = ["mesh", str(map_file), "-o", str(sure), "--voxel", "0.2", *box, "--quiet"]
    assert main([*command, "--min-confidence", "0.2"]) == 0
    assert 0 < len(trimesh.load_mesh(sure, process=False).faces) < len(mesh.faces)
    assert main([*command, "--min-confidence", "2"]) == 1
    capsys.readouterr()

    for what in (ply, map_file):
        assert main(["eval", str(what), str(scans_file), "--samples", "20000", *box]) == 0
        printed = capsys.readouterr().out
        assert "F-score" in printed
        assert "intensity" not in printed
    assert main(["eval", str(map_file), str(scans_file), "--samples", "20000", "--holdout", "3"]) == 0
    printed = capsys.readouterr().out
    assert "held-out intensity error" in printed
    assert "kNN      intensity error" in printed


def test_eval_reads_points_of_several_kinds(map_file, tmp_path, capsys):
    points = np.random.default_rng(0).uniform([9, -4, 0], [18, 4, 0.01], (500, 3))
    np.save(tmp_path / "lidar.npy", points)
    np.savetxt(tmp_path / "lidar.xyz", np.column_stack([points, points]))
    np.savetxt(tmp_path / "lidar.csv", points, delimiter=",")
    trimesh.PointCloud(points).export(tmp_path / "lidar.ply")
    ratios = set()
    for name in ("lidar.npy", "lidar.xyz", "lidar.csv", "lidar.ply"):
        assert main(["eval", str(map_file), str(tmp_path / name), "--samples", "20000"]) == 0
        lines = capsys.readouterr().out.splitlines()
        ratios.add(next(line for line in lines if line.startswith("completion")))
    assert len(ratios) == 1


def test_geometry_only(scans_file, tmp_path, capsys):
    path = tmp_path / "map.safetensors"
    assert main(["fit", str(scans_file), "-o", str(path), "--geometry-only", *FAST]) == 0
    assert not radarsdf.load(path).has_intensity
    command = ["mesh", path, "-o", tmp_path / "mesh.ply", "--viewpoint", "0", "0", "0"]
    assert "viewpoint" in fails(capsys, command, tmp_path)


def test_quick(scans_file, tmp_path):
    path = tmp_path / "map.safetensors"
    command = ["fit", str(scans_file), "-o", str(path), "--quick", "--geometry-only"]
    assert main([*command, "--set", "seed=3"]) == 0
    assert radarsdf.load(path).config == FitConfig.quick(seed=3)
    with pytest.raises(SystemExit):
        main([*command, "--paper"])


def test_settings(scans_file, tmp_path):
    path = tmp_path / "map.safetensors"
    settings = [
        "encoding=octree",
        "sdf_hidden=(8, 8)",
        "sigma_m=0.15",
        "normals=True",
        "max_range_m=None",
        "seed=5",
    ]
    flags = [word for setting in settings for word in ("--set", setting)]
    assert main(["fit", str(scans_file), "-o", str(path), "--paper", *FAST, *flags]) == 0
    expected = FitConfig.paper(seed=5, training={"sdf_iterations": 40, "intensity_iterations": 20, "batch_size": 1024, "sigma_cells": 0.15}, encoding={"kind": "octree"}, networks={"sdf_hidden": (8, 8), "normals": True}, returns={"max_range_m": None})  # fmt: skip
    assert radarsdf.load(path).config == expected


@pytest.mark.parametrize(
    "setting",
    [
        "sigma_m",
        "colour=1",
        "sigma_m=-1",
        "sigma_m=wide",
        "sigma_m=1e999",
        "sigma_m=None",
        "encoding=tree",
        "encoding=3",
        "sdf_iterations=1.5",
        "sdf_iterations=many",
        "batch_size=[1]",
        "sdf_hidden=3",
        "sdf_hidden=(8, 0.5)",
        "sdf_hidden=wide",
        "normals=perhaps",
        "num_levels=2.5",
        "seed=-1.5",
        "=3",
    ],
)
def test_settings_that_make_no_sense(scans_file, tmp_path, capsys, setting):
    command = ["fit", scans_file, "-o", tmp_path / "map.safetensors", "--set", setting, "--quiet"]
    fails(capsys, [*command, "--set", "intensity_iterations=1"], tmp_path)


def test_a_fit_that_diverges_is_one_line(scans_file, tmp_path, capsys):
    command = ["fit", scans_file, "-o", tmp_path / "map.safetensors", *FAST, "--set", "learning_rate=1e30"]
    assert "learning rate" in fails(capsys, command, tmp_path)


def test_files_that_cannot_be_used(scans_file, map_file, tmp_path, capsys):
    garbage = {}
    for suffix in (".npz", ".ply", ".safetensors", ".npy", ".xyz"):
        garbage[suffix] = tmp_path / f"garbage{suffix}"
        garbage[suffix].write_bytes(b"\x93 this is nothing of the kind \x00\xff")
    out, ply = tmp_path / "map.safetensors", tmp_path / "mesh.ply"
    absent = tmp_path / "absent"
    for command in (
        ["fit", absent / "scans.npz", "-o", out],
        ["fit", garbage[".npz"], "-o", out],
        ["fit", garbage[".ply"], "-o", out],
        ["fit", scans_file, "-o", absent / "map.safetensors", *FAST],
        ["mesh", absent / "map.safetensors", "-o", ply],
        ["mesh", garbage[".safetensors"], "-o", ply],
        ["mesh", scans_file, "-o", ply],
        ["mesh", map_file, "-o", ply, "--voxel", "0"],
        ["mesh", map_file, "-o", ply, "--box", "1", "1", "1", "0", "0", "0"],
        ["mesh", map_file, "-o", tmp_path / "mesh.txt", "--quiet"],
        ["mesh", map_file, "-o", tmp_path / "mesh", "--quiet"],
        ["mesh", map_file, "-o", absent / "mesh.ply", "--quiet"],
        ["eval", absent / "mesh.ply", scans_file],
        ["eval", garbage[".ply"], scans_file],
        ["eval", map_file, garbage[".npz"]],
        ["eval", map_file, garbage[".npy"]],
        ["eval", map_file, garbage[".xyz"]],
        ["eval", map_file, garbage[".ply"]],
        ["eval", map_file, absent / "lidar.ply"],
        ["eval", garbage[".ply"], scans_file, "--holdout", "3"],
        ["demo", "--frames", "1", "--out", tmp_path / "demo"],
        ["demo", "--frames", "0", "--out", tmp_path / "demo"],
    ):
        fails(capsys, command, tmp_path)


def test_a_mesh_without_triangles(map_file, tmp_path, capsys):
    far = ["--box", "900", "900", "900", "901", "901", "901"]
    for viewpoint in ([], ["--viewpoint", "0", "0", "1"]):
        command = ["mesh", map_file, "-o", tmp_path / "mesh.ply", "--quiet", *far, *viewpoint]
        assert "no surface here" in fails(capsys, command, tmp_path)


@pytest.mark.parametrize("arguments", [[], ["paint"], ["fit"], ["mesh", "map", "--box", "1"]])
def test_wrong_usage_is_status_two(arguments, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert "usage: radarsdf" in capsys.readouterr().err


def test_info_as_a_process():
    package = str(Path(radarsdf.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([package, os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(
        [sys.executable, "-m", "radarsdf", "info"],
        capture_output=True, text=True, env=environment, timeout=60, check=True,
    )  # fmt: skip
    names = ["radarsdf", "python", "torch", "compiler", "openmp", "instruction set"]
    for name, line in zip(names, done.stdout.splitlines(), strict=True):
        assert line.startswith(name)
        assert len(line) > 17
    assert radarsdf._core.__version__ in done.stdout
    assert done.stderr == ""
