# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is measured of a motion: its derivatives, with the noise that the documentation states; and poses that drift."""

import numpy as np
import pytest
from radarsdf import simulate as sim
from scipy.spatial.transform import Rotation

from .test_simulation import QUIET, wall_ahead

BIAS_RAD_S = np.array([0.002, -0.003, 0.0035])
BIAS_MPS2 = np.array([0.03, -0.02, 0.04])


@pytest.fixture(scope="module")
def circle():
    """Times of 2 s, and poses on a circle of 5 m radius at 1 rad/s, looking ahead and rolled by 0.3 rad."""
    times_s = np.arange(0, 2.01, 0.05)
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    yaws = Rotation.from_euler("z", times_s[:, None] + np.pi / 2)
    poses[:, :3, :3] = (yaws * Rotation.from_euler("x", 0.3)).as_matrix()
    poses[:, :2, 3] = 5 * np.stack([np.cos(times_s), np.sin(times_s)], 1)
    return times_s, poses


def test_an_imu_with_axes_and_lever_of_its_own(circle):
    """Steady on a circle: the rate is 1 rad/s about z, and the force is gravity and the pull to the centre."""
    times_s, poses = circle
    R_sensor_imu = Rotation.from_euler("ZYX", [0.7, -0.2, 0.4]).as_matrix()
    lever_m = np.array([0.5, -0.3, 0.2])  # of the sensor in the axes of the IMU
    imu = sim.measured_imu(poses, times_s, rate_hz=1000.0, R_sensor_imu=R_sensor_imu, lever_m=tuple(lever_m))
    assert len(imu) == 2001
    assert len(sim.measured_imu(poses, times_s)) == 201
    np.testing.assert_allclose(np.diff(imu.times_s), 1e-3, atol=1e-9)
    R_world_imu = poses[20, :3, :3] @ R_sensor_imu
    position = poses[20, :3, 3] - R_world_imu @ lever_m
    assert imu.times_s[1000] == pytest.approx(times_s[20])
    rate, force = R_world_imu.T @ [0, 0, 1], R_world_imu.T @ (-position * [1, 1, 0] + [0, 0, 9.81])
    # The mean over 50 ms, in which the vectors hardly change in the axes of the IMU.
    near = slice(975, 1026)
    np.testing.assert_allclose(
        imu.angular_velocity[near].mean(axis=0), rate + BIAS_RAD_S, atol=4 * 0.005 / 50**0.5
    )
    np.testing.assert_allclose(
        imu.specific_force[near].mean(axis=0), force + BIAS_MPS2, atol=4 * 0.05 / 50**0.5
    )
    middle = slice(200, 1800)  # splines swing at their ends
    np.testing.assert_allclose(imu.angular_velocity[middle].std(axis=0), 0.005, rtol=0.1)
    np.testing.assert_allclose(imu.specific_force[middle].std(axis=0), 0.05, rtol=0.1)


def test_doppler_and_rates_have_the_noise_that_is_stated():
    """Along a straight line at 2 m/s, turning at 0.1 rad/s. A tenth of the returns move by themselves."""
    times_s = np.arange(0, 4, 0.2)
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", 0.1 * times_s[:, None]).as_matrix()
    poses[:, 0, 3] = 2.0 * times_s
    drive = sim.simulate(wall_ahead(30.0), QUIET, poses, name="straight")
    motion = sim.measured_motion(drive, rate_hz=5.0)
    np.testing.assert_allclose(motion.times_s, times_s)
    error = motion.angular_velocity - [0, 0, 0.1] - BIAS_RAD_S
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.005, rel=0.25)
    assert np.abs(error.mean(axis=0)).max() < 4 * 0.005 / len(times_s) ** 0.5
    velocities = poses[:, :3, :3].transpose(0, 2, 1) @ [2.0, 0, 0]
    speeds = [
        -(points / np.linalg.norm(points, axis=1, keepdims=True)) @ velocity
        for points, velocity in zip(drive.points, velocities, strict=True)
    ]
    noise = np.concatenate(motion.doppler_mps) - np.concatenate(speeds)
    assert np.median(np.abs(noise)) / 0.6745 == pytest.approx(0.1, rel=0.2)
    moving = np.abs(noise) > 0.5
    assert moving.mean() == pytest.approx(
        0.1 * 0.92, rel=0.05
    )  # 8 % of a normal variable are within 0.1 deviations
    assert np.sqrt(np.mean(noise[moving] ** 2)) == pytest.approx(5.2, rel=0.05)
    np.testing.assert_allclose(sim.measured_motion(drive).times_s, 0.1 * np.arange(len(times_s)))
    folded = np.concatenate(sim.measured_motion(drive, rate_hz=5.0, interval_mps=3.0).doppler_mps)
    assert -1.5 <= folded.min() < -1.4 < 1.4 < folded.max() <= 1.5
    turns = (np.concatenate(motion.doppler_mps) - folded) / 3.0
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)


def test_drift_adds_up_from_step_to_step():
    poses = np.tile(np.eye(4), (4001, 1, 1))
    poses[:, 0, 3] = np.arange(4001)
    found = sim.drifted(poses, 0.02, 0.003, seed=1, yaw_rad=0.01)
    np.testing.assert_array_equal(found[0], poses[0])
    motions = np.linalg.inv(found[:-1]) @ found[1:]
    turns = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    np.testing.assert_allclose(turns.mean(axis=0), [0, 0, 0.01], atol=2e-4)
    np.testing.assert_allclose(turns.std(axis=0), 0.003, rtol=0.05)
    np.testing.assert_allclose(motions[:, :3, 3].mean(axis=0), [1, 0, 0], atol=1.5e-3)
    np.testing.assert_allclose(motions[:, :3, 3].std(axis=0), 0.02, rtol=0.05)
