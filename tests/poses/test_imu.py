"""Rotation of an IMU on a radar, up direction, and clock offset, estimated from the drive."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf.io import UNPOSED, Imu
from radarsdf.poses.imu import (
    Gyroscope,
    ImuAlignment,
    Inertial,
    UnusableGyroscopeError,
    cumulate_turns,
    level_poses,
)
from radarsdf.poses.motion import MotionRate
from radarsdf.simulate import measured_imu
from scipy.spatial.transform import Rotation

from ..conftest import recorded_file
from .drift import velocities_of

R_SENSOR_IMU = Rotation.from_euler("ZYX", [130, -40, 75], degrees=True).as_matrix()
LATE_S = 0.07
LEVER_M = (0.2, -0.1, 0.3)


def speeds_at(t):
    """(F, 3) of the ride, world, m/s."""
    return np.column_stack([1.5 * np.cos(0.5 * t), -0.8 * np.sin(0.4 * t), 0.27 * np.cos(0.9 * t)])


@pytest.fixture(scope="module")
def ride():
    """A walk of 30 s with turns, tilts and climbs."""
    t = np.arange(300) * 0.1
    xyz = np.column_stack([3 * np.sin(0.5 * t), 2 * np.cos(0.4 * t), 0.3 * np.sin(0.9 * t)])
    turns = np.column_stack([1.5 * np.sin(0.5 * t), 0.3 * np.sin(1.1 * t), 0.3 * np.cos(1.3 * t)])
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", turns).as_matrix()
    poses[:, :3, 3] = xyz
    seen = np.einsum("fji,fj->fi", poses[:, :3, :3], speeds_at(t))
    seen += np.random.default_rng(1).normal(0, 1, seen.shape) * [0.02, 0.02, 0.04]
    return t, poses, velocities_of(seen, np.diag([0.02, 0.02, 0.04]) ** 2)


@pytest.fixture(scope="module")
def imu(ride):
    times_s, poses, _ = ride
    return measured_imu(poses, times_s, R_sensor_imu=R_SENSOR_IMU, lever_m=LEVER_M)


def angle(one, other):
    """Degrees between two rotations."""
    return float(np.degrees(Rotation.from_matrix(one @ other.T).magnitude()))


def tilt(poses, up):
    """Largest error of `up`, degrees."""
    z = np.einsum("fij,fj->fi", poses[:, :3, :3], up)[:, 2]
    return float(np.degrees(np.arccos(np.clip(z, -1, 1))).max())


def test_velocities_determine_its_rotation(ride, imu):
    times_s, poses, velocities = ride
    found = ImuAlignment.of(imu, velocities, times_s + LATE_S)
    assert angle(found.R_sensor_imu, R_SENSOR_IMU) < min(3, 3 * np.degrees(found.sigma_rad))
    assert found.time_offset_s == pytest.approx(LATE_S, abs=0.01)
    np.testing.assert_allclose(found.lever_m, LEVER_M, atol=0.1)
    assert tilt(poses, found.up) < 1.5
    # Rates without bias lead to the last pose.
    end = poses[0, :3, :3] @ cumulate_turns(found.gyroscope.turns)[-1]
    assert angle(end, poses[-1, :3, :3]) < 3


@pytest.mark.parametrize("late_s", [LATE_S, -0.3])
def test_without_noise_it_is_exact(ride, monkeypatch, late_s):
    times_s, poses, _ = ride
    for name in ("_GYROSCOPE_SIGMA_RAD_S", "_ACCELEROMETER_SIGMA_MPS2"):
        monkeypatch.setattr(f"radarsdf.simulate.motion.{name}", 0)
    seen = np.einsum("fji,fj->fi", poses[:, :3, :3], speeds_at(times_s))
    imu = measured_imu(poses, times_s, R_sensor_imu=R_SENSOR_IMU, lever_m=LEVER_M)
    found = Inertial.of(imu, velocities_of(seen, 1e-6 * np.eye(3)), times_s + late_s, 0.0)
    report = found.alignment.report
    assert angle(np.array(report["R_sensor_imu"]), R_SENSOR_IMU) < 1e-2
    assert report["time_offset_s"] == pytest.approx(late_s, abs=1e-4)
    np.testing.assert_allclose(report["lever_m"], LEVER_M, atol=1e-3)
    assert tilt(poses, found.alignment.up) < 1e-2
    turns = cumulate_turns(found.gyroscope.turns)
    assert max(angle(poses[0, :3, :3] @ turns[i], poses[i, :3, :3]) for i in (100, -1)) < 1e-2
    late = f"scans are {late_s:.3f} s late in its clock"
    assert f"found to {np.degrees(report['sigma_rad']):.1f} degrees, {late}" in found.alignment.words


@pytest.mark.parametrize(
    ("rate_rad_s", "speed_mps", "is_used"),
    [(5.9, 0, True), (6.1, 0, False), (2, 14.9, True), (2, 15.1, False)],
)
def test_implausible_rates_are_not_used(rate_rad_s, speed_mps, is_used):
    times_s = np.arange(5.0)
    rates = rate_rad_s * np.array([[0.6, 0, 0.8]] * 3 + [[0, 0, 0]] * 2)
    means = np.tile([0.6 * speed_mps, 0.8 * speed_mps, 0], (5, 1))
    imu = Imu(times_s, rates, R_sensor_imu=np.eye(3))
    found = Inertial.of(imu, velocities_of(means, np.eye(3)), times_s, 0.0)
    assert (found.gyroscope is not None) == is_used
    if not is_used:
        across = f"{rate_rad_s:.3g} rad/s, {rate_rad_s * speed_mps:.0f} m/s² across the trajectory"
        assert across in found.notes[0]


def test_given_axes_are_kept(ride, imu):
    times_s, poses, velocities = ride
    given = dataclasses.replace(imu, R_sensor_imu=R_SENSOR_IMU)
    found = ImuAlignment.of(given, velocities, times_s)
    np.testing.assert_array_equal(found.R_sensor_imu, given.R_sensor_imu)
    assert found.sigma_rad == 0
    assert abs(found.time_offset_s) < 0.01
    assert tilt(poses, found.up) < 1.5


def test_an_imu_of_another_motion_is_not_used(ride, imu):
    times_s, _, velocities = ride
    for other in (
        dataclasses.replace(
            imu, angular_velocity=imu.angular_velocity[::-1], specific_force=imu.specific_force[::-1]
        ),
        dataclasses.replace(imu, specific_force=imu.specific_force + np.sin(3 * imu.times_s)[:, None]),
    ):
        assert ImuAlignment.of(other, velocities, times_s) is None


def test_straight_motion_leaves_the_rotation_undetermined():
    times_s = np.arange(200) * 0.1
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = times_s
    rng = np.random.default_rng(2)
    velocities = velocities_of([1, 0, 0] + rng.normal(0, 0.02, (200, 3)), 0.02**2 * np.eye(3))
    assert ImuAlignment.of(measured_imu(poses, times_s), velocities, times_s) is None


def test_an_unobservable_rotation_is_requested_from_the_user(ride, imu):
    times_s, _, velocities = ride
    found = Inertial.of(dataclasses.replace(imu, specific_force=None), velocities, times_s, 0.0)
    assert found.gyroscope is None
    assert "give R_sensor_imu" in found.notes[0]


def test_a_bias_is_estimated_from_rotations(ride):
    times_s, poses, _ = ride
    steps = Rotation.from_matrix(poses[:-1, :3, :3]).inv() * Rotation.from_matrix(poses[1:, :3, :3])
    turns = steps.as_rotvec() + np.random.default_rng(3).normal(0, 0.005, (len(steps), 3))
    shown = [MotionRate(10 * turn, 0.05**2 * np.eye(3)) for turn in turns]
    bias = np.array([0.01, -0.02, 0.015])
    rates = measured_imu(poses, times_s, gyroscope_bias_rad_s=tuple(bias))
    found = Gyroscope.of(rates.angular_velocity, rates.times_s, times_s).learnt(shown)
    off = np.degrees(np.linalg.norm(found.turns - found.bias.mean * 0.1 - steps.as_rotvec(), axis=1))
    assert np.median(off) < 0.1
    # Three deviations of the mean of 299 rotations in 0.1 s, each with an error of 0.005 rad.
    np.testing.assert_allclose(found.bias.mean, bias, atol=3 * 0.05 / np.sqrt(299))
    with pytest.raises(UnusableGyroscopeError):
        Gyroscope.of(np.degrees(rates.angular_velocity), rates.times_s, times_s).learnt(shown)


@pytest.mark.parametrize("up", [(0.6, 0.0, 0.8), (0.6, 0.0, -0.8), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
def test_the_world_is_levelled(ride, up):
    _, poses, _ = ride
    up = np.array(up)
    seen = np.einsum("fji,j->fi", poses[:, :3, :3], up)
    covariance = np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (len(poses), 1, 1))
    level, turned = level_poses(poses, covariance, seen)
    np.testing.assert_allclose(
        np.einsum("fij,fj->fi", level[:, :3, :3], seen), [[0, 0, 1]] * len(poses), atol=1e-9
    )
    between = np.linalg.inv(level[0]) @ level[-1]
    np.testing.assert_allclose(between, np.linalg.inv(poses[0]) @ poses[-1], atol=1e-9)
    np.testing.assert_allclose(np.trace(turned[:, :3, :3], axis1=1, axis2=2), 6)


def test_a_walk_ends_where_it_began():
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    scans = radarsdf.io.read(recorded_file("ti_iwr6843/ti_mmwave_rospkg_demo.bag"), UNPOSED)
    found = radarsdf.odometry(scans)
    way = found.poses[-1, :3, 3] - found.poses[0, :3, 3]
    assert np.linalg.norm(way) < 0.01 * found.report["length_m"]
    imu = found.report["imu"]
    # Agrees with the radar's trigger, which is not read: scans are recorded 0.115 s after measurement.
    assert imu["time_offset_s"] == pytest.approx(0.115, abs=0.01)


@pytest.mark.parametrize(
    ("measured_s", "is_used"),
    [([-9, -5], False), ([-9, 0], True), ([4, 9], True), ([5, 9], False), ([2], False)],
)
def test_an_imu_is_used_if_it_measured_during_the_scans(measured_s, is_used):
    imu = Imu(np.array(measured_s) + 100.0, np.zeros((len(measured_s), 3)), R_sensor_imu=np.eye(3))
    found = Inertial.of(imu, None, np.arange(5.0), 100.0)
    assert (found.gyroscope is not None, len(found.notes)) == (is_used, 0 if is_used else 1)
