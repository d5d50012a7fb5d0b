# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The simulated `astyx` is as noisy as the recorded drives, and would not be without any part of its noise."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from radarsdf.simulate import SCENES, simulate
from scipy.spatial import cKDTree

from bench.sensor import Drive, deviation, figures, medians, plane_errors, recorded, with_lidar

from ..conftest import recorded_scans

FITTED = ("r0144_0167", "r0009_0024", "r0057_0068", "r0133_0142")


class Expected(NamedTuple):
    """A figure of the recorded drives, and the factor up to which a simulated one may differ."""

    value: float
    factor: float


EXPECTED = {
    "returns per scan": Expected(1930, 1.25),
    "returns per scan 10-20": Expected(461, 1.6),
    "returns per scan 20-30": Expected(311, 1.6),
    "returns per scan 30-45": Expected(436, 1.6),
    "returns per scan 45-60": Expected(267, 1.6),
    "median distance m 10-20": Expected(0.179, 1.5),
    "median distance m 20-30": Expected(0.273, 1.5),
    "median distance m 30-45": Expected(0.532, 1.6),
    "median distance m 45-60": Expected(1.01, 1.6),
    "share farther than 0.4 m 10-20": Expected(0.177, 1.4),
    "share farther than 0.4 m 20-30": Expected(0.341, 1.4),
    "share farther than 0.4 m 30-45": Expected(0.594, 1.4),
    "share farther than 0.4 m 45-60": Expected(0.725, 1.4),
    "share farther than 1 m 10-20": Expected(0.0222, 1.6),
    "share farther than 1 m 20-30": Expected(0.0899, 1.6),
    "share farther than 1 m 30-45": Expected(0.289, 1.6),
    "share farther than 1 m 45-60": Expected(0.476, 1.6),
    "distance, strong / weak 10-20": Expected(0.762, 1.5),
    "distance, strong / weak 20-30": Expected(0.682, 1.5),
    "distance, strong / weak 30-45": Expected(0.730, 1.5),
    "false returns seen again 20-30": Expected(0.108, 1.5),
    "false returns seen again 30-45": Expected(0.210, 1.5),
    "false returns seen again 45-60": Expected(0.308, 1.5),
    "deviation beam m 10-20": Expected(0.130, 1.25),
    "deviation beam m 20-30": Expected(0.167, 1.25),
    "deviation beam m 30-45": Expected(0.185, 1.25),
    "deviation beam m 45-60": Expected(0.195, 1.25),
    "deviation beam, strong / weak 10-20": Expected(0.659, 1.2),
    "deviation beam, strong / weak 30-45": Expected(0.698, 1.2),
    "deviation azimuth rad 10-20": Expected(0.00783, 1.6),
    "deviation azimuth rad 20-30": Expected(0.00680, 1.6),
    "deviation azimuth rad 30-45": Expected(0.0111, 1.6),
    "deviation elevation rad 10-20": Expected(0.0253, 1.25),
    "deviation elevation rad 20-30": Expected(0.0205, 1.25),
    "deviation elevation rad 30-45": Expected(0.0143, 1.25),
}


def misfits(found: list[dict[str, float]]) -> dict[str, float]:
    """Simulated over expected figure, of those figures that differ by more than their factor or that are missing."""
    ratios = {name: own / EXPECTED[name].value for name, own in medians(found).items() if name in EXPECTED}
    return {
        name: ratio
        for name, ratio in ratios.items()
        if not 1 / EXPECTED[name].factor <= ratio <= EXPECTED[name].factor
    }


SEEDS = (1, 2)


@pytest.fixture(scope="module")
def simulations():
    """For each seed the simulation, the drive and its figures."""
    found = [SCENES["astyx"](seed=seed) for seed in SEEDS]
    drives = [with_lidar(simulation) for simulation in found]
    return [(simulation, drive, figures(drive)) for simulation, drive in zip(found, drives, strict=True)]


def test_the_simulation_is_as_noisy_as_the_drives(simulations):
    assert misfits([found for _, _, found in simulations]) == {}


@pytest.mark.parametrize(
    ("changes", "seed", "what_fails", "is_too_large"),
    [
        ({"sigma_elevation_rad": 0.004}, 1, "deviation elevation rad 10-20", False),  # as in azimuth
        ({"weak_noise": 0.0}, 2, "deviation beam, strong / weak 30-45", True),
        ({"phantoms_per_scan": 0.0}, 1, "share farther than 1 m 30-45", False),
        ({"sidelobe_share": 0.3}, 2, "share farther than 1 m 10-20", True),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_each_part_of_the_noise_is_needed(simulations, changes, seed, what_fails, is_too_large):
    """In every second scan of one scene, which by itself agrees with the drives in what fails."""
    usual, drive, found = simulations[SEEDS.index(seed)]
    assert what_fails not in misfits([found])
    sensor = replace(usual.sensor, **changes)
    changed = simulate(usual.scene, sensor, usual.poses[::2], name=usual.name, seed=seed)
    lidar = replace(drive, lidar_frame=drive.lidar_frame // 2)
    wrong = misfits([figures(with_lidar(changed, same_lidar=lidar))])
    assert what_fails in wrong
    assert (wrong[what_fails] > 1) == is_too_large


def test_the_expected_figures_are_those_of_the_drives():
    measured = medians([figures(recorded(recorded_scans(name))) for name in FITTED])
    for name, expected in EXPECTED.items():
        assert measured[name] == pytest.approx(expected.value, rel=0.01), name


def test_plane_errors_are_those_along_the_normal_of_a_plane():
    """A wall 20 m ahead, whose normal is the beam, far from the origin of the world."""
    rng = np.random.default_rng(0)
    aside = np.array([4e5, 5e6, 100.0])
    wall = np.column_stack([np.full(4000, 20.0), rng.uniform(-3, 3, (4000, 2))]) + aside
    points = np.column_stack([20.0 + rng.normal(0, 0.2, 300), rng.uniform(-1, 1, (300, 2))])
    pose = np.eye(4)
    pose[:3, 3] = aside
    frame = np.zeros(300, np.int64)
    drive = Drive("wall", points, np.ones(300), frame, pose[None], wall, np.zeros(4000, np.int64))
    world = drive.world_points()
    errors_m, axis = plane_errors(drive, world, cKDTree(wall).query(world)[1])
    assert (axis == 0).all()
    assert np.abs(errors_m) == pytest.approx(np.abs(points[:, 0] - 20.0), abs=1e-6)


def test_deviation_ignores_a_background():
    rng = np.random.default_rng(0)
    errors = np.concatenate([rng.normal(0, 0.1, 2000), rng.uniform(-1.5, 1.5, 1000)])
    assert deviation(errors, 1.5) == pytest.approx(0.1, rel=0.08)
    assert np.isnan(deviation(errors[:10], 1.5))
