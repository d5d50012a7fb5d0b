# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The verdict, and what a map keeps of refined poses."""

from __future__ import annotations

import json

import numpy as np
import pytest
from radarsdf import RefinedPoses
from radarsdf.map.storage import checked_report
from radarsdf.poses.planes import SensorReturns
from radarsdf.poses.posed import trajectory_report
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
    drive = KINDS["tunnel"](seed=8, frames=16)
    returns = SensorReturns.of(drive.points, 0.1, None)
    held = np.random.default_rng(0).random(len(returns)) < 0.2
    for share in (0.0, 0.5):  # of the distance driven
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


def refined(scans):
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, 0, 3] = np.arange(scans)
    covariance = np.tile(np.diag([1.0, 4, 4, 0.01, 0.01, 0.04]), (scans, 1, 1))
    return RefinedPoses(poses, covariance, True, {"verdict": "Better.", "sigma_m": 0.1, "sigma_rad": 0.02})


def test_it_is_kept_with_the_map():
    found = refined(1201)
    given = found.poses + 0.0
    given[:, 1, 3] = 1
    way = json.loads(json.dumps(trajectory_report(found, given)))
    assert len(way["scans"]) == len(way["before"]) == len(way["after"]) == len(way["sigma_m"]) == 500
    assert way["after"][-1] == [1200, 0, 0]
    assert way["before"][-1] == [1200, 1, 0]
    assert (way["verdict"], way["improved"], way["step_m"]) == ("Better.", True, 0.1)
    assert checked_report({"poses": way})["poses"] == way
    with pytest.raises(ValueError, match=r"report\.poses"):
        checked_report({"poses": 3})
