# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities broken in one way, and returns below the ground."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf


@pytest.fixture(scope="module")
def good():
    scans = radarsdf.simulate.wall(frames=10)
    return scans.points, scans.poses, scans.intensities


def clipped(values):
    highest = np.percentile(np.concatenate(values), 85)
    return [np.minimum(value, highest) for value in values]


BROKEN = {
    "intensity_constant": ("error", lambda values: [np.full_like(v, 7) for v in values]),
    "intensity_constant_in_scans": ("warning", lambda values: [np.full_like(v, v[0]) for v in values]),
    "intensity_clipped": ("warning", clipped),
    "intensity_steps": ("note", lambda values: [np.round(2 * v) / 2 for v in values]),
    "intensity_offset": ("note", lambda values: [np.round(v - np.median(v)) + 128 for v in values]),
    "intensity_not_finite": ("error", lambda values: [np.where(v > 110, np.nan, v) for v in values]),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_breakage_is_named(good, name):
    points, poses, intensities = good
    severity, broken = BROKEN[name]
    found = radarsdf.check(points, poses, broken(intensities))
    assert (name, severity) in [(finding.name, finding.severity) for finding in found]


def test_good_intensities_are_at_most_noted(good):
    names = {finding.name: finding.severity for finding in radarsdf.check(*good)}
    assert set(names.values()) == {"note"}
    assert not set(names) & set(BROKEN) - {"intensity_steps"}
    assert {"noise", "cost"} <= set(names)


def test_steps_are_in_numbers(good):
    points, poses, intensities = good
    found = radarsdf.check(points, poses, BROKEN["intensity_steps"][1](intensities))
    assert any("steps of 0.5" in finding.evidence for finding in found)


def test_reflections_in_the_ground_are_named(good):
    points, poses, _ = good
    mirrored = []
    for scan in points:
        lower = scan.copy()
        lower[::4, 2] = (
            -3.6 - lower[::4, 2]
        )  # the ground is about 1.2 m below the sensor; what is above is mirrored
        mirrored.append(lower)
    found = radarsdf.check(mirrored, poses)
    assert ("below_ground", "warning") in [(finding.name, finding.severity) for finding in found]
