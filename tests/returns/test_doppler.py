# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Doppler that was not measured."""

from __future__ import annotations

import numpy as np
import pytest
from radarsdf.returns.moving import without_filler


@pytest.fixture
def directions():
    return [np.random.default_rng(k).normal(size=(80, 3)) for k in range(5)]


def speeds_of(directions, velocity_mps, step_mps):
    return [step_mps * np.round(-d @ velocity_mps / np.linalg.norm(d, axis=1) / step_mps) for d in directions]


@pytest.mark.parametrize("filler", [0.0, -128.0])
@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
def test_fillers_are_left_out(directions, filler, share):
    rng = np.random.default_rng(9)
    speeds = speeds_of(directions, np.array([8.0, 1.0, 0.0]), 1e-3)
    filled = [np.where(rng.random(len(v)) < share, filler, v) for v in speeds]
    found, note = without_filler(directions, filled)
    assert f"{filler:g} m/s" in note
    for v, measured, given in zip(found, speeds, filled, strict=True):
        np.testing.assert_array_equal(v, np.where(given == filler, np.nan, measured))


@pytest.mark.parametrize("velocity_mps", [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)])
def test_equal_speeds_of_a_slow_sensor_stay(directions, velocity_mps):
    rng = np.random.default_rng(9)
    speeds = speeds_of(directions, np.array(velocity_mps), 0.125)
    speeds = [np.where(rng.random(len(v)) < 0.2, rng.uniform(-5, 5, len(v)), v) for v in speeds]
    found, note = without_filler(directions, speeds)
    assert note is None
    for v, given in zip(found, speeds, strict=True):
        np.testing.assert_array_equal(v, given)
