# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What given steps say of poses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from radarsdf.poses.by_doppler import LEAST_MPS, DopplerMotion, SensorVelocities
from radarsdf.poses.motion import Motion, unsteadiness
from radarsdf.poses.rigid import aligned, moved, steps, transform, turned_by
from radarsdf.simulate import drifted
from scipy.spatial.transform import Rotation

from .drift import trajectory


def test_steps_lead_from_pose_to_pose():
    poses = trajectory(9)
    np.testing.assert_allclose(poses[:-1] @ steps(poses), poses[1:], atol=1e-12)


def test_alignment_undoes_a_motion_of_the_whole():
    poses = trajectory(20)
    other = drifted(poses, 0.1, 0.02, 1)
    whole = moved(np.eye(4)[None], np.array([[3.0, -2, 1, 0.2, -0.3, 1.1]]))[0]
    np.testing.assert_allclose(aligned(whole @ poses, poses), poses, atol=1e-12)
    found = aligned(whole @ other, poses)
    np.testing.assert_allclose(found, aligned(other, poses), atol=1e-12)
    np.testing.assert_allclose(found[:, :3, 3].mean(axis=0), poses[:, :3, 3].mean(axis=0), atol=1e-12)
    assert turned_by(found, poses).max() < turned_by(whole @ other, poses).min()


@pytest.mark.parametrize("times", [None, [0.0, 1, 2, 3, 8, 9]])
def test_the_prior_has_the_derivatives_of_its_cost(times):
    given = trajectory(6)
    motion = Motion.of(given, 0.1, 0.02, None if times is None else np.array(times))
    motion = dataclasses.replace(motion, bias=np.array([0.01, 0, 0, 0, 0, 0.01]))
    poses = drifted(given, 1e-3, 1e-3, 2)

    def cost(increments):
        errors = motion.errors(moved(poses, increments)) - motion.bias * motion.spans[:, None]
        return 0.5 * (errors**2 / np.repeat([0.1**2, 0.02**2], 3) / motion.spans[:, None]).sum()

    diagonal, below, gradient = motion.prior(poses)
    h = 1e-5
    for s, a in [(0, 0), (2, 4), (3, 5), (5, 2)]:
        step = np.zeros((6, 6))
        step[s, a] = h
        slope = (cost(step) - cost(-step)) / (2 * h)
        assert slope == pytest.approx(gradient[s, a], rel=5e-3, abs=0.05)
        curvature = (cost(step) - 2 * cost(0 * step) + cost(-step)) / h**2
        assert curvature == pytest.approx(diagonal[s, a, a], rel=0.02)
    one, other = np.zeros((2, 6, 6))
    one[3, 1], other[2, 1] = h, h
    crossed = (cost(one + other) - cost(one - other) - cost(other - one) + cost(-one - other)) / (4 * h**2)
    assert crossed == pytest.approx(below[2, 1, 1], rel=0.02)


def test_deviations_and_bias_are_learnt_from_poses_that_are_known():
    true = trajectory(400)
    given = drifted(true, 0.03, 0.004, 3, yaw_rad=0.01)
    nothing = np.zeros((400, 6, 6)), np.zeros((399, 6, 6))
    learnt = Motion.of(given, 0.1, 0.01).learnt(true, true, *nothing)
    assert learnt.sigma_m == pytest.approx(0.03, rel=0.1)
    assert learnt.sigma_rad == pytest.approx(0.004, rel=0.1)
    assert learnt.bias[5] == pytest.approx(-0.01, abs=5e-4)
    kept = Motion.of(given, 0.1, 0.01, known=(True, True)).learnt(true, true, *nothing)
    assert (kept.sigma_m, kept.sigma_rad) == pytest.approx((0.1, 0.01))


def test_where_the_whole_is_counts_as_no_error_of_steps():
    before, given = trajectory(30), drifted(trajectory(30), 0.03, 0.004, 3)
    # All sensors turn round the origin together, by any angle.
    whole = np.concatenate([np.cross([0, 0, 1], before[:, :3, 3]), np.tile([0, 0, 1.0], (30, 1))], 1)
    free = 1e4 * np.einsum("fi,fj->fij", whole, whole), 1e4 * np.einsum("fi,fj->fij", whole[1:], whole[:-1])
    nothing = np.zeros((30, 6, 6)), np.zeros((29, 6, 6))
    after = drifted(before, 0.01, 0.001, 4)
    motion = Motion.of(given, 0.1, 0.01)
    some, none = (motion.learnt(after, before, *covariance) for covariance in (free, nothing))
    assert some.sigma_m == pytest.approx(none.sigma_m, rel=1e-3)
    assert some.bias == pytest.approx(none.bias, abs=1e-3)


def test_a_bias_that_is_not_told_is_not_learnt():
    poses, given = trajectory(30), drifted(trajectory(30), 0.03, 0.004, 3, yaw_rad=0.01)
    motion = Motion.of(given, 0.1, 0.01)
    # As much is unknown of each step as before, in all its components but the rotations.
    loose = np.zeros((30, 6, 6))
    loose[:, :3, :3] = 0.1**2 / 2 * np.eye(3)
    learnt = motion.learnt(poses, poses, loose, np.zeros((29, 6, 6)))
    assert learnt.bias[:3] == pytest.approx(0, abs=1e-9)
    assert learnt.bias[5] == pytest.approx(-0.01, rel=0.2)


def test_a_bias_is_believed_as_far_as_it_is_told():
    motion = Motion.of(trajectory(6), 0.1, 0.02)
    bias = np.array([0.05, 0.1, 0.2, 0.01, 0.02, 0.05])
    shares = np.stack(
        [motion._told(bias, share * np.repeat(motion.variances, 3)) for share in (0, 0.3, 0.6, 1, 2)]
    )
    np.testing.assert_allclose(shares[[0, -2, -1]], [[1] * 6, [0] * 6, [0] * 6], atol=1e-12)
    assert (np.diff(shares[:4], axis=0) < 0).all()
    # One that is as large as the errors of steps, half of whose variance is left.
    half = motion._told(np.sqrt(np.repeat(motion.variances, 3)), 0.5 * np.repeat(motion.variances, 3))
    np.testing.assert_allclose(half, 0.5)


def test_velocities_lead_from_pose_to_pose():
    times_s = np.arange(12) * 0.1
    h = 1e-4

    def pose(time_s):
        """A curve that turns and gains speed."""
        turn = Rotation.from_euler("zyx", [0.5 * time_s**2, 0.2 * np.sin(time_s), 0.1 * time_s]).as_rotvec()
        return transform(turn, np.array([3 * time_s**2, np.sin(2 * time_s), 0.2 * time_s]))

    poses = np.stack([pose(t) for t in times_s])
    mean = np.stack([pose(t)[:3, :3].T @ (pose(t + h) - pose(t - h))[:3, 3] / (2 * h) for t in times_s])
    count = len(times_s)
    velocities = SensorVelocities(
        mean, np.tile(1e-4 * np.eye(3), (count, 1, 1)), np.ones(3), [], np.ones(count, bool)
    )
    found = DopplerMotion.by(velocities, times_s, poses)
    # Between scans its velocity is taken to change evenly, in its own frame. That of a neighbour would be off by 0.05 m.
    np.testing.assert_allclose(found.steps, steps(poses), atol=2e-3)


def test_velocities_change_by_time():
    scan = np.random.default_rng(6).normal(size=(200, 3))
    directions = scan / np.linalg.norm(scan, axis=1, keepdims=True)
    doppler_mps = [-directions @ np.array([forward, 0, 0]) for forward in (5, 6, 5)]
    change = SensorVelocities.of([scan] * 3, doppler_mps, np.array([0, 0.1, 0.2])).change
    np.testing.assert_allclose(change, [2 / 0.2 + LEAST_MPS**2, LEAST_MPS**2, LEAST_MPS**2], rtol=1e-6)


def test_steps_of_a_slow_source_are_unsteady():
    poses = trajectory(60)
    stale = poses[np.arange(60) // 2 * 2]
    assert unsteadiness(poses, None)[0] < 0.05
    assert unsteadiness(stale, None)[0] > 0.2
    assert unsteadiness(poses[:2], None) == (0, 0)
    with_a_gap = np.arange(60.0) + 30 * (np.arange(60) > 30)
    assert unsteadiness(poses, with_a_gap)[0] < 0.05


def test_a_step_over_a_gap_may_have_larger_errors():
    poses = trajectory(5)
    assert Motion.of(poses, 0.1, 0.01).spans.tolist() == [1, 1, 1, 1]
    assert Motion.of(poses, 0.1, 0.01, np.array([0.0, 0.1, 0.2, 2.2, 2.3])).spans == pytest.approx(
        [1, 1, 20, 1]
    )
    assert Motion.of(poses, 0.1, 0.01, np.zeros(5)).spans.tolist() == [1, 1, 1, 1]


def test_what_a_source_does_not_tell_is_left_to_others():
    poses = trajectory(8)
    turns = Motion.of(poses, 0.1, 0.01).rotations_only()
    diagonal, below, gradient = turns.prior(drifted(poses, 0.1, 0.01, 5))
    assert np.abs(diagonal[:, :3]).max() == 0
    assert np.abs(below[:, :3]).max() == 0
    assert np.abs(gradient[:, :3]).max() == 0
    assert np.abs(gradient[:, 3:]).max() > 0
    others = drifted(poses, 0.1, 0.01, 5)
    learnt = turns.learnt(others, others, np.zeros((8, 6, 6)), np.zeros((7, 6, 6)))
    assert learnt.sigma_m == turns.sigma_m
    assert learnt.sigma_rad != turns.sigma_rad
    assert learnt.bias[:3].tolist() == [0, 0, 0]
