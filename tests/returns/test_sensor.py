"""A sensor is what its scans show: noise along the beam, in azimuth and in elevation, ranges and angles."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.returns.evidence import ReturnsOfCells
from radarsdf.returns.noise import NOISE_SETTINGS, SensorNoise, sensor_noise, without_false_deviations
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare
from radarsdf.returns.sensor import Sensor
from radarsdf.scans import Scans

from ..conftest import ground_and_wall, pose
from .walls import a_wall, distance_from_wall_m, stated_wall

NOISE = SensorNoise(0.1, 0.01, 0.02)


def scans(counts=(300, 500, 700), seed=0):
    """Returns at azimuths of ±60°, elevations from -10° to 20° and ranges from 3 to 40 m; intensities above 50 - range / 2."""
    rng = np.random.default_rng(seed)
    points, intensities = [], []
    for count in counts:
        azimuth, elevation = np.deg2rad(rng.uniform(-60, 60, count)), np.deg2rad(rng.uniform(-10, 20, count))
        ranges_m = rng.uniform(3, 40, count)
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1
        )
        points.append(directions * ranges_m[:, None])
        intensities.append(50 - ranges_m / 2 + rng.uniform(0, 30, count))
    return points, intensities


def test_limits_counts_and_thresholds():
    points, intensities = scans()
    sensor = Sensor.of(points, intensities, noise=NOISE)
    np.testing.assert_allclose(np.rad2deg(sensor.azimuth_rad), [-60, 60], atol=1)
    np.testing.assert_allclose(np.rad2deg(sensor.elevation_rad), [-10, 20], atol=1)
    np.testing.assert_allclose(sensor.range_m, [3, 40], atol=0.5)
    assert sensor.returns_per_scan == 500
    at_m = np.array([8.0, 20.0, 35.0])
    np.testing.assert_allclose(sensor.threshold(at_m), 50 - at_m / 2, atol=2.5)
    assert sensor.beam_rad == pytest.approx((0.02355, 0.0471), rel=1e-3)


def test_a_sensor_of_rays_is_that_of_scans():
    points, intensities = scans()
    turns = np.radians([10, 80, -130])
    poses = np.stack([pose([3.0 * i, 5, -i], turn) for i, turn in enumerate(turns)])
    limits = {"min_range_m": 5.0, "max_range_m": 30.0}
    expected = Sensor.of(points, intensities, noise=NOISE, **limits)
    rays = prepare(points, poses, intensities, **limits)
    found = Sensor.of_rays(rays, poses, NOISE)
    for name in ("azimuth_rad", "elevation_rad", "range_m", "returns_per_scan"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=1e-5)
    np.testing.assert_allclose(found.thresholds, expected.thresholds, atol=1e-4)


def test_numbers_at_their_limits_and_beyond_the_thresholds():
    limits = (-np.pi, np.pi), (-np.pi / 2, np.pi / 2), (0.0, 1e6)
    sensor = Sensor(*limits, 1e7, SensorNoise(0.0, 0.0, 0.0), ((2.0, 50.0), (4.0, 40.0)))
    np.testing.assert_allclose(sensor.threshold(np.array([0.0, 2, 3, 4, 9])), [50, 50, 45, 40, 40])
    assert np.isneginf(dataclasses.replace(sensor, thresholds=()).threshold(np.ones(3))).all()
    azimuth, elevation = np.array([np.pi / 2, -np.pi / 4]), np.array([0.0, np.pi / 6])
    expected = [[0, 1, 0], [0.5 * 3**0.5 * 0.5**0.5, -0.5 * 3**0.5 * 0.5**0.5, 0.5]]
    np.testing.assert_allclose(sensor.directions(azimuth, elevation), expected, atol=1e-12)
    one = Sensor.of([np.array([[3.0, 0, 0], [3.0, 0, 0]])])
    assert one.range_m == pytest.approx((3 - 0.003, 3))
    assert one.azimuth_rad == pytest.approx((-1e-6, 0))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"azimuth_rad": (0.5, 0.5)}, "azimuth_rad"),
        ({"elevation_rad": 0.5}, "two numbers"),
        ({"range_m": (1.0, np.nan)}, "range_m"),
        ({"returns_per_scan": 0}, "returns_per_scan"),
        ({"returns_per_scan": 10_000_001}, "returns_per_scan"),
        ({"range_m": (1.0, 1_000_001)}, "range_m"),
        ({"elevation_rad": (-1.6, 0.0)}, "elevation_rad"),
        ({"noise": SensorNoise(-1.0, 0.0, 0.0)}, "noise"),
        ({"thresholds": ((5.0, 1.0), (5.0, 2.0))}, "ascending"),
    ],
)
def test_wrong_numbers(change, said):
    sensor = Sensor.of(*scans())
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(sensor, **change)


LEAF_M = 0.2


def noise_of(rays, **known):
    surfels = Surfels.of(rays, LEAF_M)
    return sensor_noise(surfels, rays, ReturnsConfig(**known))


@pytest.mark.parametrize(("range_m", "angle_rad"), [(0.05, 0.004), (0.05, 0.012), (0.1, 0.008)])
def test_the_noise_is_estimated_from_the_data(range_m, angle_rad):
    points, poses, _ = a_wall(range_m, angle_rad)
    noise = noise_of(prepare(points, poses))
    assert noise.range_m == pytest.approx(range_m, rel=0.35)
    assert noise.angle_rad == pytest.approx(angle_rad, rel=0.35)


@pytest.mark.parametrize("roll_rad", [0.0, 0.5 * np.pi])
def test_elevation_noise_is_separated_from_azimuth_noise(roll_rad):
    """The azimuth of a sensor rolled by 90 degrees is the elevation of others."""
    points, poses, _ = a_wall(0.05, 0.004, noise_elevation_rad=0.012, scans=16)
    roll = np.eye(4)
    roll[1:3, 1:3] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
    noise = noise_of(prepare([p @ roll[:3, :3] for p in points], poses @ roll))
    vertical, horizontal = noise.elevation_rad, noise.azimuth_rad
    if roll_rad > 0:
        vertical, horizontal = horizontal, vertical
    assert vertical == pytest.approx(0.012, rel=0.35)
    assert horizontal < 0.7 * vertical


def test_given_noise_is_kept():
    points, poses, _ = a_wall(0.05, 0.008)
    rays = prepare(points, poses)
    noise = noise_of(rays, range_noise_m=0.07)
    assert noise.range_m == pytest.approx(0.07)
    assert noise.elevation_rad == pytest.approx(0.008, rel=0.35)
    known = {"range_noise_m": 0.5, "azimuth_noise_rad": 0.2, "elevation_noise_rad": 0.1}
    assert dataclasses.astuple(noise_of(rays, **known)) == pytest.approx((0.5, 0.2, 0.1))


def test_stated_deviations_are_scaled_by_the_returns():
    points, poses, sigmas = stated_wall()
    rays = prepare(points, poses, sigmas=sigmas)
    typical = noise_of(rays).deviations / np.median(np.concatenate(sigmas), axis=0)
    assert typical == pytest.approx([1, 1, 0.01], rel=0.4)
    precise = np.concatenate(sigmas)[:, 0] < 0.1
    weights = noise_of(rays).weights(rays)
    assert np.median(weights[precise]) == pytest.approx(25 * np.median(weights[~precise]), rel=0.05)
    kept = without_false_deviations(rays, LEAF_M, ReturnsConfig(), 1)
    assert (kept.stated == rays.stated).all()


def test_deviations_that_the_returns_contradict_are_left_out(caplog):
    points, poses, sigmas = stated_wall()
    rays = prepare(points, poses, sigmas=[np.roll(own, 1, axis=0) for own in sigmas])
    assert without_false_deviations(rays, LEAF_M, ReturnsConfig(), 1).stated is None
    assert "deviations stated by the sensor" in caplog.text


@pytest.mark.parametrize("config", [FitConfig.quick(), FitConfig()])
def test_a_fit_weighs_returns_by_their_stated_deviations(config):
    def off_m(drive):
        return distance_from_wall_m(radarsdf.fit(drive, config=config, progress=False).mesh(0.1))

    points, poses, sigmas = stated_wall()
    assert off_m(Scans(points, poses, sigmas=sigmas)) < 0.8 * off_m(Scans(points, poses))


def test_few_returns_fall_back_to_the_default():
    few = ground_and_wall(scans=2, returns_per_scan=20)
    assert dataclasses.astuple(noise_of(prepare(few.points, few.poses))) == pytest.approx((0.1, 0.01, 0.01))


def test_variances_of_positions_by_range():
    noise, ranges_m = SensorNoise(0.1, 0.003, 0.004), np.array([2.0, 50], np.float32)
    assert noise.variances == pytest.approx([0.01, 9e-6, 16e-6])
    assert noise.angle_rad == pytest.approx(0.005 / np.sqrt(2))
    np.testing.assert_allclose(noise.variances_m2(ranges_m), 0.01 + 0.5 * (0.005 * ranges_m) ** 2, rtol=1e-6)
    np.testing.assert_allclose(noise.mean_variances_m2(ranges_m), (0.01 + (0.005 * ranges_m) ** 2) / 3)
    noises = [noise, SensorNoise(0.3, 0.001, 0.002), SensorNoise(0.2, 0.002, 0.009)]
    assert dataclasses.astuple(SensorNoise.median(noises)) == pytest.approx((0.2, 0.002, 0.004))
    config = ReturnsConfig(**dict(zip(NOISE_SETTINGS, noise.deviations, strict=True)))
    assert config.elevation_noise_rad == 0.004


def test_errors_of_poses_are_common_to_the_returns_of_a_scan():
    keys, scans = np.arange(3, dtype=np.uint64), np.array([1, 4, 2], np.uint32)
    information = np.array([100.0, 400, 25], np.float32)
    returns = ReturnsOfCells(keys, information, scans, np.ones(3))
    ranges_m = np.array([10.0, 20, 5], np.float32)
    config = ReturnsConfig(pose_sigma_m=0.03, pose_sigma_rad=0.004)
    found = returns.with_uncertain_poses(ranges_m, config)
    variances = 1 / returns.information + 9 * (0.03**2 + (0.004 * ranges_m) ** 2) / scans
    np.testing.assert_allclose(found.information, 1 / variances, rtol=1e-6)
    assert returns.with_uncertain_poses(ranges_m, ReturnsConfig()) is returns
    for name in ("pose_sigma_m", "pose_sigma_rad"):
        found = returns.with_uncertain_poses(ranges_m, ReturnsConfig(**{name: 0.01}))
        assert (found.information < returns.information).all()
