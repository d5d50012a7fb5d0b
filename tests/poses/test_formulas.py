"""Covariances, derivatives and rates of motions, against random draws, finite differences and manual values."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf import FitConfig, RefinedPoses
from radarsdf.poses.agreement import (
    CLEAR,
    ERRORS,
    Gain,
    Verdict,
    _crowding,
    _gains,
    motion_significance,
    of_neighbours,
    sign_significance,
)
from radarsdf.poses.checked_scans import median_range_m
from radarsdf.poses.doppler import NoVelocityError, SensorVelocities, upright
from radarsdf.poses.imu import Gyroscope
from radarsdf.poses.motion import Motion, MotionRate, PredictedStep, spans_of, unsteadiness, way
from radarsdf.poses.odometry import PosedScans, pose_sigmas
from radarsdf.poses.planes import (
    PlaneMap,
    SensorReturns,
    _removed_share,
    apart_m,
    plane_cell_m,
    reduction,
    thin,
)
from radarsdf.poses.refine import _by_biases
from radarsdf.poses.rigid import (
    aligned,
    between,
    covariance_in,
    increments,
    moved,
    moved_by,
    nearest_rotation,
    rotation,
    rotation_vector,
    skew,
    step_vectors,
    transform,
    turned_by,
)
from radarsdf.poses.tracking import Drive, Tracked, begin_segment, rates_of, track_drive
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
    assert moved_by(first, shifted) == pytest.approx({"moved_m": 0.5, "moved_rad": 1.0})
    assert_allclose(turned_by(first, shifted), 1.0)
    a, b = np.random.default_rng(0).normal(size=(2, 4, 3))
    assert_allclose(np.einsum("nij,nj->ni", skew(a), b), np.cross(a, b))
    assert_allclose(apart_m(shifted, first, 2.0)[0], np.linalg.norm(increments(first, shifted)[0, :3]) + 2)
    covariance = spread(1, 6)
    R, both = whole[:3, :3], np.kron(np.eye(2), whole[:3, :3])
    assert_allclose(covariance_in(covariance[None], R)[0], both @ covariance @ both.T)
    assert_allclose(nearest_rotation(R + 1e-3 * np.diag([1, 2, 3])), R, atol=2e-3)
    assert np.linalg.det(nearest_rotation(-R)) == pytest.approx(1)


@pytest.mark.parametrize("angle", [0.5, 3.0, 3.5, 9.0, -4.0])
def test_rotation_vectors_of_more_than_half_a_turn(angle):
    vector = angle * np.array([0.6, 0, 0.8])
    found = rotation_vector(rotation(vector), vector + 0.3)
    assert_allclose(found, vector, atol=1e-9)
    assert np.linalg.norm(rotation_vector(rotation(vector))) <= np.pi


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
        slope = dataclasses.replace(motion, bias=by_one).prior(poses)[2] - motion.prior(poses)[2]
        assert_allclose(by[k], slope, atol=1e-9)
        spans2 = motion.spans**2 / motion.shares[:, axis]
        assert own[k] == pytest.approx(spans2.sum() * sigma[axis] ** 2 / [0.1**2, 0.02**2][axis // 3])


def test_spans_and_unsteady_steps():
    times_s = np.array([0.0, 1, 2, 2, 5])
    assert_allclose(spans_of(times_s, 5), [1, 1, 0.001, 3])  # two radars measure at once
    assert_array_equal(spans_of(None, 3), [1, 1])
    assert_array_equal(spans_of(np.zeros(3), 3), [1, 1])
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = [0, 1, 3, 4, 6]  # steps of 1 and 2 m
    assert unsteadiness(poses, None) == pytest.approx((np.sqrt(1 / 2 / 3), 0))
    assert unsteadiness(poses, np.array([0.0, 1, 3, 4, 6])) == pytest.approx((0, 0))
    assert unsteadiness(poses[:2], None) == (0, 0)
    assert unsteadiness(poses[:3], None)[0] > 0


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
    assert (
        abs(sign_significance(scans[:2], found.select(slice(0, 2)), times_s[:2])[0]) < CLEAR
    )  # unrelated scans
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
    turning, moving = rates_of(before, Tracked(pose, covariance, 1.0, 0, turn), duration_s)
    assert_allclose(turning.mean, turn / duration_s)
    assert_allclose(moving.mean, speed)
    R, half = before[:3, :3], before[:3, :3] @ rotation(0.5 * turn)
    assert_allclose(turning.covariance, R.T @ covariance[3:, 3:] @ R / duration_s**2)
    assert_allclose(moving.covariance, half.T @ covariance[:3, :3] @ half / duration_s**2)
    drive = Drive([np.zeros((0, 3))] * 3, np.array([0.0, 0.2, 0.5]), None, None)
    next_step = drive.predict(2, turning, moving)
    rate = drive.turns.after(turning, 0.25)
    assert_allclose(next_step.turn.mean, 0.3 * rate.mean)
    assert_allclose(next_step.turn.covariance, 0.09 * rate.covariance)
    assert_allclose(next_step.begin_mps, speed)
    expected = (moving.covariance + 0.25 * np.diag(drive.moves.change)) * 0.09
    assert_allclose(next_step.translation_covariance, expected)
    assert drive.predict(1, None, None).duration_s == 0.2
    assert drive.usual_turn_rad_s == pytest.approx(0.3)
    fast = dataclasses.replace(drive, velocities=velocities_of(np.tile([0, 25.0, 0], (3, 1)), np.eye(3)))
    assert fast.usual_turn_rad_s == pytest.approx(2 / 25)
    assert fast.turns_slowly
    assert not drive.turns_slowly


def test_a_gyroscope_learns_from_turns_with_the_covariance_of_their_rates(monkeypatch):
    rate, asked = MotionRate(np.array([0.1, -0.2, 0.3]), spread(12, 3)), []
    passed = [begin_segment(np.eye(4))] * 3, [(rate, rate), (None, None)]
    monkeypatch.setattr("radarsdf.poses.tracking.track_once", lambda *_: passed)
    gyroscope = SimpleNamespace(learnt=asked.append)
    track_drive(Drive([np.eye(3)] * 3, np.array([0, 0.5, 0.7]), None, gyroscope), FitConfig(), 1, False)
    assert asked == [[rate, None]]


def test_returns_reduce_and_errors_increase_covariances():
    prior, left = np.diag([4.0, 4, 4]), np.diag([1.0, 3, 0.4])
    assert _removed_share(prior, left) == pytest.approx(0.25)
    assert _removed_share(prior, 5 * prior) == 0
    total, part = np.diag([4.0, 9, 25]), np.diag([1.0, 9, 30])
    turned = rotation(np.array([0.3, 1.0, -0.4]))
    total, part = (turned @ m @ turned.T for m in (total, part))
    M = reduction(total, part)
    assert_allclose(M @ total @ M.T, turned @ np.diag([3.0, 0, 0]) @ turned.T, atol=1e-6)
    assert begin_segment(np.eye(4), 3).segment == 3
    assert np.isnan(begin_segment(np.eye(4)).agreeing)
    assert [len(thin(np.zeros((n, 3)), 10)) for n in (0, 10, 11, 20, 21)] == [0, 10, 6, 10, 7]


def test_returns_are_selected_by_range_and_cells_match_their_spacing():
    line = np.outer([0.0, 1, 2, 3, 4], [0.6, 0, 0.8])
    returns = SensorReturns.of([line, line[:3], line[4:]], 1.0, 3.0)
    assert returns.scans.tolist() == [0, 0, 0, 1, 1]
    assert_allclose(returns.ranges_m, [1, 2, 3, 1, 2])
    assert_allclose(returns.directions, np.tile([0.6, 0, 0.8], (5, 1)), rtol=1e-6)
    assert SensorReturns.of([line], 0.0, None).ranges_m.tolist() == pytest.approx([1, 2, 3, 4])
    assert returns.every(2).ranges_m.tolist() == pytest.approx([1, 3, 2])
    poses = np.stack([np.eye(4), transform(np.array([0, 0, np.pi / 2]), np.array([4.0, 0, 0])), np.eye(4)])
    rays = returns.posed(poses)
    assert_allclose(rays.points + rays.origin, [*line[1:4], [4, 0.6, 0.8], [4, 1.2, 1.6]], atol=1e-6)
    assert plane_cell_m([4 * line, line[:1], 4 * line], 0.2) == pytest.approx(1.0)
    assert plane_cell_m([line, line[:1]], 0.2) == pytest.approx(0.4)
    assert plane_cell_m([line[:1]], 0.2) == pytest.approx(0.4)
    assert median_range_m([line, line[:0]]) == pytest.approx(2)
    assert median_range_m([line[:0]]) == 0


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


def test_common_errors_of_steps_equal_the_joint_inverse():
    """Joint inverse of poses and biases, with a prior deviation of one."""
    hessian, by = spread(8, 12) + 3 * np.eye(12), np.random.default_rng(9).normal(0, 0.3, (2, 12))
    gradient, own = np.ones(12), np.array([3.0, 5])
    motions = [SimpleNamespace(by_bias=lambda _, k=k: (by[[k]].reshape(1, 2, 6), own[[k]])) for k in (0, 1)]

    def solved(more):
        return -np.linalg.solve(hessian, gradient + np.ravel(more)).reshape(2, 6)

    found = _by_biases(motions, np.zeros((2, 4, 4)), solved)
    whole = np.linalg.inv(np.block([[hessian, by.T], [by, np.diag(own + 1)]]))[:12, :12]
    added = whole - np.linalg.inv(hessian)
    assert_allclose(found, [added[:6, :6], added[6:, 6:]], atol=1e-12)


def test_motions_of_a_tracked_drive():
    poses = trajectory(5)
    rotation_vectors = np.stack([rotation_vector(step[:3, :3]) for step in between(poses[:-1], poses[1:])])
    tracked = [begin_segment(poses[0])] + [
        Tracked(p, np.eye(6), 1.0, 0, t) for p, t in zip(poses[1:], rotation_vectors, strict=True)
    ]
    drive = Drive([np.zeros((0, 3))] * 5, 0.5 * np.arange(5.0), None, None)
    (motion,) = drive.motions(tracked, slice(0, 5))
    rates = step_vectors(poses) / 0.5
    middle, variance = drive.moves.conditional(rates[:, :3], np.full(4, 0.5))
    off, expected = motion.errors(poses)[:, :3], 0.5 * (rates[:, :3] - middle)
    assert_allclose(off / motion.shares[:, :3], expected / (0.25 * variance), atol=1e-12)
    assert_allclose(off, expected / 2, atol=1e-12)
    assert np.isfinite(motion.shares).all()
    assert_allclose(motion.evidence().variances, [(0.5 * 5) ** 2, (0.5 * 0.3) ** 2])
    assert_allclose(motion.evidence().shares, 1)
    velocities = velocities_of(np.tile([10.0, 0, 0], (5, 1)), 0.01 * np.eye(3))
    gyroscope = Gyroscope(
        2 * rotation_vectors, np.full(4, 0.5), MotionRate(np.zeros(3), np.diag([1.0, 4, 9]) * 1e-4)
    )
    with_both = dataclasses.replace(drive, velocities=velocities, gyroscope=gyroscope)
    turning, steady, moving = with_both.motions(tracked, slice(1, 4))
    assert np.isinf(steady.shares).all()
    assert np.isinf(steady.evidence().shares).all()
    assert_allclose(turning.steps[:, :3, :3], rotation(2 * rotation_vectors[1:3]))
    assert_allclose(turning.bias_sigma, [0, 0, 0, 0.005, 0.01, 0.015])
    assert np.isinf(turning.shares[:, :3]).all()
    assert_allclose(turning.shares[:, 3:], 1)
    assert np.isinf(moving.shares[:, 3:]).all()
    assert_allclose(moving.shares[:, :3], 0.01 * 2 * 0.25 / 4 + 0.5**3 / 12)
    assert_allclose(moving.bias_sigma, [0.003 * 10 * 0.5] * 3 + [0] * 3)
    half = rotation(0.5 * rotation_vectors[1]), rotation(rotation_vectors[1])
    path = 0.5 / 6 * (np.eye(3) + 4 * half[0] + half[1]) @ [10.0, 0, 0]
    assert_allclose(moving.steps[0, :3, 3], path)


def test_information_independent_of_the_pose_is_subtracted():
    """Of 100 along x at the pose and 40 on average near it, 60 remain."""
    planes = PlaneMap(0.4)
    asked = []

    def agreement(_, pose, __):
        asked.append(pose[0, 3])
        along = {5: 100.0, 5.8: 70, 4.2: 30, 6.6: 50, 3.4: 10}[round(pose[0, 3], 6)]
        return np.diag([along, 1e6, 1e6, 1e6, 1e6, 1e6]), np.zeros(6), np.zeros((6, 6)), 1.0

    planes.fine = SimpleNamespace(agreement=agreement)
    prior, pose = np.eye(6), transform(np.zeros(3), np.array([5.0, 0, 0]))
    covariance = np.diag([1 / 101] + [1e-6] * 5)
    found = planes._discount_chance(None, pose, prior, covariance)
    assert_allclose(found, np.diag([1 / 61] + [1e-6] * 5), rtol=1e-9)
    assert len(asked) == 5
    sure = (0.05 * 0.8) ** 2 * 0.99  # in cells of 0.8 m, this needs no returns
    assert planes._discount_chance(None, pose, sure * prior, covariance) is covariance


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


def test_the_displacement_between_scans_is_found_and_common_patterns_cancel():
    rng = np.random.default_rng(3)
    world, wall = (
        rng.uniform(-20, 20, (300, 3)),
        np.column_stack([rng.uniform(-20, 20, (2, 400)).T, np.zeros(400)]),
    )
    moved_m = np.array([1.0, 0.5, 0.2])
    scales = np.array([0.5, 0.8, 1.0, 1.25])

    def gains(first, second, moved_m):
        steps = transform(np.zeros((8, 3)), np.outer([*-scales, *scales], moved_m))
        logs = of_neighbours([first, second]).log_distances(1, 0, steps).mean(axis=1)
        return np.subtract(*np.split(logs, 2))

    assert gains(world, world - moved_m, moved_m).argmax() == 2
    # Two views of a wall along the motion agree equally for either direction.
    along = gains(wall[::2], wall[1::2], [1.0, 0, 0])
    assert np.abs(along).max() < 0.05 * gains(world, world - moved_m, moved_m).max()


def test_one_pair_of_scans_of_a_turning_sensor_shows_the_sign_of_the_doppler():
    rng = np.random.default_rng(4)
    world, times_s = rng.uniform(-20, 20, (300, 3)), np.array([0.0, 0.1])
    velocity = np.array([[20.0, 1.0, 0.0]] * 2)
    velocities = SensorVelocities(velocity, np.tile(np.eye(3), (2, 1, 1)), np.ones(3), np.ones(2, bool))
    turn = rotation(np.array([0.0, 0.0, 0.2]))
    scans = [world, (world - 0.1 * velocity[0]) @ turn]
    for sign in (1, -1):
        significance, yaws = sign_significance(scans, velocities.scaled(sign), times_s)
        assert sign * significance > CLEAR
        assert_allclose(yaws[int(sign < 0)], 0.2, atol=0.04)


def test_scans_of_walls_along_the_motion_agree_best_without_it():
    rng = np.random.default_rng(5)
    motion, firsts = np.eye(4), np.arange(11)
    motion[0, 3] = 1.0
    motions = np.tile(motion, (11, 1, 1))
    walls = [np.column_stack([rng.uniform(-10, 10, 300), np.repeat([-2.0, 2.0], 150), np.zeros(300)])] * 12
    assert motion_significance(walls, firsts, motions) < -ERRORS  # the same clutter in each scan
    world = rng.uniform(-20, 20, (500, 3))
    scans = [world - i * motion[:3, 3] for i in range(12)]
    assert motion_significance(scans, firsts, motions) > ERRORS
    assert motion_significance([world, world], firsts[:1], motions[:1]) == 0  # too few
