# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses of radars with a narrow field of view and few returns, whose Doppler leaves a direction open."""

import numpy as np
import pytest
import radarsdf
from radarsdf.poses.rigid import between

from ..conftest import recorded_file

RETURNS = 40


def road(seed, rate_rad_s=0.0, speed_mps=25.0, elevation_deg=5.0, scans=40):
    """Scans, Doppler, times and poses of a radar of 28 by 10 degrees on a road between fences; 15 % of the returns move."""
    rng, times_s = np.random.default_rng(seed), np.arange(scans) / 15
    yaw = rate_rad_s * times_s
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, :2, :2] = np.moveaxis([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]], 2, 0)
    middle = yaw[:-1] + rate_rad_s / 30
    poses[1:, :2, 3] = speed_mps / 15 * np.cumsum(np.column_stack([np.cos(middle), np.sin(middle)]), axis=0)
    fence = np.column_stack(
        [
            rng.uniform(0, 250 + poses[-1, 0, 3], 40_000),
            rng.choice([-30, -9, 9, 30], 40_000),
            rng.uniform(-1, 6, 40_000),
        ]
    )
    points, doppler_mps = [], []
    for pose in poses:
        seen = (fence - pose[:3, 3]) @ pose[:3, :3]
        ranges = np.linalg.norm(seen, axis=1)
        azimuth, elevation = np.arctan2(seen[:, 1], seen[:, 0]), np.arcsin(seen[:, 2] / ranges)
        inside = (np.abs(azimuth) < np.radians(14)) & (np.abs(elevation) < np.radians(5)) & (ranges < 150)
        chosen = rng.choice(np.flatnonzero(inside), RETURNS, replace=False)
        azimuth, elevation = azimuth[chosen], elevation[chosen] * elevation_deg / 5
        speeds = -speed_mps * np.cos(elevation) * np.cos(azimuth) + rng.normal(0, 0.07, RETURNS)
        speeds += np.where(rng.random(RETURNS) < 0.15, rng.uniform(2, 20, RETURNS), 0)
        azimuth, elevation = (
            azimuth + rng.normal(0, 0.004, RETURNS),
            elevation + rng.normal(0, 0.002 * elevation_deg, RETURNS),
        )
        level = np.cos(elevation)
        directions = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        points.append(directions * (ranges[chosen] + rng.normal(0, 0.2, RETURNS))[:, None])
        doppler_mps.append(speeds)
    return points, doppler_mps, times_s, poses


def deviations(found, true):
    """(F, 3) errors of the positions seen from the middle scan, in its axes and in their standard deviations."""
    middle = len(true) // 2
    at, of = (between(np.tile(poses[middle], (len(true), 1, 1)), poses) for poses in (found.poses, true))
    R = found.poses[middle, :3, :3]
    variances = np.einsum("ji,fjk,ki->fi", R, found.covariance[:, :3, :3], R)
    others = np.arange(len(true)) != middle
    return ((at - of)[:, :3, 3])[others] / np.sqrt(variances[others])


def end_error_m(found, true):
    """Horizontal, m, where the first poses are brought together."""
    ends = [between(poses[:1], poses[-1:])[0, :2, 3] for poses in (found.poses, true)]
    return float(np.linalg.norm(ends[0] - ends[1]))


@pytest.mark.parametrize("name", ["F_LRR_C", "B_LRR_C"])
def test_radars_on_a_motorway_find_their_poses(name):
    with np.load(recorded_file("aimotive_motorway/radar.npz")) as data:
        borders = np.cumsum(data[f"{name}_counts"])[:-1]
        points, doppler_mps = (
            np.split(data[f"{name}_{what}"], borders) for what in ("points", "doppler_mps")
        )
        times_s, true = data["times_s"], data[f"{name}_poses"]
    found = radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert found.report["segments"] == 1
    assert found.report["length_m"] == pytest.approx(98, abs=1)
    assert end_error_m(found, true) < 1.0
    assert np.abs(deviations(found, true)[:, :2]).max() < 4
    assert any(note.startswith("Assumed: the sensor turns") for note in found.report["notes"])


@pytest.mark.parametrize("rate_rad_s", [0.0, 0.15])
def test_errors_of_a_narrow_radar_are_in_its_covariance(rate_rad_s):
    """Its returns say nothing of how it turns, so that a bend is known as well as assumed: 0.15 rad/s are two deviations."""
    points, doppler_mps, times_s, true = road(1, rate_rad_s)
    found = radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert found.report["segments"] == 1
    assert np.abs(deviations(found, true)).max() < 4
    if rate_rad_s == 0:
        assert end_error_m(found, true) < 0.5


def test_a_radar_without_elevation_is_assumed_to_climb_little():
    points, doppler_mps, times_s, true = road(2, elevation_deg=0.0, scans=24)
    assert all((scan[:, 2] == 0).all() for scan in points)
    found = radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert "24 of 24 scans" in found.report["notes"][0]
    assert end_error_m(found, true) < 0.5
    assert np.abs(deviations(found, true)[:, :2]).max() < 4


def test_a_refusal_names_what_is_missing():
    points, doppler_mps, times_s, _ = road(4, speed_mps=10.0, scans=20)
    with pytest.raises(ValueError, match="how the sensor turned") as refused:
        radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert "Give a gyroscope" in str(refused.value)
    assert "Doppler" not in str(refused.value)
    rng = np.random.default_rng(5)
    doppler_mps = [rng.uniform(-20, 20, len(scan)) for scan in points]
    with pytest.raises(ValueError, match="how the sensor moved") as refused:
        radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert "Give their Doppler" not in str(refused.value)
    assert "0 of 20 scans agree on a velocity of the sensor" in str(refused.value)
