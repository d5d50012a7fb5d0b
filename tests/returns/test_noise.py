# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The noise of the sensor: found in its returns, along the beam, in azimuth and in elevation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from radarsdf.config.groups import ReturnsConfig
from radarsdf.returns.noise import sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare

from ..conftest import ground_and_wall
from .walls import a_wall

LEAF_M = 0.2


def noise_of(rays, **known):
    surfels = Surfels.of(rays, LEAF_M)
    return sensor_noise(surfels, rays, ReturnsConfig(**known))


@pytest.mark.parametrize(("range_m", "angle_rad"), [(0.05, 0.004), (0.05, 0.012), (0.1, 0.008)])
def test_the_noise_is_found_in_the_data(range_m, angle_rad):
    points, poses, _ = a_wall(range_m, angle_rad)
    noise = noise_of(prepare(points, poses))
    assert noise.range_m == pytest.approx(range_m, rel=0.35)
    assert noise.angle_rad == pytest.approx(angle_rad, rel=0.35)


@pytest.mark.parametrize("roll_rad", [0.0, 0.5 * np.pi])
def test_elevation_is_told_from_azimuth(roll_rad):
    """A sensor that lies on its side has its azimuth where others have their elevation."""
    points, poses, _ = a_wall(0.05, 0.004, noise_elevation_rad=0.012, scans=16)
    roll = np.eye(4)
    roll[1:3, 1:3] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
    noise = noise_of(prepare([p @ roll[:3, :3] for p in points], poses @ roll))
    vertical, horizontal = noise.elevation_rad, noise.azimuth_rad
    if roll_rad > 0:
        vertical, horizontal = horizontal, vertical
    assert vertical == pytest.approx(0.012, rel=0.35)
    assert horizontal < 0.7 * vertical


def test_what_the_user_knows_stays():
    points, poses, _ = a_wall(0.05, 0.008)
    rays = prepare(points, poses)
    noise = noise_of(rays, range_noise_m=0.07)
    assert noise.range_m == pytest.approx(0.07)
    assert noise.elevation_rad == pytest.approx(0.008, rel=0.35)
    known = {"range_noise_m": 0.5, "azimuth_noise_rad": 0.2, "elevation_noise_rad": 0.1}
    assert dataclasses.astuple(noise_of(rays, **known)) == pytest.approx((0.5, 0.2, 0.1))


def test_few_returns_give_a_guess():
    few = ground_and_wall(scans=2, returns_per_scan=20)
    assert dataclasses.astuple(noise_of(prepare(few.points, few.poses))) == pytest.approx((0.1, 0.01, 0.01))
