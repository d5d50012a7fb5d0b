# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A sensor is what its scans show."""

import dataclasses
import json

import numpy as np
import pytest
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import prepare
from radarsdf.returns.sensor import Sensor

from ..conftest import pose

NOISE = SensorNoise(0.1, 0.01, 0.02)


def scans(counts=(300, 500, 700), seed=0):
    """Returns within 60° to both sides, 10° down and 20° up, 3 to 40 m away; intensities above 50 - range / 2."""
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


def test_json_keeps_a_sensor():
    sensor = Sensor.of(*scans(), noise=NOISE)
    assert Sensor.from_dict(json.loads(json.dumps(sensor.to_dict()))) == sensor


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
        ({"azimuth_rad": (-4.0, 0.5)}, "azimuth_rad"),
        ({"elevation_rad": 0.5}, "two numbers"),
        ({"range_m": (-1.0, 5.0)}, "range_m"),
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
