# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The simulated `astyx` is as noisy as the recorded drives, and would not be without any part of its noise."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from radarsdf.simulate import SCENES, simulate
from scipy.spatial import cKDTree

from bench.sensor import __main__ as command
from bench.sensor.astyx import EXPECTED, FITTED, KEPT_ASIDE, medians, misfits
from bench.sensor.drives import Drive, recorded, with_lidar
from bench.sensor.figures import deviation, figures, plane_errors

from ..conftest import recorded_scans

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
        ({"sigma_range_per_m": 0.0}, 1, "deviation beam m 45-60", False),
        ({"weak_noise": 0.0}, 2, "deviation beam, strong / weak 30-45", True),
        ({"phantoms_per_scan": 0.0}, 1, "share farther than 1 m 30-45", False),
        ({"phantom_lasting_share": 0.0}, 1, "false returns seen again 20-30", False),
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


def test_the_drive_kept_aside_has_the_same_noise_in_elevation_and_more_false_returns():
    """Too few planes tell its noise along the beam and in azimuth. Its false returns are up to 3.2 times as many."""
    found = figures(recorded(recorded_scans(KEPT_ASIDE)))
    for name, expected in EXPECTED.items():
        ratio = found[name] / expected.value
        if not name.startswith(("deviation", "distance", "false")):
            assert 0.4 < ratio < 3.3, name
        elif np.isfinite(ratio):
            assert 0.7 < ratio < 1.5, name


def test_the_lidar_of_a_simulation_does_not_depend_on_the_radar():
    usual = SCENES["astyx"](seed=0, frames=2)
    sensor = replace(usual.sensor, weak_noise=0.0)
    changed = simulate(usual.scene, sensor, usual.poses, name=usual.name, seed=0)
    own, taken = with_lidar(changed), with_lidar(changed, same_lidar=with_lidar(usual))
    assert np.array_equal(own.lidar, taken.lidar)
    assert np.array_equal(own.lidar_frame, taken.lidar_frame)
    assert np.array_equal(own.points, taken.points)


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


def test_the_command_prints_a_row_for_each_figure(monkeypatch, capsys):
    monkeypatch.setitem(SCENES, "astyx", partial(SCENES["astyx"], frames=4))
    command.main([str(recorded_scans(KEPT_ASIDE)), "--seeds", "0"])
    said = capsys.readouterr().out
    assert "| returns per scan 10-20 " in said
    assert "| deviation elevation, strong / weak 45-60 " in said
