# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Each experiment of the paper gives its table, its numbers and its plot; what has no result says why."""

from __future__ import annotations

import functools
import inspect
import json

import numpy as np
import pytest
import trimesh
from radarsdf import FitConfig, RadarMap
from radarsdf.render.picture import save_picture

from bench.paper import __main__ as command
from bench.paper.curve import _LEVERS, budget, medians
from bench.paper.experiment import Options, mean_and_deviation, world_returns
from bench.paper.report import best_in_bold, markdown, write_json
from bench.paper.scenes import load_scene
from bench.peers.interface import Reconstruction

SPHERE_M = 1.0


@pytest.fixture
def peers(monkeypatch):
    """A peer that answers at once with a surface of its own, and one that cannot."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=SPHERE_M)

    def reconstruct(peer, points, poses, *_args, **_ranges):
        assert len(points) == len(poses)
        if peer.name == "Poisson":
            return Reconstruction(None, "Open3D is not here")
        return Reconstruction(
            mesh, "", seconds=1.0 + len(points), peak_bytes=10**8, map_bytes=1000 * len(points)
        )

    monkeypatch.setattr("bench.paper.experiment.reconstruct", reconstruct)


def run(tmp_path, *words):
    command.main([*words, "--quick", "--out", str(tmp_path)])
    stem = tmp_path / words[0]
    assert stem.with_suffix(".png").stat().st_size > 1000
    return stem.with_suffix(".md").read_text(encoding="utf-8"), json.loads(
        stem.with_suffix(".json").read_text()
    )


@pytest.mark.usefixtures("peers")
def test_surface(tmp_path, monkeypatch):
    small = functools.partial(save_picture, width=160, height=100)
    monkeypatch.setattr("bench.paper.experiment.save_picture", small)
    table, values = run(tmp_path, "surface", "wall", "--peers", "BPA", "Poisson", "--meshes")
    assert sorted(path.name for path in (tmp_path / "meshes").iterdir()) == [
        "wall, 4 frames, BPA.ply",
        "wall, 4 frames, BPA.png",
    ]
    ball, poisson = values["rows"]
    assert ball["seconds"] == 5.0
    assert 0 <= ball["f_score"] <= 1
    assert ball["samples"] == 100_000
    assert poisson["why_not"] == "Open3D is not here"
    assert "- Poisson is missing: Open3D is not here" in table
    assert "radarsdf-surface-1" in table
    for key in ("command", "commit", "processor", "threads"):
        assert values[key], key


@pytest.mark.usefixtures("peers")
def test_angles_are_those_of_the_sphere(tmp_path):
    _, values = run(tmp_path, "angles", "wall", "--peers", "BPA", "Poisson")
    ball = values["rows"][0]
    assert sum(ball["histogram"]) == pytest.approx(1, abs=1e-4)
    # 320 faces round a sphere: neighbours differ by some 0.17 rad everywhere.
    assert ball["gamma_mean"] == pytest.approx(0.17, abs=0.03)
    assert ball["below_5_degrees"] == 0


@pytest.mark.usefixtures("peers")
def test_sparse_gives_every_nth_frame(tmp_path):
    table, values = run(tmp_path, "sparse", "wall", "--peers", "BPA", "Poisson", "--samples", "1000")
    assert [row["n"] for row in values["rows"]] == [1, 1, 2, 2]
    assert [row["seconds"] for row in values["rows"] if row["method"] == "BPA"] == [5.0, 3.0]
    assert "Poisson: Open3D is not here" in table


@pytest.mark.usefixtures("peers")
def test_map_size_of_the_octree_is_the_reference(tmp_path):
    table, values = run(tmp_path, "map-size", "wall", "--frames", "10")
    sizes = {(row["method"], row["frames"]): row for row in values["rows"]}
    assert {frames for _, frames in sizes} == {1, 2, 4, 5, 10}
    for frames in (1, 10):
        assert sizes["3QFPI", frames]["bytes"] < sizes["SHINE (octree)", frames]["bytes"]
    assert (
        sizes["radarsdf", 1]["bytes"] < sizes["radarsdf", 10]["bytes"] < sizes["radarsdf", 10]["file_bytes"]
    )
    assert sizes["VDBFusion", 10]["bytes"] == 10_000
    assert "100 %" in table


@pytest.mark.usefixtures("peers")
def test_curve_has_budgets_levers_and_peers(tmp_path):
    words = ("curve", "wall", "--peers", "BPA", "Poisson", "radarsdf", "--repetitions", "3")
    table, values = run(
        tmp_path, *words, "--samples", "1000", "--set", "encoding.kind=octree", "encoding.num_levels=2"
    )
    rows = values["rows"]
    assert [row["repetition"] for row in rows] == sorted([0, 1, 2] * (len(rows) // 3))  # the methods by turns
    methods = {row["method"]: row for row in rows}
    assert methods["radarsdf, intensities, × 1/16"]["settings"]["changes"] == {"effort": 1 / 16}
    assert methods["returns.drop_ghosts=False"]["settings"]["changes"] == {"returns": {"drop_ghosts": False}}
    octree = methods["encoding.kind=octree, encoding.num_levels=2"]
    assert octree["kind"] == "lever"
    assert octree["settings"]["changes"] == {"encoding": {"kind": "octree", "num_levels": 2}}
    assert methods["BPA"]["kind"] == "peer"
    assert "radarsdf" not in methods  # a line, not a peer
    assert methods["BPA"]["seconds"] == 4.0  # of the frames that are not held out
    assert "medians of 3" in table
    assert "- Poisson: Open3D is not here" in table


@pytest.mark.parametrize("lever", _LEVERS, ids=str)
def test_each_lever_is_the_other_way_round_than_the_default(lever):
    settings = {name: value for name, value in lever.items() if name != "mesh"}
    assert (FitConfig().override(**settings) != FitConfig()) == bool(settings)
    assert set(lever.get("mesh", {})) <= set(inspect.signature(RadarMap.mesh).parameters)


def test_a_budget_of_one_is_the_default():
    assert FitConfig(**budget(1.0)) == FitConfig()


def test_medians_are_of_the_rows_that_have_the_number():
    rows = [{"method": "a", "seconds": s, "mae": m} for s, m in ((1.0, None), (2.0, 3.0), (9.0, 4.0))]
    assert medians(rows) == [{"method": "a", "seconds": 2.0, "mae": 3.5, "why_not": ""}]


def test_intensity_repeats_with_other_seeds(tmp_path):
    table, values = run(tmp_path, "intensity", "wall", "--base", "default")
    neighbours, *ours = values["rows"]
    assert neighbours["method"] == "kNN"
    assert neighbours["noise_floor"] > 1
    assert [row["seed"] for row in ours] == [0, 1]
    assert ours[0]["mae"] != ours[1]["mae"]
    assert " ± " in table


def test_ablation_has_all_variants(tmp_path, monkeypatch):
    few = {"sdf_iterations": 5, "intensity_iterations": 5}  # enough to differ
    monkeypatch.setattr("bench.paper.experiment._SHORT", {"training": few})
    table, values = run(tmp_path, "ablation", "wall", "--repetitions", "1")
    variants = [row["variant"] for row in values["rows"]]
    assert variants == ["full", "w/o SDF", "w/o SDF normals", "w/o geometry feature", "w/o viewing direction"]
    assert len({row["mae"] for row in values["rows"]}) == len(variants)  # each really changes the fit
    assert "3QFPI" not in table
    assert "paper" in table


def test_views_know_the_reflector(tmp_path):
    table, values = run(tmp_path, "views", "wall", "--base", "default", "--frames", "20")
    row = values["rows"][0]
    at = np.asarray(row["distance_m"]) < 0.6
    assert at.any()
    assert not at.all()
    # The reflector answers more strongly than the wall.
    assert np.max(np.asarray(row["measured"])[at]) > np.median(np.asarray(row["measured"])[~at]) + 10
    assert np.abs(np.asarray(row["x"])[at]).max() < 0.6
    assert np.ptp(row["angle_deg"]) > 60  # the path goes round it
    assert "at the reflector" in table


@pytest.mark.usefixtures("peers")
def test_a_scene_without_intensities_or_truth_stays_in_the_tables(tmp_path):
    scans = load_scene("wall", frames=4)
    points = np.concatenate(scans.points)
    frame = np.repeat(np.arange(4), [len(p) for p in scans.points])
    path = tmp_path / "bare.npz"
    np.savez(path, points=points, frame=frame, poses=scans.poses)
    for experiment in ("intensity", "ablation", "views"):
        assert "no intensities" in run(tmp_path, experiment, str(path))[0]
    for experiment in ("surface", "sparse"):
        assert "no ground truth" in run(tmp_path, experiment, str(path), "--peers", "BPA")[0]


def test_returns_in_the_world_are_those_in_range():
    scene = load_scene("wall", frames=3)
    x, sensors, intensities = world_returns(scene)
    ranges_m = np.concatenate([np.linalg.norm(p, axis=1) for p in scene.points])
    kept = ranges_m >= scene.min_range_m
    np.testing.assert_allclose(np.linalg.norm(x - sensors, axis=1), ranges_m[kept], atol=1e-4)
    np.testing.assert_array_equal(intensities, np.concatenate(scene.intensities)[kept])


def test_unknown_peers_and_scenes_are_refused(tmp_path):
    with pytest.raises(SystemExit):
        command.main(["surface", "wall", "--peers", "nonsense", "--out", str(tmp_path)])
    with pytest.raises(SystemExit):
        command.main(["curve", "wall", "--set", "nonsense=1", "--out", str(tmp_path)])
    with pytest.raises(SystemExit):
        command.main(["curve", "wall", "--set", "mesh.nonsense=1", "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="no scene 'nowhere'"):
        command.main(["surface", "nowhere", "--out", str(tmp_path)])


def test_best_is_bold_and_equals_with_it():
    assert best_in_bold(["1.0", "–", "1.0", "2.0"], [1.01, None, 1.04, 2.0], highest=False) == [
        "**1.0**", "–", "**1.0**", "2.0"
    ]  # fmt: skip
    assert best_in_bold(["1", "2"], [1, 2], highest=True) == ["1", "**2**"]


def test_mean_and_deviation():
    assert mean_and_deviation([{"mae": 1.0}, {"mae": 3.0}], "mae") == "2.00 ± 1.41"
    assert mean_and_deviation([{"mae": 1.0}], "mae") == "1.00"
    assert mean_and_deviation([{}], "mae") == "–"


def test_markdown_is_aligned():
    assert markdown(["a", "long"], [["xyz", "1"]]).splitlines() == [
        "| a   | long |",
        "|-----|------|",
        "| xyz | 1    |",
    ]


def test_json_has_no_infinity(tmp_path):
    write_json(tmp_path / "x.json", {"a": np.array([1.0, np.nan]), "b": np.float32(0.1), "c": np.int64(3)})
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": [1.0, None], "b": 0.1, "c": 3}


def test_options_keep_the_ranges_of_the_scene():
    options = Options(quick=False, repetitions=1, samples=1, bases=("paper",), peers=())
    scene = load_scene("oculii", frames=2)
    config = options.config("paper", scene, networks={"normals": False})
    assert (config.returns.min_range_m, config.training.sdf_iterations, config.networks.normals) == (
        1.0,
        1000,
        False,
    )
