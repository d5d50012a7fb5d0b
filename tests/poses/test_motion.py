"""The motion prior, and measured motions."""

import dataclasses
import itertools

import numpy as np
import pytest
from radarsdf.poses.doppler import DopplerMotion, SensorVelocities
from radarsdf.poses.motion import Motion, MotionPrior, MotionRate, SteadyMotion
from radarsdf.poses.rigid import moved, steps, transform
from radarsdf.simulate import drifted

from .drift import trajectory


@pytest.mark.parametrize("times", [[0.0, 1, 2, 3, 4, 5], [0.0, 1, 2, 3, 8, 9]])
def test_the_prior_has_the_derivatives_of_its_cost(times):
    given = trajectory(6)
    motion = Motion.of(given, 0.1, 0.02, np.array(times))
    motion = dataclasses.replace(motion, bias=np.array([0.01, 0, 0, 0, 0, 0.01]))
    poses = drifted(given, 1e-3, 1e-3, 2)

    def cost(increments):
        errors = motion.errors(moved(poses, increments)) - motion.bias * motion.spans[:, None]
        return 0.5 * (errors**2 / np.repeat([0.1**2, 0.02**2], 3) / motion.spans[:, None]).sum()

    band, gradient = motion.prior(poses)
    h = 1e-5
    for s, a in [(0, 0), (2, 4), (3, 5), (5, 2)]:
        step = np.zeros((6, 6))
        step[s, a] = h
        slope = (cost(step) - cost(-step)) / (2 * h)
        assert slope == pytest.approx(gradient[s, a], rel=5e-3, abs=0.05)
        curvature = (cost(step) - 2 * cost(0 * step) + cost(-step)) / h**2
        assert curvature == pytest.approx(band[s, -1, a, a], rel=0.02)
    one, other = np.zeros((2, 6, 6))
    one[3, 1], other[2, 1] = h, h
    crossed = (cost(one + other) - cost(one - other) - cost(other - one) + cost(-one - other)) / (4 * h**2)
    assert crossed == pytest.approx(band[3, 0, 1, 1], rel=0.02)


def test_standard_deviations_and_bias_are_estimated_from_known_poses():
    true = trajectory(400)
    given = drifted(true, 0.03, 0.004, 3, yaw_rad=0.01)
    nothing = np.zeros((400, 6, 6)), np.zeros((399, 6, 6))
    learnt = Motion.of(given, 0.1, 0.01, np.arange(len(given))).updated(true, true, *nothing)
    assert np.sqrt(learnt.variances[0]) == pytest.approx(0.03, rel=0.1)
    assert np.sqrt(learnt.variances[1]) == pytest.approx(0.004, rel=0.1)
    assert learnt.bias[5] == pytest.approx(-0.01, abs=5e-4)


TURNS = MotionPrior(np.array([0.1, 0.2, 0.3]), np.array([0.05, 0.1, 0.15]), True)
MOVES = MotionPrior(np.array([20.0, 10.0, 5.0]), np.array([2.0, 1.0, 0.5]), False)


def test_two_radars_that_measure_at_once_do_not_slow_the_steps_around():
    times_s = np.array([0.0, 0.0, 0.1, 0.15, 0.15, 0.2, 0.3, 0.3])
    poses = transform(np.outer(times_s, [0.0, 0.0, 1.0]), np.outer(times_s, [0.0, 0.0, 2.0]))
    prior = MotionPrior(np.full(3, 1e6), np.ones(3), True)
    motion = SteadyMotion.by((prior, prior), np.ones(2), times_s, poses, np.zeros(6, bool))
    assert abs(motion.errors(poses)[2:]).max() < 1e-4  # the first rate is unknown


@pytest.mark.parametrize("habits", [TURNS, MOVES], ids=["turns", "moves"])
def test_the_changes_of_steps_have_the_density_of_the_motion_prior(habits):
    times_s = np.array([0.0, 0.1, 0.4, 0.6, 1.1])
    durations_s, count = np.diff(times_s), len(times_s)
    poses = np.tile(np.eye(4), (count, 1, 1))
    motion = SteadyMotion.by((habits, habits), np.ones(2), times_s, poses, np.zeros(6, bool))
    band, gradient = motion.prior(poses)
    whole = np.zeros((count, 6, count, 6))
    for s, other in itertools.product(range(count), repeat=2):
        if 0 <= s - other < band.shape[1]:
            whole[s, :, other] = band[s, other - s + band.shape[1] - 1]
            whole[other, :, s] = whole[s, :, other].T
    assert not gradient.any()
    ends = np.tril(np.ones((count, count - 1)), -1) * durations_s  # poses by rates
    for axis in range(6):
        usual, change = habits.usual[axis % 3], habits.change[axis % 3]
        prior = MotionPrior(np.full(3, usual), np.full(3, change), habits.settles)
        joint = np.full((1, 1), usual)  # covariance of the rates, step by step
        for before_s, after_s in itertools.pairwise(durations_s):
            known, unknown = (
                prior.after(MotionRate(np.ones(3), c * np.eye(3)), (before_s + after_s) / 2)
                for c in (0.0, 1.0)
            )
            share, added = known.mean[0], known.covariance[0, 0]
            np.testing.assert_allclose(unknown.covariance[0, 0], share**2 + added)
            row = share * joint[-1]
            joint = np.block([[joint, row[:, None]], [row, share**2 * joint[-1, -1] + added]])
        information = ends.T @ whole[:, axis, :, axis] @ ends
        np.testing.assert_allclose(information, np.linalg.inv(joint), atol=1e-9 * information.max())


RATE = MotionRate(np.array([0.3, -0.2, 0.1]), np.diag([0.01, 0.02, 0.03]))


def test_predicted_turn_rates_decay_to_the_mean_and_velocities_persist():
    late = TURNS.after(RATE, 1e3)
    np.testing.assert_allclose(late.mean, 0, atol=1e-9)
    np.testing.assert_allclose(late.covariance, np.diag(TURNS.usual))
    np.testing.assert_array_equal(MOVES.after(RATE, 1e3).mean, RATE.mean)
    np.testing.assert_allclose(MOVES.after(RATE, 2.0).covariance, RATE.covariance + 2 * np.diag(MOVES.change))


@pytest.mark.parametrize("habits", [TURNS, MOVES], ids=["turns", "moves"])
def test_the_motion_prior_is_estimated_from_a_drive(habits):
    rng = np.random.default_rng(0)
    durations_s = rng.choice([0.05, 0.15], 8000)
    rates = [MotionRate(np.sqrt(habits.usual) * rng.normal(size=3), np.zeros((3, 3)))]
    for before_s, after_s in itertools.pairwise(durations_s):
        observed = habits.after(rates[-1], (before_s + after_s) / 2)
        noise = np.sqrt(np.diag(observed.covariance)) * rng.normal(size=3)
        rates.append(MotionRate(observed.mean + noise, np.zeros((3, 3))))
    usual = np.square([rate.mean for rate in rates]).mean(axis=0)
    rates[4000:4002] = None, None  # tracking was lost there
    first = MotionPrior(np.full(3, 1.0), np.full(3, 1.0), habits.settles)
    found = first.learnt(rates, durations_s)
    np.testing.assert_allclose(found.usual, usual, rtol=0.02)
    # Mean of 8000 squares; turn rates decay within 4 s, so that their changes in 0.1 s are 2.5 % smaller.
    np.testing.assert_allclose(found.change, habits.change, rtol=4 * np.sqrt(2 / 8000) + 0.025)
    assert first.learnt([None, None], durations_s[:2]) == first


def test_errors_of_rates_are_part_of_the_motion_prior():
    """Rates damped by half have errors of three quarters of the variance: without these, a sensor would seem steady."""
    rng = np.random.default_rng(1)
    damped = [MotionRate(0.5 * rates, 0.75 * np.eye(3)) for rates in rng.normal(size=(2000, 3))]
    found = MotionPrior(np.ones(3), np.ones(3), True).learnt(damped, np.ones(2000), with_errors=True)
    np.testing.assert_allclose(found.usual, 1.0, rtol=0.1)
    np.testing.assert_allclose(found.change, 2.0, rtol=0.1)


def test_steps_by_doppler_are_uncertain_where_the_turn_rate_changes():
    """Regression: a car park in steps of 5 m had errors across of 19 mm, 6 times their deviations."""
    fine_s = np.linspace(0, 4, 4001)
    yaws = 0.3 * np.sin(2 * fine_s)
    way_m = np.cumsum(5.0 * np.stack([np.cos(yaws), np.sin(yaws), 0 * yaws], axis=1), axis=0) * 0.001
    at = slice(0, None, 250)
    o = 0 * yaws[at]
    poses = transform(np.column_stack([o, o, yaws[at]]), way_m[at])
    mean = np.tile([5.0, 0.0, 0.0], (len(poses), 1))
    velocities = SensorVelocities(
        mean, np.tile(1e-6 * np.eye(3), (len(poses), 1, 1)), np.full(3, 1e-6), o == 0
    )
    motion = DopplerMotion.by(velocities, fine_s[at], poses)
    across_m = motion.steps[:, 1, 3] - steps(poses)[:, 1, 3]
    assert 0.5 < np.sqrt(np.mean(across_m**2 / motion.shares[:, 1])) < 1.5
