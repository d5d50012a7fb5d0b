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


def replaced(values, every, value):
    """Every so many of the intensities is another value, or values."""
    whole = np.concatenate(values)
    whole[::every] = value
    return np.split(whole, np.cumsum([len(v) for v in values])[:-1])


def test_intensities_that_are_not_finite_are_noted(good):
    points, poses, intensities = good
    found = check_cheaply(points, poses, [np.where(v > 110, np.nan, v) for v in intensities])
    assert ("intensity_not_finite", "note") in [(finding.name, finding.severity) for finding in found]


def test_good_intensities_are_at_most_noted(good):
    names = {finding.name: finding.severity for finding in radarsdf.check(*good)}
    assert set(names.values()) == {"note"}
    assert not {name for name in names if name.startswith("intensity")} - {"intensity_steps"}
    assert {"noise", "cost"} <= set(names)


def test_what_is_wild_is_counted_and_named(good):
    points, poses, intensities = good
    whole = np.concatenate(intensities)
    broken = replaced(intensities, 50, -9999.0)
    broken[7][1:8] = 65535
    broken[3][2] = 1e9  # a single one, in a scan that no sample need hold
    found = {finding.name: finding for finding in check_cheaply(points, poses, broken)}
    counts = {
        name: int(found[name].evidence.split()[0]) for name in ("intensity_sentinel", "intensity_outliers")
    }
    values = np.concatenate(broken)
    assert counts == {
        "intensity_sentinel": int(np.isin(values, [-9999, 65535]).sum()),
        "intensity_outliers": 1,
    }
    assert f"of {len(whole)} intensities" in found["intensity_sentinel"].evidence
    assert "are -9999, 65535, far from all others" in found["intensity_sentinel"].evidence
    assert "are 1e+09" in found["intensity_outliers"].evidence


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
