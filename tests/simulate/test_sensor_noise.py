"""Noise by axis, range and strength, and false returns, each according to its setting."""

from dataclasses import replace

import numpy as np
import pytest
from radarsdf import simulate as sim
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .test_simulation import QUIET, wall_ahead

PENCIL = replace(QUIET, azimuth_fov_rad=1e-6, elevation_fov_rad=1e-6, beams=20_000)
MATT = sim.Material("matt", 0.0, specular=0.0, looks=1e6)  # no fading: the power is known


def deviations(sensor, distance_m):
    """Standard deviations (3,) of 20,000 returns of a matt wall: along the beam, and across it to left and up, m."""
    points = sensor.scan(wall_ahead(distance_m, MATT), np.eye(4)).points.astype(np.float64)
    assert len(points) == 20_000
    return points.std(axis=0)


@pytest.mark.parametrize(("distance_m", "expected_m"), [(3.0, 0.0501), (40.0, 0.0640), (80.0, 0.0943)])
def test_the_noise_along_the_beam_grows_with_the_range(distance_m, expected_m):
    sensor = replace(PENCIL, max_range_m=100.0, sigma_range_m=0.05, sigma_range_per_m=0.001)
    assert deviations(sensor, distance_m)[0] == pytest.approx(expected_m, rel=0.03)


@pytest.mark.parametrize(("above_threshold_db", "factor"), [(0.5, 2.136), (10.0, 1.183), (30.0, 1.002)])
def test_weak_returns_are_noisier_in_all_axes(above_threshold_db, factor):
    """A wall at 10 m has 40 dB less than the gain. The factor is √(1 + 2² · 10^(-dB / 10)), for 0.5 dB 2.136."""
    sensor = replace(
        PENCIL, gain_db=100.0, threshold_db=60.0 - above_threshold_db, weak_noise=2.0,
        sigma_range_m=0.05, sigma_azimuth_rad=0.004, sigma_elevation_rad=0.012,
    )  # fmt: skip
    np.testing.assert_allclose(deviations(sensor, 10.0), factor * np.array([0.05, 0.04, 0.12]), rtol=0.03)


def test_side_lobes_keep_range_and_azimuth_and_add_returns():
    scene, pose = wall_ahead(10.0, MATT), np.eye(4)
    clean = QUIET.scan(scene, pose, seed=1)
    sensor = replace(QUIET, sidelobe_share=0.2, sidelobe_fov_rad=0.6)
    scan = sensor.scan(scene, pose, seed=1)
    false = scan.origin_kind == sim.Origin.SIDELOBE
    assert false.sum() / len(clean.points) == pytest.approx(0.2, abs=0.03)
    assert np.isnan(scan.noiseless_intensities[false]).all()
    left, expected = (np.sort(points, axis=0) for points in (scan.points[~false], clean.points))
    np.testing.assert_array_equal(left, expected)
    points = scan.points[false].astype(np.float64)
    ranges_m = np.linalg.norm(points, axis=1)
    elevation = np.arcsin(points[:, 2] / ranges_m)
    assert np.abs(elevation).max() <= 0.3 + 1e-6
    assert elevation.std() == pytest.approx(0.3 / np.sqrt(3), rel=0.1)
    # The range and azimuth of each are those of a true return.
    true = clean.points.astype(np.float64)
    range_and_azimuth = np.stack([np.linalg.norm(true, axis=1), np.arctan2(true[:, 1], true[:, 0])], axis=1)
    own = np.stack([ranges_m, np.arctan2(points[:, 1], points[:, 0])], axis=1)
    assert np.abs(own[:, None] - range_and_azimuth).max(axis=2).min(axis=1).max() < 1e-4


def test_clutter_follows_its_shares():
    sensor = replace(QUIET, clutter_per_scan=4000.0, threshold_db=40.0, clutter_power_db=6.0)
    scene, distance_m = wall_ahead(40.0), 40.0

    def clutter(**shares):
        scan = replace(sensor, **shares).scan(scene, np.eye(4))
        false = scan.origin_kind == sim.Origin.CLUTTER
        return scan.points[false].astype(np.float64), scan.intensities[false]

    near, power_db = clutter(clutter_near_share=1.0)
    median_m = sensor.min_range_m + 1.5 * np.log(2)
    assert np.median(np.linalg.norm(near, axis=1)) == pytest.approx(median_m, abs=0.1)
    assert np.mean(power_db - 40.0) == pytest.approx(6.0, rel=0.1)
    before, _ = clutter(clutter_near_share=0.0)
    assert (before[:, 0] < 0.96 * distance_m).all()
    assert np.median(before[:, 0]) == pytest.approx(0.5 * distance_m, rel=0.1)


def phantoms(scan):
    return scan.points[scan.origin_kind == sim.Origin.PHANTOM].astype(np.float64)


def test_phantoms_lie_behind_surfaces_at_depths_that_grow_with_the_range():
    sensor = replace(QUIET, phantoms_per_scan=3000.0, phantom_lasting_share=0.0, phantom_depth=0.02)
    for distance_m in (10.0, 40.0):
        depth_m = phantoms(sensor.scan(wall_ahead(distance_m), np.eye(4)))[:, 0] - distance_m
        assert len(depth_m) == pytest.approx(3000, rel=0.06)
        assert (depth_m > 0).all()
        assert depth_m.mean() == pytest.approx(0.02 * distance_m, rel=0.06)
    assert len(phantoms(sensor.scan(sim.Scene([]), np.eye(4)))) == 0  # without surfaces there are no phantoms


@pytest.mark.parametrize(
    ("share", "seed", "least", "most"), [(1.0, 0, 0.6, 1.0), (0.5, 0, 0.3, 0.55), (0.0, 0, 0.0, 0.01), (1.0, 1, 0.0, 0.05)]
)  # fmt: skip
def test_persistent_phantoms_are_fixed_in_the_world(share, seed, least, most):
    """In all scans, independent of the pose. Another seed has other positions."""
    many = {"phantoms_per_scan": 2000.0, "phantom_lasting_share": share, "phantom_depth": 0.02}
    sensor = replace(QUIET, azimuth_fov_rad=1.0, elevation_fov_rad=0.7, **many)
    there = np.eye(4)
    there[:3, 3] = [1.0, 0.3, -0.2]
    scene = wall_ahead(30.0)
    first = phantoms(sensor.scan(scene, np.eye(4), seed=0, frame=0))
    second = phantoms(sensor.scan(scene, there, seed=seed, frame=1)) + there[:3, 3]
    assert len(first) == pytest.approx(2000, rel=0.4)
    assert least <= np.mean(cKDTree(first).query(second)[0] < 1e-3) <= most


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


def test_an_imu_measures_in_its_own_axes_at_its_lever_arm(circle):
    """Uniform on a circle: the rate is 1 rad/s about z, and the specific force is gravity plus the centripetal part."""
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
    rates, forces = (values[near].mean(axis=0) for values in (imu.angular_velocity, imu.specific_force))
    np.testing.assert_allclose(rates, rate + BIAS_RAD_S, atol=4 * 0.005 / 50**0.5)
    np.testing.assert_allclose(forces, force + BIAS_MPS2, atol=4 * 0.05 / 50**0.5)
    middle = slice(200, 1800)  # splines oscillate at their ends
    np.testing.assert_allclose(imu.angular_velocity[middle].std(axis=0), 0.005, rtol=0.1)
    np.testing.assert_allclose(imu.specific_force[middle].std(axis=0), 0.05, rtol=0.1)


def test_doppler_and_rates_have_the_documented_noise():
    """Along a straight line at 2 m/s, turning at 0.1 rad/s. A tenth of the returns move."""
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
    # 8 % of a normal variable are within 0.1 deviations.
    assert moving.mean() == pytest.approx(0.1 * 0.92, rel=0.05)
    assert np.sqrt(np.mean(noise[moving] ** 2)) == pytest.approx(5.2, rel=0.05)
    np.testing.assert_allclose(sim.measured_motion(drive).times_s, 0.1 * np.arange(len(times_s)))
    folded = np.concatenate(sim.measured_motion(drive, rate_hz=5.0, interval_mps=3.0).doppler_mps)
    assert -1.5 <= folded.min() < -1.4 < 1.4 < folded.max() <= 1.5
    turns = (np.concatenate(motion.doppler_mps) - folded) / 3.0
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)


def test_drift_accumulates():
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
