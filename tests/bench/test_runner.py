"""The runner writes rows and tables of each experiment, with the reason for missing results."""

import json
from functools import partial

import numpy as np
import pytest
import trimesh
from radarsdf import FitConfig
from radarsdf.render.picture import save_picture

from bench import runner
from bench.paper.__main__ import EXPERIMENTS
from bench.peers.interface import Reconstruction
from bench.rigs import EXPERIMENTS as RIGS
from bench.runner import Column, Experiment
from scenes.scene import load_scene
from scenes.settings import parsed, words_of


@pytest.fixture
def peers(monkeypatch):
    """A peer that immediately returns its own surface, and one that fails."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)

    def reconstruct(peer, points, poses, *_args, **_ranges):
        assert len(points) == len(poses)
        if peer.name == "Poisson":
            return Reconstruction(None, "Open3D is not here")
        return Reconstruction(mesh, "", 1.0 + len(points), peak_bytes=10**8, map_bytes=1000 * len(points))

    monkeypatch.setattr("bench.paper.surface.reconstruct", reconstruct)
    monkeypatch.setattr("bench.paper.surface.save_picture", partial(save_picture, width=160, height=100))


def run(tmp_path, *words):
    runner.main("bench.paper", EXPERIMENTS, [*words, "--quick", "--out", str(tmp_path)])
    stem = tmp_path / f"paper-{words[0]}"
    table = stem.with_suffix(".md").read_text(encoding="utf-8")
    return table, json.loads(stem.with_suffix(".json").read_text())


def shown(rows, **layout):
    experiment = Experiment("", lambda _: rows, **layout)
    return [" ".join(line.split()) for line in runner.tables(experiment, rows).splitlines()]


SCORES = [
    {"kind": k, "method": m, "f": f}
    for k, m, f in (("a", "x", 0.5), ("a", "y", 0.7), ("b", "x", 0.7), ("b", "y", 0.6))
]
F = {"f": Column("F, %", 100, 1, "highest"), "absent": Column("absent")}


def test_repetitions_have_a_mean_and_a_standard_deviation():
    assert shown(SCORES, columns=F)[2:] == ["| x | 60.0 ± 14.1 |", "| y | **65.0 ± 7.1** |"]
    assert shown(SCORES, columns=F, median=True)[2] == "| x | 60.0 |"


def test_compared_values_mark_the_best_per_row_and_average_complete_rows():
    rows = [
        *SCORES,
        {"kind": "c", "method": "x", "f": 0.1},
        {"kind": "c", "method": "y", "why_not": "it crashed"},
    ]
    lines = shown(rows, columns=F, lines=("kind",), across="method", mean_line=True)
    assert lines[0] == "| kind | F, %, x | F, %, y |"
    assert lines[2:6] == [
        "| a | 50.0 | **70.0** |",
        "| b | **70.0** | 60.0 |",
        "| c | **10.0** | – |",
        "| mean | 60.0 | **65.0** |",
    ]
    assert lines[-1] == "- c: it crashed"


def test_without_columns_the_keys_are_the_headings():
    assert shown([{"scans": 3, "p50, ms": 1.5}])[0::2] == ["| scans | p50, ms |", "| 3 | 1.5 |"]


def test_json_has_no_infinity(tmp_path):
    runner.write_json(
        tmp_path / "x.json", {"a": np.array([1.0, np.nan]), "b": np.float32(0.1), "c": np.int64(3)}
    )
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": [1.0, None], "b": 0.1, "c": 3}


def test_settings_are_parsed_from_words():
    changes = parsed(["networks.normals=True", "encoding.kind=octree", "mesh.voxel_size=0.2", "seed=3"])
    assert changes == {
        "networks": {"normals": True},
        "encoding": {"kind": "octree"},
        "mesh": {"voxel_size": 0.2},
        "seed": 3,
    }
    assert words_of(changes) == "networks.normals=True, encoding.kind=octree, mesh.voxel_size=0.2, seed=3"
    with pytest.raises(ValueError, match="nonsense"):
        parsed(["nonsense=1"])
    assert FitConfig().override(effort=1.0) == FitConfig()


@pytest.mark.usefixtures("peers")
def test_surface(tmp_path):
    meshes = tmp_path / "meshes"
    table, values = run(
        tmp_path, "surface", "wall", "--peers", "BPA", "Poisson", "--samples", "3000", "--meshes", str(meshes)
    )
    assert sorted(path.name for path in meshes.iterdir()) == [
        "wall, 4 scans, BPA.ply",
        "wall, 4 scans, BPA.png",
    ]
    ball, poisson = values["rows"]
    assert ball["seconds"] == 5.0
    assert 0 <= ball["f_score"] <= 1
    assert 0 <= ball["f_score_without_holes"] <= 1
    assert ball["num_mesh_samples"] == 3_000
    assert poisson["why_not"] == "Open3D is not here"
    assert "- Poisson: Open3D is not here" in table
    for key in ("command", "commit", "processor", "threads"):
        assert values[key], key


@pytest.mark.usefixtures("peers")
def test_map_size_of_the_octree_is_the_reference(tmp_path):
    table, values = run(tmp_path, "map-size", "wall", "--frames", "4")
    sizes = {(row["method"], row["scans"]): row["bytes"] for row in values["rows"]}
    assert sizes["3QFPI", "4 scans"] < sizes["SHINE (octree)", "4 scans"]
    assert sizes["radarsdf", "1 scans"] < sizes["radarsdf", "4 scans"]
    assert sizes["VDBFusion", "4 scans"] == 4_000
    assert "of the octree, %, 4 scans" in table


@pytest.mark.usefixtures("peers")
def test_kinds_have_scores_and_a_calibration(tmp_path):
    table, values = run(tmp_path, "kinds", "wall", "--peers", "BPA", "Poisson", "--samples", "3000")
    assert "- wall: Open3D is not here" in table
    judged = [row for row in values["rows"] if "auc" in row]
    assert [row["method"] for row in judged] == ["radarsdf", "radarsdf, quick"]
    assert all(0 < row["true_share"] < 1 and row["auc"] > 0.5 for row in judged)


def test_calibration_has_all_parts(tmp_path):
    table, values = run(tmp_path, "calibration", "wall", "--samples", "3000", "--set", "mesh.voxel_size=0.2")
    assert {row["variant"] for row in values["rows"]} == {"defaults", "mesh.voxel_size=0.2"}
    for heading in ("by uncertainty", "by range, m", "by scans", "by confidence", "ENCE", "30 or more"):
        assert heading in table, heading


def test_intensity_ablation_views_and_poses(tmp_path, monkeypatch):
    # Enough to differ.
    few = {"training": {"sdf_iterations": 3, "intensity_iterations": 3, "batch_size": 512}}
    monkeypatch.setattr("scenes.scene.QUICK", few)
    _, values = run(tmp_path, "intensity", "wall", "--base", "default", "--repetitions", "2")
    neighbours, *ours = values["rows"]
    assert neighbours["method"] == "kNN"
    assert neighbours["noise_floor"] > 1
    assert ours[0]["mae"] != ours[1]["mae"]
    rows = run(tmp_path, "ablation", "wall", "--repetitions", "1")[1]["rows"]
    assert len({row["mae"] for row in rows}) == len(rows) == 4  # each variant really changes the fit
    table, values = run(tmp_path, "views", "wall", "--base", "default", "--frames", "8")
    # With and without direction, measured and noiseless, at the reflector and elsewhere.
    assert len(values["rows"]) == 8
    assert "### wall, at the reflector" in table
    _, values = run(tmp_path, "poses", "wall", "--repetitions", "1", "--frames", "6", "--samples", "3e3")
    assert {"none", "walk of 0.02 m, 0.1°", "returns alone"} <= {row["poses"] for row in values["rows"]}


@pytest.mark.usefixtures("peers")
def test_tables_keep_scenes_without_intensities_or_ground_truth(tmp_path):
    scans = load_scene("wall", frames=4)
    frame = np.repeat(np.arange(4), [len(p) for p in scans.points])
    path = tmp_path / "bare.npz"
    np.savez(path, points=np.concatenate(scans.points), frame=frame, poses=scans.poses)
    for experiment in ("intensity", "ablation", "views"):
        assert "no intensities" in run(tmp_path, experiment, str(path))[0]
    for experiment in ("surface", "ranges", "calibration"):
        assert "no ground truth" in run(tmp_path, experiment, str(path))[0]


def test_a_rig_whose_recording_is_absent_is_listed(tmp_path):
    runner.main("bench.rigs", RIGS, ["motorway", "nowhere.npz", "--quick", "--out", str(tmp_path)])
    (row,) = json.loads((tmp_path / "rigs-motorway.json").read_text())["rows"]
    assert "no such file" in row["why_not"]
