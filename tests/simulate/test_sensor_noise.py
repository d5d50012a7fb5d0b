# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Noise that depends on axis, range and strength, and the false returns: each as its setting says."""

from dataclasses import replace

import numpy as np
import pytest
from radarsdf import simulate as sim
from scipy.spatial import cKDTree

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
    np.testing.assert_array_equal(
        *(np.sort(points, axis=0) for points in (scan.points[~false], clean.points))
    )
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
    assert np.median(np.linalg.norm(near, axis=1)) == pytest.approx(
        sensor.min_range_m + 1.5 * np.log(2), abs=0.1
    )
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
    assert (
        len(phantoms(sensor.scan(sim.Scene([]), np.eye(4)))) == 0
    )  # there is nothing that they could be behind


@pytest.mark.parametrize(
    ("share", "seed", "least", "most"), [(1.0, 0, 0.6, 1.0), (0.5, 0, 0.3, 0.55), (0.0, 0, 0.0, 0.01), (1.0, 1, 0.0, 0.05)]
)  # fmt: skip
def test_lasting_phantoms_stay_at_their_places_in_the_world(share, seed, least, most):
    """From scan to scan, whatever the pose. Another seed has other places."""
    sensor = replace(
        QUIET,
        azimuth_fov_rad=1.0,
        elevation_fov_rad=0.7,
        phantoms_per_scan=2000.0,
        phantom_lasting_share=share,
        phantom_depth=0.02,
    )
    there = np.eye(4)
    there[:3, 3] = [1.0, 0.3, -0.2]
    scene = wall_ahead(30.0)
    first = phantoms(sensor.scan(scene, np.eye(4), seed=0, frame=0))
    second = phantoms(sensor.scan(scene, there, seed=seed, frame=1)) + there[:3, 3]
    assert len(first) == pytest.approx(2000, rel=0.4)
    assert least <= np.mean(cKDTree(first).query(second)[0] < 1e-3) <= most
