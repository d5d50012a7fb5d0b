# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses that returns mend, and those that they leave alone."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.poses.rigid import aligned, turned_by
from radarsdf.simulate import drifted

from .drift import position_error_m


@pytest.fixture(scope="module")
def street():
    return radarsdf.simulate.hugin(seed=61, frames=20)


@pytest.fixture(scope="module")
def refined(street):
    return radarsdf.refine_poses(street.points, drifted(street.poses, 0.05, 0.004, 1))


def test_a_drift_is_mended(street, refined):
    given = drifted(street.poses, 0.05, 0.004, 1)
    assert refined.improved
    before, after = (
        position_error_m(aligned(poses, street.poses), street.poses) for poses in (given, refined.poses)
    )
    assert after < 0.7 * before
    turns = [
        np.sqrt((turned_by(aligned(p, street.poses), street.poses) ** 2).mean())
        for p in (given, refined.poses)
    ]
    assert turns[1] < 0.9 * turns[0]
    assert 0.03 < refined.report["sigma_m"] < 0.07
    assert 0.001 < refined.report["sigma_rad"] < 0.008
    assert refined.report["moved_m"] > 0.5 * before
    assert "sharper map" in refined.report["verdict"]
    assert refined.report["scans"] == 20


def test_a_bias_is_no_noise(street):
    given = drifted(street.poses, 0.01, 0.0005, 2, yaw_rad=0.01)
    found = radarsdf.refine_poses(street.points, given)
    assert found.improved
    assert found.report["bias"][5] == pytest.approx(-0.01, abs=0.001)
    assert found.report["sigma_rad"] < 0.003


def test_true_poses_come_back_to_the_bit(street):
    found = radarsdf.refine_poses(street.points, street.poses)
    assert not found.improved
    np.testing.assert_array_equal(found.poses, street.poses)
    assert "are kept" in found.report["verdict"]


def test_errors_agree_with_the_covariance(street, refined):
    middle = len(street.poses) // 2
    whole = street.poses[middle] @ np.linalg.inv(refined.poses[middle])
    errors = (whole @ refined.poses)[:, :3, 3] - street.poses[:, :3, 3]
    normalised = [
        error @ np.linalg.solve(covariance[:3, :3], error) / 3
        for i, (error, covariance) in enumerate(zip(errors, refined.covariance, strict=True))
        if i != middle
    ]
    assert 0.2 < np.mean(normalised) < 5
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
    # Turned steps lead elsewhere, along the corridor, too.
    assert np.abs(along - along_given).max() < 0.05


@pytest.mark.parametrize("counts", [[50], [0, 5], [1, 1], [5, 5, 0]])
def test_hardly_any_returns_keep_their_poses(counts):
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


def test_scans_that_cannot_be_used_are_left_out():
    scans = radarsdf.simulate.wall(frames=12)
    motion = radarsdf.simulate.measured_motion(scans)
    points, speeds, poses = list(scans.points), list(motion.doppler_mps), scans.poses.copy()
    points[2], speeds[2], poses[5] = points[2][:0], speeds[2][:0], np.nan
    refined = radarsdf.refine_poses(points, poses, doppler_mps=speeds, times_s=motion.times_s)
    assert np.linalg.norm(refined.poses[5, :3, 3] - scans.poses[5, :3, 3]) < 0.5
    assert [note.count("scan 2") + 2 * note.count("scan 5") for note in refined.report["notes"]] == [1, 2]
    found = radarsdf.odometry(points, doppler_mps=speeds, times_s=motion.times_s)
    assert np.isfinite(found.poses).all()
    assert "1 scans without returns (the first is scan 2)" in found.report["notes"][0]


def test_zeros_for_doppler_do_not_draw_true_poses_together():
    drive = radarsdf.simulate.hugin(seed=8, frames=16)
    motion = radarsdf.simulate.measured_motion(drive)
    speeds = [0 * v for v in motion.doppler_mps]
    found = radarsdf.refine_poses(drive.points, drive.poses, doppler_mps=speeds, times_s=motion.times_s)
    np.testing.assert_array_equal(found.poses, drive.poses)
    assert "100%" in found.report["notes"][0]


def test_doppler_that_contradicts_the_given_poses_is_left_out(street):
    motion = radarsdf.simulate.measured_motion(street)
    speeds = [0.2 * v for v in motion.doppler_mps]
    found = radarsdf.refine_poses(street.points, street.poses, doppler_mps=speeds, times_s=motion.times_s)
    np.testing.assert_array_equal(found.poses, street.poses)
    assert "contradicts 64%" in found.report["notes"][0]


def test_covariance_of_kept_poses_spans_those_that_were_not_excluded(street):
    one = [street.points[i] if i == 10 else points[:9] for i, points in enumerate(street.points)]
    given = drifted(street.poses, 0.05, 0.004, 1)
    found = radarsdf.refine_poses(one, given)
    assert not found.improved
    variances = np.einsum("fii->f", found.covariance[:, :3, :3])
    assert variances[[0, -1]].min() > found.report["moved_m"] ** 2 / 4
