# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The ways to break good data do what they say, and the check names them on a small scene."""

import dataclasses

import numpy as np
import pytest

from .breakages import WAYS, found_in, simulated


@pytest.fixture(scope="module")
def good():
    return simulated("wall", 20)


def differs(a, b):
    pairs = ((getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a))
    return any(
        len(x) != len(y) or any(not np.array_equal(u, v) for u, v in zip(x, y, strict=True)) for x, y in pairs
    )


def test_good_data_have_nothing_worse_than_notes(good):
    assert [name for name, severity in found_in(good, cheap=False) if severity != "note"] == []
    assert [name for name, severity in found_in(good, cheap=True) if severity != "note"] == []


# A steady motion is the same at any time, and a slow one hardly differs from none: tests/checking has clocks that are off
# where the motion changes, and drifts.
NOT_HERE = {
    "poses of two scans before",
    "degrees taken for rad",
    "drift of 1.5 m and 6 degrees",
    "there and back, drift of 0.4 m",
}


# The others are named by what `fit` checks, too, in a tenth of the time.
WHOLE_CHECK = {"poses of a vehicle, sensor turned by 15 degrees of pitch", "Doppler with the other sign"}


SEVERITIES = {
    "intensity_constant": "error",
    "intensity_is_doppler": "error",
    "intensity_steps": "note",
    "intensity_offset": "note",
}


@pytest.mark.parametrize("way", sorted(set(WAYS) - NOT_HERE))
def test_a_breakage_is_named(good, way, request):
    finding, broken = WAYS[way]
    if finding.startswith(("intensity", "duplicate", "below")):
        request.getfixturevalue("right_frames")
    data = broken(good)
    assert differs(good, data)
    found = dict(found_in(data, cheap=way not in WHOLE_CHECK))
    assert finding in found
    if finding.startswith("intensity"):
        assert found[finding] == SEVERITIES.get(finding, "warning")
