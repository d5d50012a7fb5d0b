# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities broken in one way, and returns below the ground."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.check import check_cheaply

pytestmark = pytest.mark.usefixtures("right_frames")


@pytest.fixture(scope="module")
def good():
    scans = radarsdf.simulate.wall(frames=10)
    return scans.points, scans.poses, scans.intensities


def clipped(values):
    highest = np.percentile(np.concatenate(values), 85)
    return [np.minimum(value, highest) for value in values]


def replaced(values, every, value):
    """Every so many of the intensities is another value, or values."""
    whole = np.concatenate(values)
    whole[::every] = value
    return np.split(whole, np.cumsum([len(v) for v in values])[:-1])


BROKEN = {
    "intensity_constant": ("error", lambda values: [np.full_like(v, 7) for v in values]),
    "intensity_constant_in_scans": ("warning", lambda values: [np.full_like(v, v[0]) for v in values]),
    "intensity_clipped": ("warning", clipped),
    "intensity_steps": ("note", lambda values: [np.round(2 * v) / 2 for v in values]),
    "intensity_offset": ("note", lambda values: [np.round(v - np.median(v)) + 128 for v in values]),
    "intensity_sentinel": ("warning", lambda values: replaced(values, 50, -9999)),
    "intensity_wild": ("warning", lambda values: replaced(values, 10**6, 1e9)),
    "intensity_not_finite": ("note", lambda values: [np.where(v > 110, np.nan, v) for v in values]),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_breakage_is_named(good, name):
    points, poses, intensities = good
    severity, broken = BROKEN[name]
    found = check_cheaply(points, poses, broken(intensities))
    assert (name, severity) in [(finding.name, finding.severity) for finding in found]


def test_good_intensities_are_at_most_noted(good):
    names = {finding.name: finding.severity for finding in radarsdf.check(*good)}
    assert set(names.values()) == {"note"}
    assert not set(names) & set(BROKEN) - {"intensity_steps"}
    assert {"noise", "cost"} <= set(names)


def test_what_is_wild_is_counted_and_named(good):
    points, poses, intensities = good
    whole = np.concatenate(intensities)
    broken = replaced(intensities, 50, -9999.0)
    broken[7][1:8] = 65535
    broken[3][2] = 1e9  # a single one, in a scan that no sample need hold
    found = {finding.name: finding for finding in check_cheaply(points, poses, broken)}
    counts = {name: int(found[name].evidence.split()[0]) for name in ("intensity_sentinel", "intensity_wild")}
    values = np.concatenate(broken)
    assert counts == {"intensity_sentinel": int(np.isin(values, [-9999, 65535]).sum()), "intensity_wild": 1}
    assert f"of {len(whole)} intensities" in found["intensity_sentinel"].evidence
    assert "are -9999, 65535, far from all others" in found["intensity_sentinel"].evidence
    assert "are 1e+09" in found["intensity_wild"].evidence


def test_reflections_in_the_ground_are_named(good):
    points, poses, _ = good
    mirrored = []
    for scan in points:
        lower = scan.copy()
        lower[::4, 2] = (
            -3.6 - lower[::4, 2]
        )  # the ground is about 1.2 m below the sensor; what is above is mirrored
        mirrored.append(lower)
    found = check_cheaply(mirrored, poses)
    assert ("below_ground", "warning") in [(finding.name, finding.severity) for finding in found]
