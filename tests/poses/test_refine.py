"""Poses that returns refine, and poses that they keep."""

import json
import re

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, RefinedPoses
from radarsdf.config.groups import ReturnsConfig
from radarsdf.map.radar_map import checked_report
from radarsdf.poses.agreement import Verdict
from radarsdf.poses.loops import open_loops, visits
from radarsdf.poses.odometry import PosedScans
from radarsdf.poses.planes import SensorReturns, common_planes, unbiased_normals
from radarsdf.poses.rigid import aligned, turned_by
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.planes import Surfels
from radarsdf.simulate import drifted

from scenes.kinds import KINDS

from .drift import measured, normalised_errors, position_error_m


@pytest.fixture(scope="module")
def street():
    return radarsdf.simulate.hugin(seed=61, frames=20)


@pytest.fixture(scope="module")
def refined(street):
    return radarsdf.refine_poses(street.points, drifted(street.poses, 0.05, 0.004, 1))


def test_drift_is_removed(street, refined):
    given = drifted(street.poses, 0.05, 0.004, 1)
    assert refined.improved
    both = [aligned(poses, street.poses) for poses in (given, refined.poses)]
    before, after = (position_error_m(poses, street.poses) for poses in both)
    assert after < 0.7 * before
    turns = [np.sqrt((turned_by(poses, street.poses) ** 2).mean()) for poses in both]
    assert turns[1] < 0.9 * turns[0]
    assert 0.03 < refined.report["sigma_m"] < 0.07
    assert 0.001 < refined.report["sigma_rad"] < 0.008
    moved = [refined.report[name] for name in ("moved_m", "moved_rad")]
    turned_rad = np.sqrt((turned_by(refined.poses, given) ** 2).mean())
    assert moved == pytest.approx([position_error_m(refined.poses, given), turned_rad])
    assert moved[0] > 0.5 * before
    assert "sharper map" in refined.report["verdict"]
    assert refined.report["scans"] == 20


def test_a_bias_is_no_noise(street):
    given = drifted(street.poses, 0.01, 0.0005, 2, yaw_rad=0.01)
    found = radarsdf.refine_poses(street.points, given)
    assert found.improved
    assert found.report["bias"][5] == pytest.approx(-0.01, abs=0.001)
    assert found.report["sigma_rad"] < 0.003


def test_the_returns_of_many_scans_measure_a_bias_in_yaw():
    """Those of one step hardly do: half of the bias remained."""
    hall = KINDS["hall"](seed=3)
    given = drifted(hall.poses, 0.02, 0.001, 2, yaw_rad=0.0035)
    assert radarsdf.refine_poses(hall.points, given).report["bias"][5] == pytest.approx(-0.0035, rel=0.1)


def test_a_lap_that_ends_near_its_start_is_a_visit():
    # For a range of 1 m, the first scan of the last part of the path is 0.54 m from the start, and the last scan 0.4 m.
    lap = np.tile(np.eye(4), (100, 1, 1))
    angle = np.linspace(0, 2 * np.pi, 100)
    lap[:, :2, 3] = 9.45 / (2 * np.pi) * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    lap[:, 2, 3] = np.linspace(0, 0.4, 100)
    ((later, earlier),) = visits(1.0, lap)
    assert (later[-1], earlier[0]) == (99, 0)


def test_an_open_loop_is_reported():
    lap = KINDS["yard"](seed=1)
    returns, noise = SensorReturns.of(lap.points, 0.1, None), SensorNoise(0.1, 0.015, 0.02)
    assert open_loops(returns, lap.poses, noise) == []
    (note,) = open_loops(returns, drifted(lap.poses, 0.02, 0.001, 1, yaw_rad=0.0035), noise, 1000)
    scans = [int(word) for word in re.findall(r"\b1\d{3}\b", note)]
    assert scans[1] == 1099
    assert scans[2] == 1000
    assert scans[3] - scans[2] < 15
    assert "A loop is open" in note


def test_true_poses_are_returned_unchanged(street):
    found = radarsdf.refine_poses(street.points, street.poses)
    assert not found.improved
    np.testing.assert_array_equal(found.poses, street.poses)
    assert "are kept" in found.report["verdict"]


def test_errors_agree_with_the_covariance(street, refined):
    middle = len(street.poses) // 2
    assert 0.2 < np.mean(normalised_errors(refined, street.poses)) < 5
    assert np.abs(refined.covariance[middle]).max() < 1e-8
    assert np.linalg.eigvalsh(np.delete(refined.covariance, middle, 0)).min() > 0


def test_the_bits_do_not_depend_on_threads(street):
    given = drifted(street.poses, 0.05, 0.004, 1)
    one, three = (
        radarsdf.refine_poses(street.points[:6], given[:6], config=FitConfig(num_threads=threads))
        for threads in (1, 3)
    )
    np.testing.assert_array_equal(one.poses, three.poses)
    np.testing.assert_array_equal(one.covariance, three.covariance)


def test_a_plane_observes_heights_and_nothing_else():
    rng = np.random.default_rng(0)
    given = np.tile(np.eye(4), (8, 1, 1))
    given[:, 0, 3] = np.arange(8.0)
    height_m = rng.normal(0, 0.1, 8)
    scans = []
    for error_m in height_m:
        scan = np.column_stack([rng.uniform(-6, 6, (1500, 2)), rng.normal(-2, 0.02, 1500)])
        scan[:, 2] -= error_m
        scans.append(scan)
    found = radarsdf.refine_poses(scans, given)
    assert found.improved
    moved = (found.poses - given)[:, :3, 3]
    assert np.abs(moved[:, 2] - (height_m - height_m.mean())).max() < 0.02
    along, across = np.sqrt(np.einsum("fii->fi", found.covariance))[[0, -1]][:, [0, 2]].T
    assert (along > 30 * across).all()


def test_along_a_corridor_poses_stay():
    rng = np.random.default_rng(0)
    true = np.tile(np.eye(4), (20, 1, 1))
    true[:, 0, 3] = 0.4 * np.arange(20)
    scans = []
    for _ in true:
        along, other = rng.uniform(3, 15, 900), rng.uniform(-1, 1, 900)
        walls = np.column_stack([along, np.sign(other) * 3, rng.uniform(-1, 2, 900)])
        floor = np.column_stack([along, 3 * other, np.full(900, -1.2)])
        scans.append(np.concatenate([walls, floor]) + rng.normal(0, 0.05, (1800, 3)))
    found = radarsdf.refine_poses(scans, true)
    assert not found.improved
    given = drifted(true, 0.03, 0.002, 4)
    mended = radarsdf.refine_poses(scans, given)
    assert mended.improved
    off = (aligned(mended.poses, true) - true)[:, :3, 3]
    assert np.abs(off[:, 1:]).max() < 0.03
    along_given, along = ((aligned(p, true) - true)[:, 0, 3] for p in (given, mended.poses))
    # Rotated steps also change the position along the corridor.
    assert np.abs(along - along_given).max() < 0.05


@pytest.mark.parametrize("counts", [[50], [0, 5], [1, 1], [5, 5, 0]])
def test_poses_with_too_few_returns_are_kept(counts):
    rng = np.random.default_rng(1)
    scans = [rng.normal(0, 3, (max(n, 1), 3)) for n in counts]
    given = np.tile(np.eye(4), (len(counts), 1, 1))
    found = radarsdf.refine_poses(scans, given)
    assert not found.improved
    assert found.report.get("gain", 0.0) == 0
    assert found.covariance.shape == (len(counts), 6, 6)
    np.testing.assert_array_equal(found.poses, given)


def test_wrong_arguments_are_refused(street):
    points, poses = street.points[:3], street.poses[:3]
    with pytest.raises(ValueError, match="poses are missing"):
        radarsdf.refine_poses(points)
    with pytest.raises(ValueError, match="times_s must be one"):
        radarsdf.refine_poses(points, poses, times_s=[0.0])
    with pytest.raises(ValueError, match="ascend"):
        radarsdf.refine_poses(points, poses, times_s=[0.0, 2, 1])
    for wrong in ([True] * 3, [True, False], [1, 0, 0]):
        with pytest.raises(ValueError, match="fixed must be"):
            radarsdf.refine_poses(points, poses, fixed=wrong)


def test_unusable_scans_are_excluded():
    scans = measured(radarsdf.simulate.wall(frames=12))
    points, speeds, poses = list(scans.points), list(scans.doppler_mps), scans.poses.copy()
    points[2], speeds[2], poses[5] = points[2][:0], speeds[2][:0], np.nan
    refined = radarsdf.refine_poses(points, poses, doppler_mps=speeds, times_s=scans.times_s)
    assert np.linalg.norm(refined.poses[5, :3, 3] - scans.poses[5, :3, 3]) < 0.5
    assert [note.count("scan 2") + 2 * note.count("scan 5") for note in refined.report["notes"]] == [1, 2]
    found = radarsdf.odometry(points, doppler_mps=speeds, times_s=scans.times_s)
    assert np.isfinite(found.poses).all()
    assert "1 scans without returns (the first is scan 2)" in found.report["notes"][0]


def test_zero_doppler_does_not_contract_true_poses():
    drive = measured(radarsdf.simulate.hugin(seed=8, frames=16))
    found = radarsdf.refine_poses(drive, doppler_mps=[0 * speeds for speeds in drive.doppler_mps])
    np.testing.assert_array_equal(found.poses, drive.poses)
    assert "not measured" in found.report["notes"][0] or "no motion" in found.report["notes"][0]


def test_covariances_of_kept_poses_span_the_refined_ones(street):
    one = [street.points[i] if i == 10 else points[:9] for i, points in enumerate(street.points)]
    given = drifted(street.poses, 0.05, 0.004, 1)
    found = radarsdf.refine_poses(one, given)
    assert not found.improved
    variances = np.einsum("fii->f", found.covariance[:, :3, :3])
    assert variances[[0, -1]].min() > found.report["moved_m"] ** 2 / 4


def test_one_moving_object_does_not_count_as_improvement():
    # The gain of each scan is the same, so that scans alone would make it significant.
    one, many = _verdict(1), _verdict(60)
    assert one.mean > 0
    assert not one.improved
    assert many.improved


def test_contracted_scans_have_no_better_agreement():
    drive = KINDS["tunnel"](seed=8, frames=16)
    returns = SensorReturns.of(drive.points, 0.1, None)
    held = np.random.default_rng(0).random(len(returns)) < 0.2
    parts, noise = (returns.select(held), returns.select(~held)), SensorNoise(0.1, 0.01, 0.01)
    for share in (0.0, 0.5):  # fraction of the distance driven
        after = drive.poses.copy()
        after[:, :3, 3] *= share
        verdict = Verdict.of(*parts, drive.poses, after, noise)
        assert verdict.mean > 0  # caused by density alone
        assert not verdict.improved


def _verdict(things: int) -> Verdict:
    """Verdict on poses with errors of 0.3 m per scan, if a share of returns is on objects consistent only with them."""
    rng, frames = np.random.default_rng(0), 12
    before = np.tile(np.eye(4), (frames, 1, 1))
    after = before.copy()
    after[:, 0, 3] = 0.3 * np.arange(frames)
    places = rng.uniform(-40, 40, (things, 3))
    scans = []
    for pose in after:
        staying = places[rng.integers(0, things, 240)] + rng.normal(0, 0.2, (240, 3)) - pose[:3, 3]
        scans.append(np.concatenate([staying, rng.uniform(-40, 40, (1000, 3))]))
    returns = SensorReturns.of(scans, 0.1, None)
    held = rng.random(len(returns)) < 0.2
    noise = SensorNoise(0.2, 0.001, 0.001)
    return Verdict.of(returns.select(held), returns.select(~held), before, after, noise)


def test_the_verdict_is_saved_with_the_map():
    poses = np.tile(np.eye(4), (1201, 1, 1))
    poses[:, 0, 3] = np.arange(1201)
    covariance = np.tile(np.diag([1.0, 4, 4, 0.01, 0.01, 0.04]), (1201, 1, 1))
    report = {"verdict": "Better.", "sigma_m": 0.1, "sigma_rad": 0.02}
    found, given = RefinedPoses(poses, covariance, True, report), poses.copy()
    given[:, 1, 3] = 1
    way = json.loads(json.dumps(PosedScans.of(found, given).trajectory))
    assert len(way["scans"]) == len(way["before"]) == len(way["after"]) == len(way["sigma_m"]) == 500
    assert way["after"][-1] == [1200, 0, 0]
    assert way["before"][-1] == [1200, 1, 0]
    assert (way["verdict"], way["improved"], way["step_m"]) == ("Better.", True, 0.1)
    assert checked_report({"poses": way})["poses"] == way
    with pytest.raises(ValueError, match=r"report\.poses"):
        checked_report({"poses": 3})


def test_normals_of_a_wall_do_not_point_along_it():
    rng = np.random.default_rng(0)
    n = 20_000
    wall = np.column_stack([rng.normal(5, 0.05, n), rng.uniform(-6, 6, n), rng.uniform(-1, 2, n)])
    surfels = Surfels.of(SensorReturns.of([wall], 0.0, None).posed(np.eye(4)[None]), 0.2)
    flat = surfels.is_flat()
    along, observed = surfels.normals[flat, 1], unbiased_normals(surfels, 1)[flat, 1]
    assert along.std() > 0.003
    assert observed.std() < 0.2 * along.std()


@pytest.mark.parametrize("height_m", [-2.05, -1.95])
def test_a_noisy_scan_has_an_unbiased_height(height_m):
    # Noise reaches over the borders of cells, 0.4 m high.
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = 0.2 * np.arange(10)
    scans = []
    for noise_m in np.tile([0.02, 0.15], 5):
        scans.append(np.column_stack([rng.uniform(-3, 3, (3000, 2)), rng.normal(height_m, noise_m, 3000)]))
    returns = SensorReturns.of(scans, 0.0, None)
    planes, _ = common_planes(returns, poses, 10, 0.4, None, ReturnsConfig(), 1)
    weak = np.tile(np.eye(6), (10, 1, 1, 1))
    moved = planes.solve(weak, np.zeros((10, 6)), 1e-6, 100, False, 1)[0][:, 2]
    # 0.02 if returns were assigned to the cell of their position.
    assert abs(moved[::2].mean() - moved[1::2].mean()) < 0.01


def test_the_faces_of_a_wall_do_not_attract_each_other():
    """Regression: as one plane, they moved the scans of each side by half of its thickness."""
    rng, scans, poses = np.random.default_rng(4), [], np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.tile([-3.0, 3.4], 5)
    for x in poses[:, 0, 3]:
        face = rng.normal(0.2 + 0.03 * np.sign(x) - x, 0.01, 3000)
        scans.append(np.column_stack([face, rng.uniform(-2, 2, (3000, 2))]))
    planes, _ = common_planes(SensorReturns.of(scans, 0.0, None), poses, 10, 0.4, None, ReturnsConfig(), 1)
    steps = np.tile(np.eye(6), (10, 1, 1, 1)), np.zeros((10, 6))
    moved = planes.solve(*steps, 1e-6, 100, False, 1)[0][:, 0]
    assert abs(moved[::2] - moved[1::2]).max() < 0.01


def test_fixed_poses_are_kept():
    wall = radarsdf.simulate.wall(frames=6)
    given, fixed = drifted(wall.poses, 0.1, 0.01, 3), np.arange(6) == 3
    refined = radarsdf.refine_poses(wall.points, given, fixed=fixed)
    assert refined.improved
    assert ((refined.poses == given).all(axis=(1, 2)) == fixed).all()
    assert normalised_errors(refined, wall.poses).mean() < 3  # 27 if the others ignore it
    free, none = (radarsdf.refine_poses(wall.points, given, fixed=f) for f in (None, np.zeros(6, bool)))
    np.testing.assert_array_equal(none.covariance, free.covariance)
    # A fixed pose has no covariance, even if all are kept.
    kept = radarsdf.refine_poses(wall.points, drifted(wall.poses, 0.1, 0.01, 2), fixed=[True] + 5 * [False])
    assert not kept.improved
    assert np.abs(kept.covariance[0]).max() < 1e-8
