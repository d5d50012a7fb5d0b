# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The simulated `astyx` is as noisy as the recorded drives, and would not be without any part of its noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from radarsdf.simulate import SCENES, simulate

from bench.sensor import __main__ as command
from bench.sensor.astyx import EXPECTED, FITTED, KEPT_ASIDE, medians, misfits
from bench.sensor.drives import recorded, with_lidar
from bench.sensor.figures import deviation, figures

from ..conftest import recorded_scans

SEEDS = (0, 1, 2)


@pytest.fixture(scope="module")
def simulations():
    return [SCENES["astyx"](seed=seed) for seed in SEEDS]


def figures_of(simulations, **changes):
    """Figures of the simulations, scanned again if the sensor is to be changed."""
    if changes:
        simulations = [
            simulate(s.scene, replace(s.sensor, **changes), s.poses, name=s.name, seed=s.seed, lidar_rays=1)
            for s in simulations
        ]
    return [figures(with_lidar(simulation)) for simulation in simulations]


def test_the_simulation_is_as_noisy_as_the_drives(simulations):
    assert misfits(figures_of(simulations)) == {}


@pytest.mark.parametrize(
    ("changes", "what_fails", "is_too_large"),
    [
        ({"sigma_elevation_rad": 0.004}, "deviation elevation rad 10-20", False),  # as in azimuth
        ({"sigma_range_per_m": 0.0}, "deviation beam m 45-60", False),
        ({"weak_noise": 0.0}, "deviation beam, strong / weak 30-45", True),
        ({"phantoms_per_scan": 0.0}, "share farther than 1 m 30-45", False),
        ({"phantom_lasting_share": 0.0}, "false returns seen again 20-30", False),
        ({"sidelobe_share": 0.3}, "share farther than 1 m 10-20", True),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_each_part_of_the_noise_is_needed(simulations, changes, what_fails, is_too_large):
    wrong = misfits(figures_of(simulations[:2], **changes))
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


def test_deviation_ignores_a_background():
    rng = np.random.default_rng(0)
    errors = np.concatenate([rng.normal(0, 0.1, 2000), rng.uniform(-1.5, 1.5, 1000)])
    assert deviation(errors, 1.5) == pytest.approx(0.1, rel=0.08)
    assert np.isnan(deviation(errors[:10], 1.5))


def test_the_command_prints_a_row_for_each_figure(capsys):
    command.main([str(recorded_scans(KEPT_ASIDE)), "--seeds", "0"])
    said = capsys.readouterr().out
    assert "| returns per scan 10-20 " in said
    assert "| deviation elevation, strong / weak 45-60 " in said
