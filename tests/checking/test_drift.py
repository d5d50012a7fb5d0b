# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses that refinement would mend, as a finding."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.checking import drift
from radarsdf.checking.drift import check_drift
from radarsdf.checking.recording import Recording
from radarsdf.io import Scans
from radarsdf.simulate import drifted

from bench.breakages.__main__ import slow
from tests.conftest import recorded_file

SCANS = 36
CONFIG = radarsdf.FitConfig(num_threads=1)


@pytest.fixture(scope="module")
def drive():
    whole = radarsdf.simulate.wall(seed=62)
    return Scans(whole.points[:SCANS], whole.poses[:SCANS])


def recording(drive, poses, rows=slice(None)):
    return Recording.of(drive.points[rows], poses[rows], None, None, None)


def test_a_drift_is_found_with_its_figures(drive):
    findings = radarsdf.check(drive.points, drifted(drive.poses, 0.05, 0.004, 1))
    (found,) = [finding for finding in findings if finding.name == "poses_drift"]
    assert found.severity == "warning"
    assert "denser where returns that took no part lie" in found.evidence
    assert f"{SCANS} scans end off by" in found.evidence
    assert "radarsdf poses" in found.mend


def test_true_poses_do_not_drift(drive):
    assert check_drift(recording(drive, drive.poses), CONFIG) == []
    assert check_drift(recording(drive, drive.poses, slice(0, 3)), CONFIG) == []


def test_a_gain_without_effect_is_no_drift():
    with np.load(recorded_file("aimotive_motorway/radar.npz")) as drive:
        points = np.split(drive["F_LRR_C_points"], np.cumsum(drive["F_LRR_C_counts"])[:-1])
        poses = drive["F_LRR_C_poses"]
    assert check_drift(Recording.of(points, poses, None, None, None), CONFIG) == []


def test_large_recordings_are_looked_at_in_windows(drive, monkeypatch):
    asked = []
    refine = drift.refine_poses

    def counted(points, poses, **settings):
        asked.append((len(poses), sum(map(len, points))))
        return refine(points, poses, **settings)

    monkeypatch.setattr(drift, "refine_poses", counted)
    monkeypatch.setattr(drift, "_SCANS", 12)
    monkeypatch.setattr(drift, "_RETURNS", 8000)
    (found,) = check_drift(recording(drive, drifted(drive.poses, 0.05, 0.004, 1)), CONFIG)
    assert [scans for scans, _ in asked] == [12, 12, 12]
    assert max(returns for _, returns in asked) <= 8500
    assert "of 3 windows of the recording" in found.evidence


def test_the_drift_is_that_of_the_ends():
    poses = np.tile(np.eye(4), (5, 1, 1))
    found = poses.copy()
    found[-1, :3, 3] = [3, 4, 0]
    assert drift._drift(poses, found) == (5.0, 0.0)


@pytest.mark.parametrize("kind", ["hugin", "forest"])
def test_a_drift_below_the_noise_of_a_coarse_sensor_is_none(kind):
    creep = slow(kind, 0.02, seed=6, cell=0.5)
    assert check_drift(Recording.of(creep.points, creep.poses, None, None, None), CONFIG) == []
