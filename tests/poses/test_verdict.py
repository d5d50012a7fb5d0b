# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Tests of what decides whether poses are better."""

import numpy as np
from radarsdf.poses.planes import SensorReturns
from radarsdf.poses.verdict import Verdict
from radarsdf.returns.noise import SensorNoise

from bench.kinds import KINDS


def test_one_thing_that_moves_does_not_call_poses_improved():
    # The gain of each scan is the same, so that scans alone would be sure of it.
    one, many = _verdict(1), _verdict(60)
    assert one.gain > 0
    assert not one.improved
    assert many.improved


def test_scans_on_top_of_each_other_do_not_agree_better():
    drive = KINDS["tunnel"](seed=8, frames=30)
    returns = SensorReturns.of(drive.points, 0.1, None)
    held = np.random.default_rng(0).random(len(returns)) < 0.2
    for share in (0.0, 0.3, 0.6):  # of the distance driven
        after = drive.poses.copy()
        after[:, :3, 3] *= share
        verdict = Verdict.of(
            returns.select(held), returns.select(~held), drive.poses, after, SensorNoise(0.1, 0.01, 0.01)
        )
        assert verdict.gain > 0  # their density alone says so
        assert not verdict.improved


def _verdict(things: int) -> Verdict:
    """Of poses 0.3 m a scan off the given ones, where a share of all returns lies on so many things that stay only with these."""
    rng, frames = np.random.default_rng(0), 12
    before = np.tile(np.eye(4), (frames, 1, 1))
    after = before.copy()
    after[:, 0, 3] = 0.3 * np.arange(frames)
    places = rng.uniform(-40, 40, (things, 3))
    scans = []
    for pose in after:
        staying = places[rng.integers(0, things, 240)] + rng.normal(0, 0.2, (240, 3)) - pose[:3, 3]
        scans.append(np.concatenate([staying, rng.uniform(-40, 40, (1000, 3))]))
    returns = SensorReturns.of(scans, 0.1, None)
    held = rng.random(len(returns)) < 0.2
    noise = SensorNoise(0.2, 0.001, 0.001)
    return Verdict.of(returns.select(held), returns.select(~held), before, after, noise)
