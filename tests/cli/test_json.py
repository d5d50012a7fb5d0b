# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""With --json a command prints one object: the numbers that it prints for people, and nothing else."""

from __future__ import annotations

import argparse
import json
import re

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.doppler import velocity_of_poses
from radarsdf.cli import COMMANDS, whole_parser
from radarsdf.cli.results import Results
from radarsdf.io.npz import write_scans
from radarsdf.io.scans import Scans

from .calls import FAST, call, refusal, values


def test_every_command_that_prints_results_has_it_with_one_meaning():
    commands = next(a for a in whole_parser()._actions if isinstance(a.choices, dict)).choices
    helps = {
        name: next((a.help for a in command._actions if "--json" in a.option_strings), None)
        for name, command in commands.items()
    }
    assert set(helps) == set(COMMANDS)
    assert {name for name, text in helps.items() if text is None} == {"config", "completion", "view"}
    assert len({text for text in helps.values() if text}) == 1


def test_a_fit_says_the_same_to_people_and_to_programs(tmp_path, capsys):
    scans = radarsdf.simulate.wall(frames=6)
    rng = np.random.default_rng(0)
    doppler = []
    for points, velocity in zip(
        scans.points, velocity_of_poses(scans.poses, 0.1 * np.arange(6)), strict=True
    ):
        away = points / np.linalg.norm(points, axis=1, keepdims=True)
        doppler.append(-away @ velocity + 3.0 * (rng.random(len(points)) < 0.1))
    write_scans(
        tmp_path / "scans.npz", Scans(scans.points, scans.poses, scans.intensities, doppler_mps=doppler)
    )
    words = ["fit", tmp_path / "scans.npz", "-o", tmp_path / "map.safetensors", *FAST]
    assert call(*words) == 0
    printed = capsys.readouterr().out
    found = values(capsys, *words)
    used, returns, scans_used = map(int, re.match(r"(\d+) of (\d+) returns in (\d+) scans", printed).groups())
    assert (used, returns, scans_used) == (found["returns_used"], found["returns"], found["scans"])
    assert f"{found['movers']} move by their Doppler" in printed
    assert 0.08 * returns < found["movers"] < 0.12 * returns
    noise = found["noise"]
    assert f"noise {noise['range_m']:.3f} m, azimuth {noise['azimuth_rad']:.4f} rad" in printed
    assert f"sdf loss {found['losses']['sdf']:.3g}" in printed
    assert found["out"] == str(tmp_path / "map.safetensors")
    kept = values(capsys, *words, "--set", "returns.drop_movers=false")
    assert kept["movers"] == 0
    dry = values(capsys, "fit", tmp_path / "scans.npz", "--dry-run")
    assert dry["returns"] < found["returns"]  # only those within the ranges
    assert dry["peak_memory_bytes"] > 0


def test_a_mesh_and_its_errors(map_file, scans_file, tmp_path, capsys):
    mesh = values(capsys, "mesh", map_file, "-o", tmp_path / "mesh.ply", "--voxel", 0.2)
    assert (mesh["out"], mesh["origin"]) == (str(tmp_path / "mesh.ply"), None)
    assert len(radarsdf.io.read_mesh(tmp_path / "mesh.ply").faces) == mesh["triangles"]
    words = ["eval", map_file, scans_file, "--samples", 20000, "--holdout", 3]
    errors = values(capsys, *words)
    assert call(*words) == 0
    printed = capsys.readouterr().out
    assert f"F-score     {100 * errors['surface']['f_score']:.2f} %" in printed
    assert f"held-out intensity error  mean {errors['held_out']['mae']:.2f}" in printed
    assert f", {errors['knn']['neighbours']} of {errors['knn']['candidates']} neighbours" in printed


def test_info(capsys):
    found = values(capsys, "info")
    assert set(found) == {"radarsdf", "python", "torch", "compiler", "openmp", "instruction_set"}


def test_an_error_prints_nothing_on_standard_output(tmp_path, capsys):
    refusal(capsys, tmp_path, "mesh", tmp_path / "absent.safetensors", "-o", tmp_path / "mesh.ply", "--json")
    assert capsys.readouterr().out == ""


def test_what_json_lacks(capsys):
    results = Results(argparse.Namespace(json=True))
    results.add(
        "a line for people", number=np.float32(0.5), row=np.arange(2), none=float("nan"), deep=[np.inf]
    )
    assert capsys.readouterr().out == ""
    results.end()
    assert json.loads(capsys.readouterr().out) == {
        "number": 0.5,
        "row": [0, 1],
        "none": None,
        "deep": [None],
    }


@pytest.mark.parametrize("value", [np.int64(3), True, "word"])
def test_plain_values_stay(capsys, value):
    results = Results(argparse.Namespace(json=True))
    results.add(value=value)
    results.end()
    assert json.loads(capsys.readouterr().out) == {"value": value}
