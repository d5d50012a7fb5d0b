# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The calibration experiment, with maps whose answers are known to be right, too small, or missing."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from radarsdf import RadarMap

from bench.paper import __main__ as command
from bench.paper.calibration import compared, sampled, seen_from
from bench.paper.scenes import load_scene
from bench.paper.truth import along_normals


@pytest.fixture(scope="module")
def scene():
    return load_scene("wall", frames=10)


@pytest.fixture(scope="module")
def surface(scene):
    """Points of the wall's front, moved along its normal by Gaussian errors of known deviations."""
    rng = np.random.default_rng(0)
    y, z = rng.uniform(-6, 6, 6000), rng.uniform(0.6, 2.5, 6000)
    x = np.column_stack([np.zeros(6000), y, z])
    normals = np.tile([1.0, 0.0, 0.0], (6000, 1))
    # Windows stand out, and the reflector.
    x -= along_normals(scene.simulation.scene, x + 0.2 * normals, normals)[:, None] * normals - 0.2 * normals
    sigma_m = rng.uniform(0.01, 0.1, 6000)
    return x + (sigma_m * rng.standard_normal(6000))[:, None] * normals, normals, sigma_m


def test_a_right_map_is_right(scene, surface):
    x, normals, sigma_m = surface
    row = compared(scene, x, normals, sigma_m, np.ones(len(x)), 0.2)
    assert row["coverage_95"] == pytest.approx(0.95, abs=0.01)
    assert row["coverage_50"] == pytest.approx(0.5, abs=0.02)
    assert row["ence"] < 0.06
    assert row["worst_decile_factor"] < 1.1
    assert (row["false_share"], row["unobserved_share"]) == (0, 0)
    assert row["aside_share"] < 0.05
    assert row["confidence_worst_gap"] < 0.01


def test_an_overconfident_map_is_found_out(scene, surface):
    x, normals, sigma_m = surface
    row = compared(scene, x, normals, sigma_m / 2, np.full(len(x), 0.5), 0.2)
    assert row["coverage_95"] == pytest.approx(0.67, abs=0.02)
    assert row["ence"] == pytest.approx(1, abs=0.1)
    assert row["confidence_worst_gap"] == pytest.approx(0.5, abs=0.01)
    for key in ("by_range", "by_scans"):
        assert sum(band["samples"] for band in row[key]) == len(x)
    # Not by scans: fewer returns are near a point with a large error, so there the errors are larger.
    found = [band["z_rms"] for band in row["by_range"] if "z_rms" in band]
    assert len(found) == 2
    np.testing.assert_allclose(found, 2, atol=0.1)


def test_false_surface_and_unknown_points_are_shares(scene, surface):
    x, normals, sigma_m = (array.copy() for array in surface)
    x[:600, 0] += 2.0  # in free space
    sigma_m[600:900] = np.nan
    row = compared(scene, x, normals, sigma_m, np.where(np.arange(6000) < 600, 0.05, 0.95), 0.2)
    assert row["false_share"] == pytest.approx(0.1, abs=0.02)  # some reach the ground or the reflector
    assert row["unobserved_share"] == pytest.approx(0.05)
    assert row["coverage_95"] == pytest.approx(0.95, abs=0.01)  # of the rest
    assert row["num_points"] + row["num_unknown"] == 6000
    assert row["confidence_auc"] > 0.95


def test_points_near_another_surface_by_chance_do_not_widen_the_core(scene, surface):
    x, normals, sigma_m = surface
    x = x.copy()
    x[:1500, 0] = np.random.default_rng(1).uniform(-0.4, 0.4, 1500)
    row = compared(scene, x, normals, sigma_m, np.ones(len(x)), 0.2)
    assert row["rmse_m"] > 0.1
    assert row["core_m"] == pytest.approx(np.sqrt(np.mean(sigma_m**2)), rel=0.15)


def test_samples_lie_on_the_mesh_with_its_normals():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    x, normals = sampled(ball, 20_000, None)
    assert len(x) == 20_000
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 2, atol=0.03)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert (np.einsum("ij,ij->i", normals, x) / 2 > 0.98).all()
    assert np.abs(x.mean(axis=0)).max() < 0.05  # as much on each side
    upper, _ = sampled(ball, 20_000, np.array([[-3.0, -3, 0], [3, 3, 3]]))
    assert upper[:, 2].min() >= 0
    assert len(upper) == pytest.approx(10_000, rel=0.05)
    assert len(sampled(trimesh.Trimesh(), 100, None)[0]) == 0


def test_range_and_number_of_scans(scene):
    frame = 4
    point = scene.points[frame][np.linalg.norm(scene.points[frame], axis=1) > 5][0].astype(np.float64)
    x = scene.poses[frame, :3, :3] @ point + scene.poses[frame, :3, 3]
    range_m, scans = seen_from(scene, np.stack([x, x + [0, 0, 50]]))
    world = [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(scene.points, scene.poses, strict=True)]
    kept = [np.linalg.norm(p, axis=1) >= scene.min_range_m for p in scene.points]
    near = [(np.linalg.norm(p - x, axis=1) < 0.3) & k for p, k in zip(world, kept, strict=True)]
    assert scans.tolist() == [sum(mask.any() for mask in near), 0]
    ranges_m = np.concatenate([np.linalg.norm(p, axis=1)[m] for p, m in zip(scene.points, near, strict=True)])
    assert range_m[0] == pytest.approx(np.median(ranges_m), abs=1e-4)
    assert 2 < range_m[1] < 60


def run(tmp_path, *words):
    command.main(["calibration", *words, "--quick", "--out", str(tmp_path)])
    stem = tmp_path / "calibration"
    assert stem.with_suffix(".png").stat().st_size > 1000
    return stem.with_suffix(".md").read_text(encoding="utf-8"), json.loads(
        stem.with_suffix(".json").read_text()
    )["rows"]


def test_the_experiment(tmp_path, monkeypatch):
    asked = []

    def uncertainty(self, x):
        asked.append(type(self))
        return 0.05 + 0.01 * np.abs(np.sin(x[:, 0]))

    monkeypatch.setattr(RadarMap, "uncertainty", uncertainty, raising=False)
    table, rows = run(tmp_path, "wall", "--samples", "3000", "--set", "mesh.voxel_size=0.2")
    assert set(asked) == {RadarMap}
    assert [(row["variant"], row["repetition"]) for row in rows] == [
        ("defaults", 0), ("defaults", 1), ("mesh.voxel_size=0.2", 0), ("mesh.voxel_size=0.2", 1),
    ]  # fmt: skip
    first, second = (row["rmse_m"] for row in rows[:2])
    assert first != second  # other scans, not only another fit
    for row in rows:
        assert len(row["bin_rmse_m"]) == 20
        assert len(row["confidence_bin_count"]) == 10
        assert 0 <= row["false_share"] + row["aside_share"] <= 1
    for heading in (
        "by uncertainty",
        "by range, m",
        "by scans",
        "by confidence",
        "ENCE",
        "30 or more",
        " ± ",
    ):
        assert heading in table, heading


def test_recorded_scans_are_compared_with_planes(tmp_path, monkeypatch):
    monkeypatch.setattr(RadarMap, "uncertainty", lambda _, x: np.full(len(x), 0.05), raising=False)
    scans = load_scene("wall", frames=12)
    arrays = {
        "points": np.concatenate(scans.points),
        "frame": np.repeat(np.arange(12), [len(p) for p in scans.points]),
        "poses": scans.poses,
    }
    np.savez(tmp_path / "drive.npz", lidar_points=scans.ground_truth, **arrays)
    np.savez(tmp_path / "bare.npz", **arrays)
    words = ("--samples", "3000", "--repetitions", "1", "--frames", "12")
    table, rows = run(tmp_path, str(tmp_path / "drive.npz"), str(tmp_path / "bare.npz"), *words)
    drive, bare = rows
    assert drive["truth_sigma_m"] == 0.03
    assert drive["mean_uncertainty_m"] == pytest.approx(np.hypot(0.05, 0.03))
    assert drive["num_points"] > 100
    assert bare["why_not"] == "the scene has no ground truth"
    assert "- default, defaults, repetition 0: the scene has no ground truth" in table


def test_a_map_that_knows_nothing_stays_in_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(RadarMap, "uncertainty", lambda _, x: np.full(len(x), np.nan), raising=False)
    table, rows = run(tmp_path, "wall", "--samples", "1000", "--repetitions", "1")
    assert "0 points are too few" in rows[0]["why_not"]
    assert "0 points are too few" in table
