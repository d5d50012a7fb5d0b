"""Sensor velocity from Doppler, against the ground truth of a simulation and the flags of recorded drives."""

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.doppler import check_doppler, velocity_of_poses
from radarsdf.checking.recording import checked_input
from radarsdf.returns.moving import folding_interval_mps, sensor_velocity

STEP_S = 0.1
VELOCITY_MPS = np.array([7.0, 0.4, -0.2])


def directions(count, seed=0):
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-1, 1, count), rng.uniform(-0.3, 0.3, count)
    return np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1
    )


def one_scan(moving=0.3, sigma=0.08, count=2000):
    """Points, Doppler, and mask of moving returns."""
    rng = np.random.default_rng(1)
    points = directions(count) * rng.uniform(3, 60, (count, 1))
    doppler = -directions(count) @ VELOCITY_MPS + rng.normal(0, sigma, count)
    moves = rng.random(count) < moving
    doppler[moves] += rng.uniform(1, 8, moves.sum()) * rng.choice([-1, 1], moves.sum())
    return points, doppler, moves


@pytest.fixture(scope="module")
def drive():
    """Scans along a turn, with Doppler from their poses and a tenth of the returns moving."""
    every = radarsdf.simulate.wall(frames=90)
    # Varying speed: otherwise clock offsets are unobservable.
    chosen = np.cumsum(np.round(2 + 1.2 * np.sin(np.arange(40) / 4)).astype(int))
    chosen = chosen[chosen < 90]
    points, poses = [every.points[i] for i in chosen], every.poses[chosen]
    rng = np.random.default_rng(2)
    times = STEP_S * np.arange(len(chosen))
    velocities = velocity_of_poses(poses, times)
    doppler = []
    for scan, velocity in zip(points, velocities, strict=True):
        away = scan / np.linalg.norm(scan, axis=1, keepdims=True)
        speeds = -away @ velocity + rng.normal(0, 0.05, len(scan))
        moves = rng.random(len(scan)) < 0.1
        doppler.append((speeds + np.where(moves, 3.0, 0.0)).astype(np.float32))
    return points, poses, doppler, times


def named(findings):
    return {finding.name: finding.severity for finding in findings}


def test_the_covariance_matches_the_errors():
    points = directions(300, seed=3)
    errors, sigmas = [], []
    for seed in range(60):
        doppler = -points @ VELOCITY_MPS + np.random.default_rng(seed).normal(0, 0.04, len(points))
        found = sensor_velocity(points, doppler)
        errors.append(found.velocity_mps - VELOCITY_MPS)
        sigmas.append(np.diag(found.covariance))
    ratio = np.mean(np.square(errors), axis=0) / np.mean(sigmas, axis=0)
    # A mean of 60 squares has an error of 20 %, and the cut at three deviations reduces it by a few per cent.
    assert ((ratio > 0.5) & (ratio < 1.8)).all()


def test_folded_speeds_are_unfolded():
    points, doppler, moves = one_scan(moving=0.1)
    folded = (doppler + 5) % 10 - 5
    found = sensor_velocity(points, folded, interval_mps=10.0)
    assert np.linalg.norm(found.velocity_mps - VELOCITY_MPS) < 0.05
    assert found.static[~moves].mean() > 0.95
    assert folding_interval_mps([folded]) == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize(
    "doppler",
    [np.random.default_rng(5).uniform(-20, 20, 500), np.full(500, np.nan)],
    ids=["random", "not finite"],
)
def test_inconsistent_speeds_have_no_velocity(doppler):
    found = sensor_velocity(directions(500), doppler)
    assert not found.found
    assert not found.static.any()


@pytest.mark.usefixtures("right_frames")
def test_good_doppler_reports_only_moving_returns(drive):
    points, poses, doppler, times = drive
    found = radarsdf.check(points, poses, doppler_mps=doppler, times_s=times)
    assert set(named(found).values()) == {"note"}
    moving = next(finding for finding in found if finding.name == "moving_share")
    share = float(moving.evidence.split("%")[0].split()[-1])
    assert 9 < share < 12


def test_a_turned_sensor_is_named(drive):
    points, poses, doppler, times = drive
    turn = np.array([[np.cos(0.12), -np.sin(0.12), 0], [np.sin(0.12), np.cos(0.12), 0], [0, 0, 1]])
    turned = [(scan @ turn.T).astype(np.float32) for scan in points]
    found = check_doppler(checked_input(turned, poses, doppler_mps=doppler, times_s=times))
    (evidence,) = (finding.evidence for finding in found if finding.name == "sensor_turned")
    assert float(evidence.split()[3]) == pytest.approx(-np.degrees(0.12), abs=0.5)  # to the left


@pytest.mark.parametrize(
    ("scans", "moving", "expected"),
    [(4, 0.35, ("moving_share", "note")), (4, 0.5, ("moving_share", "warning")), (3, 0.35, None),
     (4, 0.9, ("doppler_without_velocity", "warning")), (3, 0.9, None)],
)  # fmt: skip
def test_scans_with_many_moving_returns_are_named(scans, moving, expected):
    points, doppler, _ = one_scan(moving=moving, count=600)
    poses = np.tile(np.eye(4), (scans, 1, 1))
    found = list(check_doppler(checked_input([points] * scans, poses, doppler_mps=[doppler] * scans)))
    assert [(finding.name, finding.severity) for finding in found] == ([expected] if expected else [])
    if expected and moving == 0.9:
        assert found[0].evidence.startswith(f"In {scans} of {scans} scans")


def test_the_velocity_of_poses_is_the_derivative_of_their_curve():
    """On a circle of 5 m radius at 0.5 rad/s, 2.5 m/s ahead."""
    times_s = np.array([0.0, 0.1, 0.3, 0.4, 0.5])
    poses, yaws = np.tile(np.eye(4), (5, 1, 1)), 0.5 * times_s
    poses[:, :2, 3] = 5 * np.stack([np.sin(yaws), -np.cos(yaws)], 1)
    poses[:, :2, :2] = np.array([[np.cos(yaws), -np.sin(yaws)], [np.sin(yaws), np.cos(yaws)]]).transpose(
        2, 0, 1
    )
    np.testing.assert_allclose(velocity_of_poses(poses, times_s), np.tile([2.5, 0, 0], (5, 1)), atol=2e-3)


def test_doppler_that_contradicts_poses_or_intensities_is_named(drive):
    points, poses, doppler, times = drive
    power = [100 - 20 * np.log10(np.linalg.norm(scan, axis=1)) for scan in points]
    for finding, severity, intensities, speeds in (
        ("doppler_sign", "note", None, [-d for d in doppler]),
        ("intensity_is_doppler", "error", doppler, None),
        ("doppler_without_velocity", "warning", None, power),
    ):
        found = check_doppler(checked_input(points, poses, intensities, speeds, times))
        assert named(found).get(finding) == severity
