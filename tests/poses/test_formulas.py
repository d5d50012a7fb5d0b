"""Covariances, derivatives and rates of motions, against random draws, finite differences and manual values."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf import FitConfig, RefinedPoses
from radarsdf.poses.agreement import CLEAR, Gain, Verdict, _crowding, _gains, sign_significance
from radarsdf.poses.doppler import NoVelocityError, SensorVelocities, upright
from radarsdf.poses.imu import Gyroscope, Inertial
from radarsdf.poses.motion import Motion, MotionRate, PredictedStep, way
from radarsdf.poses.odometry import PosedScans, pose_sigmas
from radarsdf.poses.planes import SensorReturns, _discount_tilts, apart_m, reduction
from radarsdf.poses.rigid import (
    aligned,
    between,
    covariance_in,
    increments,
    moved,
    nearest_rotation,
    rotation,
    rotation_vector,
    skew,
    step_vectors,
    transform,
    turned_by,
)
from radarsdf.poses.tracking import SLOW_TURN_RAD_S, Drive, Rates, Tracked, rates_of
from radarsdf.returns.noise import SensorNoise
from radarsdf.simulate import drifted
from scipy.stats import t as student

from .drift import trajectory, velocities_of


def spread(seed, size):
    """A covariance with arbitrary axes."""
    root = np.random.default_rng(seed).normal(0, 1, (size, size))
    return root @ root.T


def test_increments_lead_from_pose_to_pose():
    first, second = trajectory(5), drifted(trajectory(5), 0.3, 0.2, 1)
    assert_allclose(moved(first, increments(first, second)), second, atol=1e-12)
    assert_allclose(between(first, second), np.linalg.inv(first) @ second, atol=1e-12)
    whole = transform(np.array([0.1, 0.2, -0.9]), np.array([5.0, 6, 7]))
    assert_allclose(aligned(first, whole @ first), whole @ first, atol=1e-12)
    shifted = moved(first, np.tile([0.3, 0, 0.4, 0, 0.6, 0.8], (5, 1)))
    assert_allclose(turned_by(first, shifted), 1.0)
    a, b = np.random.default_rng(0).normal(size=(2, 4, 3))
    assert_allclose(np.einsum("nij,nj->ni", skew(a), b), np.cross(a, b))
    assert_allclose(apart_m(shifted, first, 2.0)[0], np.linalg.norm(increments(first, shifted)[0, :3]) + 2)
    covariance = spread(1, 6)
    R, both = whole[:3, :3], np.kron(np.eye(2), whole[:3, :3])
    assert_allclose(covariance_in(covariance[None], R)[0], both @ covariance @ both.T)
    assert_allclose(nearest_rotation(R + 1e-3 * np.diag([1, 2, 3])), R, atol=2e-3)
    assert np.linalg.det(nearest_rotation(-R)) == pytest.approx(1)


def test_covariances_of_a_predicted_step_equal_those_of_draws():
    turn = MotionRate(np.array([0.1, -0.2, 0.4]), 1e-4 * spread(2, 3))
    step = PredictedStep(turn, np.array([8.0, 1, 0]), np.array([7.0, 0, 1]), 1e-3 * spread(3, 3), 0.5)
    rng = np.random.default_rng(0)
    turns = rng.multivariate_normal(turn.mean, turn.covariance, 40_000)
    shifts = rng.multivariate_normal(np.zeros(3), step.translation_covariance, 40_000)
    drawn = np.concatenate([step.pose(turns)[:, :3, 3] + shifts, turns], axis=1)
    expected = np.cov(drawn.T)
    size = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert_allclose(step.covariance() / size, expected / size, atol=0.12)
    moved_m2, turned2 = (np.linalg.eigvalsh(c)[-1] for c in (step.covariance()[:3, :3], turn.covariance))
    assert step.spread_m(20.0) == pytest.approx(np.sqrt(moved_m2 + 400 * turned2))
    # Constant turning and acceleration, in small steps.
    shares = (np.arange(2000) + 0.5) / 2000
    velocities = step.begin_mps + shares[:, None] * (step.end_mps - step.begin_mps)
    path = np.einsum("nij,nj->ni", rotation(shares[:, None] * turn.mean), velocities).mean(axis=0) * 0.5
    assert_allclose(way(turn.mean, step.begin_mps, step.end_mps, 0.5), path, atol=1e-4)
    # Candidates of a search have the same distribution, the more the denser.
    drawn_turns, poses = step.candidates(0.2, 20.0)
    left = poses[:, :3, 3] - step.pose(drawn_turns)[:, :3, 3]
    assert_allclose(drawn_turns.mean(axis=0), turn.mean, atol=1e-3)
    for found, expected in ((drawn_turns, turn.covariance), (left, step.translation_covariance)):
        assert_allclose(np.cov(found.T), expected, atol=0.05 * np.abs(expected).max())
    assert len(step.candidates(1e3, 20.0)[0]) == 64
    assert len(step.candidates(1e-3, 20.0)[0]) == 8192


def test_an_uncertain_bias_has_the_derivatives_of_the_gradient():
    given = trajectory(6)
    sigma = np.array([0.02, 0, 0.05, 0, 0.001, 0])
    motion = Motion.of(given, 0.1, 0.02, np.array([0.0, 1, 2, 4, 5, 7]))
    motion = dataclasses.replace(motion, bias_sigma=sigma)
    motion.shares[2, :3] = np.inf
    poses = drifted(given, 1e-3, 1e-3, 2)
    by, own = motion.by_bias(poses)
    for k, axis in enumerate(np.flatnonzero(sigma)):
        by_one = np.zeros(6)
        by_one[axis] = sigma[axis]
        slope = dataclasses.replace(motion, bias=by_one).prior(poses)[1] - motion.prior(poses)[1]
        assert_allclose(by[k], slope, atol=1e-9)
        spans2 = motion.spans**2 / motion.shares[:, axis]
        assert own[k] == pytest.approx(spans2.sum() * sigma[axis] ** 2 / [0.1**2, 0.02**2][axis // 3])


def test_climbs_equal_a_kalman_update():
    """Scans with a vertical deviation above a tenth of the speed are updated by a velocity of 0 with that deviation."""
    mean = np.array([[10.0, 0, 3.0], [10, 0, 0.2], [10, 0, -4]])
    covariance = np.stack([spread(4, 3), 1e-3 * np.eye(3), spread(5, 3)])
    covariance[[0, 2], 2, 2] += 40
    found, left, count = upright(mean, covariance)
    assert count == 2
    for i in (0, 2):
        P = covariance[i]
        gain = P[:, 2] / (P[2, 2] + 1.0)  # (0.1 · 10 m/s)²
        assert_allclose(found[i], mean[i] - gain * mean[i, 2])
        assert_allclose(left[i], P - np.outer(gain, P[2]))
    assert_array_equal(found[1], mean[1])
    assert_array_equal(left[1], covariance[1])
    # Well-measured climbs may be larger.
    steep = np.array([[10.0, 0, 4], [10, 0, 4]])
    known = np.stack([1e-3 * np.eye(3), np.diag([1.0, 1, 20])])
    gain = 20 / (20 + 16)
    assert_allclose(upright(steep, known)[0][1], [10, 0, 4 - 4 * gain], atol=1e-3)


def test_missing_velocities_are_interpolated():
    rng = np.random.default_rng(6)
    scans = [rng.normal(0, 9, (60, 3)) for _ in range(6)]
    true = np.array([[5.0, 0, 1], [6, 0, 1], [0, 0, 0], [9, 0, 1], [8, 0, 1], [8, 0, 1]])
    times_s = np.array([0.0, 1, 2, 4, 5, 15])
    speeds = [-x @ v / np.linalg.norm(x, axis=1) for x, v in zip(scans, true, strict=True)]
    speeds[2] = rng.uniform(-50, 50, 60)
    speeds[0][:4], speeds[0][4:8] = np.nan, 30
    found = SensorVelocities.of(scans, speeds, times_s)
    assert_array_equal(found.found, [True, True, False, True, True, True])
    assert_allclose(found.mean_mps[2], [7, 0, 1], atol=1e-3)  # a third of the way
    # Changes of 1, 3 and 1 m/s in 1, 3 and 1 s; the gap of 10 s is excluded.
    assert_allclose(found.change, [11 / 5, 0, 0] + np.full(3, 0.02**2), atol=1e-3)
    own = found.covariance[found.found].mean(axis=0)
    assert_allclose(found.covariance[2], np.diag(found.change) + own, atol=1e-6)  # 1 s away
    assert_allclose(found.covariance[4], 0.02**2 * np.eye(3), atol=1e-5)
    assert_allclose(
        found.step_covariance(3, 2.0), found.covariance[3:5].sum(axis=0) + np.diag(found.change) * 8 / 12
    )
    unrelated = sign_significance(scans[:2], found.select(slice(0, 2)), times_s[:2])[0]
    assert abs(unrelated) < CLEAR
    assert found.usual_mps == pytest.approx(np.sqrt([50, 65]).mean(), abs=1e-2)
    noise = [rng.uniform(-50, 50, 60) for _ in scans]
    assert SensorVelocities.of(scans, speeds[:3] + noise[:2] + speeds[5:], times_s).found.sum() == 3
    with pytest.raises(NoVelocityError, match="2 of 6 scans agree"):
        SensorVelocities.of(scans, speeds[:2] + noise[2:], times_s)


def test_a_rotation_by_a_gyroscope_has_the_errors_of_bias_and_noise():
    times_s, at_s = np.array([0.0, 1, 3]), np.array([-1.0, 0.5, 1.5, 4])
    gyroscope = Gyroscope.of(np.outer([0.1, 0.1, 0.3, 0.3], [0, 0, 1.0]), at_s, times_s, 0.05)
    # The trapezoids: 0.05 + (0.1 + 0.2) / 4 rad, and (0.2 + 0.3) / 4 + 0.45 rad.
    assert_allclose(gyroscope.turns, [[0, 0, 0.125], [0, 0, 0.575]])
    gyroscope = dataclasses.replace(
        gyroscope, bias=MotionRate(np.array([0, 0, 0.02]), 0.05**2 * np.eye(3)), noise_rad2=3e-4
    )
    step = gyroscope.step(1)
    assert_allclose(step.mean, [0, 0, 0.575 - 0.04])
    assert_allclose(step.covariance, (0.05**2 * 4 + 3e-4 * 2 / 1.5) * np.eye(3))


def test_rates_of_a_step_lead_to_the_next_one():
    turn, duration_s = np.array([0.2, -0.3, 0.5]), 0.25
    before = transform(np.array([0.4, 0.1, 2.0]), np.array([1.0, 2, 3]))
    speed = np.array([6.0, 1, -1])
    pose = before @ transform(turn, rotation(0.5 * turn) @ speed * duration_s)
    covariance = spread(7, 6)
    rates = rates_of(before, Tracked(pose, covariance, 1.0, 0, turn), duration_s)
    turning, moving, _ = rates
    assert_allclose(turning.mean, turn / duration_s)
    assert_allclose(moving.mean, speed)
    R, half = before[:3, :3], before[:3, :3] @ rotation(0.5 * turn)
    assert_allclose(turning.covariance, R.T @ covariance[3:, 3:] @ R / duration_s**2)
    assert_allclose(moving.covariance, half.T @ covariance[:3, :3] @ half / duration_s**2)
    drive = Drive([np.zeros((0, 3))] * 3, np.array([0.0, 0.2, 0.5]), None)
    next_step = drive.predict(2, rates)
    rate = drive.turns.after(turning, 0.275)
    assert_allclose(next_step.turn.mean, 0.3 * rate.mean)
    assert_allclose(next_step.turn.covariance, 0.09 * rate.covariance)
    assert_allclose(next_step.begin_mps, speed)
    expected = (moving.covariance + 0.275 * np.diag(drive.moves.change)) * 0.09
    assert_allclose(next_step.translation_covariance, expected)
    assert drive.predict(1, Rates()).duration_s == 0.2
    assert drive.usual_turn_rad_s == pytest.approx(0.3)
    fast = dataclasses.replace(drive, velocities=velocities_of(np.tile([0, 25.0, 0], (3, 1)), np.eye(3)))
    assert fast.usual_turn_rad_s == pytest.approx(2 / 25)
    assert fast.usual_turn_rad_s < SLOW_TURN_RAD_S
    assert drive.usual_turn_rad_s >= SLOW_TURN_RAD_S


def test_a_gain_is_significant_by_students_t():
    gains, groups = np.array([1.0, 3, 4, 8, 0]), np.array([0, 0, 2, 2, 3])  # means of 2, 6 and 0
    verdict = Verdict.by_groups(gains, groups)
    assert (verdict.mean, verdict.count) == (pytest.approx(8 / 3), 3)
    assert verdict.error == pytest.approx(np.std([2, 6, 0], ddof=1) / np.sqrt(3))
    assert verdict.needed == pytest.approx(student.isf(1e-3, 2) * verdict.error)
    assert not verdict.improved
    assert Verdict(0.00101, 0.0, 9).improved
    assert not Verdict(0.00099, 0.0, 9).improved
    assert not Verdict(0.1, 0.0, 9, crowding=0.2).improved
    assert Verdict.by_groups(gains[:2], groups[:2]).needed == np.inf
    assert Gain.over(gains[:1], gains[None, 1:2]).significance[0] == 0  # a single pair is no evidence
    assert Verdict(0.5, 0.0, 2).improved
    assert "by +50.00%, by chance and overlap alone up to 0.10%" in Verdict(0.5, 0.0, 2).words


def test_standard_deviations_of_poses_become_settings_of_returns():
    covariance = np.stack([np.diag([1.0, 4, 4, 0.01, 0.01, 0.04])] * 3 + [np.eye(6)] * 2)
    assert pose_sigmas(covariance) == pytest.approx((np.sqrt(3), np.sqrt(0.02)))
    poses = np.tile(np.eye(4), (5, 1, 1))
    refined = RefinedPoses(poses, covariance, True, {"verdict": ""})
    posed = PosedScans.of(refined, poses)
    assert (posed.rows, posed.segments) == (slice(0, 5), 1)
    found = posed.config(FitConfig()).returns
    assert (found.pose_sigma_m, found.pose_sigma_rad) == pytest.approx((np.sqrt(3), np.sqrt(0.02)))
    for name in ("pose_sigma_m", "pose_sigma_rad"):
        stated = FitConfig(returns={name: 0.3})
        assert posed.config(stated) == stated
    assert PosedScans.of(dataclasses.replace(refined, improved=False), poses).sigmas is None
    assert dataclasses.replace(posed, sigmas=(0.1, 7.0)).config(FitConfig()).returns.pose_sigma_rad == 1.0


def test_motions_of_a_tracked_drive():
    poses = trajectory(5)
    rotation_vectors = np.stack([rotation_vector(step[:3, :3]) for step in between(poses[:-1], poses[1:])])
    drive = Drive([np.zeros((0, 3))] * 5, 0.5 * np.arange(5.0), None)
    (motion,) = drive.motions(poses, rotation_vectors, slice(0, 5))
    moves_m = step_vectors(poses)[:, :3]
    assert_allclose(motion.errors(poses)[:, :3], np.diff(moves_m, axis=0, prepend=0), atol=1e-12)
    assert_allclose(motion.shares[:, :3], np.array([[5.0**2], *[[2.0**2 * 0.5]] * 3]) * 0.5**2 * np.ones(3))
    assert np.isfinite(motion.shares).all()
    assert_allclose(motion.evidence().variances, [(0.5 * 5) ** 2, (0.5 * 0.3) ** 2])
    assert_allclose(motion.evidence().shares, 1)
    velocities = velocities_of(np.tile([10.0, 0, 0], (5, 1)), 0.01 * np.eye(3))
    gyroscope = Gyroscope(
        2 * rotation_vectors, np.full(4, 0.5), MotionRate(np.zeros(3), np.diag([1.0, 4, 9]) * 1e-4)
    )
    with_both = dataclasses.replace(drive, velocities=velocities, inertial=Inertial(gyroscope))
    turning, steady, moving = with_both.motions(poses[1:4], rotation_vectors[1:3], slice(1, 4))
    assert np.isinf(steady.shares).all()
    assert np.isinf(steady.evidence().shares).all()
    assert_allclose(turning.steps[:, :3, :3], rotation(2 * rotation_vectors[1:3]))
    assert_allclose(turning.bias_sigma, [0, 0, 0, 0.005, 0.01, 0.015])
    assert np.isinf(turning.shares[:, :3]).all()
    assert_allclose(turning.shares[:, 3:], 1)
    assert np.isinf(moving.shares[:, 3:]).all()
    _, by_pitch_m, by_yaw_m = 5 / 12 * (rotation_vectors[2] - rotation_vectors[1])
    bends_m2 = np.square([0.0, by_yaw_m, by_pitch_m])
    assert_allclose(moving.shares[0, :3], 0.01 * 2 * 0.25 / 4 + 0.5**3 / 12 + bends_m2)
    assert_allclose(moving.bias_sigma, [0.003 * 10 * 0.5] * 3 + [0] * 3)
    half = rotation(0.5 * rotation_vectors[1]), rotation(rotation_vectors[1])
    path = 0.5 / 6 * (np.eye(3) + 4 * half[0] + half[1]) @ [10.0, 0, 0]
    assert_allclose(moving.steps[0, :3, 3], path)


def test_gains_equal_a_brute_force_search():
    rng = np.random.default_rng(11)
    before = drifted(trajectory(4), 0.1, 0.01, 3)
    returns = SensorReturns.of([rng.normal(0, 3, (60, 3)) for _ in before], 0.1, None)
    held, used = returns.select(np.arange(240) % 5 == 0), returns.select(np.arange(240) % 5 > 0)
    noise = SensorNoise(0.3, 0.03, 0.04)
    others = held.scans[:, None] != used.scans
    of_held, of_used = (noise.mean_variances_m2(of.ranges_m) for of in (held, used))
    densities, counts = [], []
    edge_m = 0.5 * np.median(held.ranges_m)
    for poses in (before, trajectory(4)):
        a, b = (of.posed(poses).points.astype(np.float64) for of in (held, used))
        apart = np.linalg.norm(a[:, None] - b, axis=2)
        nearest = apart <= np.sort(apart, axis=1)[:, 15:16]
        if poses is before:
            first_m = np.median(np.where(others, apart, np.inf).min(axis=1))
        variance = of_held[:, None] + first_m**2 + of_used
        kernel = np.exp(-0.5 * apart**2 / variance) / variance**1.5
        densities.append(np.where(others & nearest, kernel, 0).sum(axis=1))
        same = (np.floor(a / edge_m)[:, None] == np.floor(b / edge_m)).all(axis=2)
        counts.append((same & others).sum(axis=1))
    gains = _gains(held, used, before, trajectory(4), noise)
    floor = np.median(densities[0])
    assert_allclose(gains, np.log((densities[1] + floor) / (densities[0] + floor)), atol=1e-4)
    floor = max(np.median(counts[0]), 1)
    expected = np.log((counts[1] + floor) / (counts[0] + floor))
    assert_allclose(_crowding(held, used, before, trajectory(4)), expected, atol=1e-9)
    assert np.ptp(expected) > 0.5


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, 3.1, 3.5, 9.0, -4.0])
def test_rotation_vectors_are_those_of_the_matrices(angle):
    vectors = angle * np.array([[1.0, 0, 0], [0, 0.6, -0.8], [0.48, 0.6, 0.64]])
    assert_allclose(rotation_vector(rotation(vectors), vectors + 0.3), vectors, atol=1e-9)
    least = rotation_vector(rotation(vectors))
    assert (np.linalg.norm(least, axis=1) <= np.pi).all()
    if abs(angle) < np.pi:
        assert_allclose(least, vectors, rtol=1e-9, atol=1e-15)


def test_errors_of_normals_are_left_out_as_by_the_reduction():
    half = np.random.default_rng(0).normal(size=(2, 6, 6))
    hessian, doubt = half[0] @ half[0].T + np.eye(6), 0.01 * half[1] @ half[1].T
    gradient = np.arange(6.0)
    M = reduction(hessian, doubt)
    found = _discount_tilts(hessian, gradient, doubt)
    assert_allclose(found[0], M @ hessian @ M.T, atol=1e-9)
    assert_allclose(found[1], M @ M @ gradient, atol=1e-9)
