# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What poses add to the noise of the sensor."""

from __future__ import annotations

import re

import numpy as np
import pytest
import radarsdf


def added_m(points, poses):
    """What the note says that the poses add, m. None without a note."""
    notes = [f.evidence for f in radarsdf.check(points, poses) if f.name == "poses_disagree"]
    return float(re.search(r"about ([0-9.]+) m", notes[0])[1]) if notes else None


@pytest.mark.usefixtures("right_frames")
@pytest.mark.parametrize(("kind", "frames"), [("hugin", 30), ("wall", 20), ("oculii", 50)])
def test_exact_poses_add_nothing(kind, frames):
    scans = getattr(radarsdf.simulate, kind)(frames=frames, seed=1)
    assert added_m(scans.points, scans.poses) is None


def test_heights_that_are_off_from_scan_to_scan_are_found_in_metres():
    scans = radarsdf.simulate.wall(frames=40, seed=1)
    poses = scans.poses.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 0.03, (40, 3))
    assert added_m(scans.points, poses) == pytest.approx(0.03, rel=0.5)


def test_a_way_back_that_has_drifted_is_found():
    scans = radarsdf.simulate.wall(frames=20, seed=1)
    points, rng = list(scans.points), np.random.default_rng(0)
    points += [scan + rng.normal(0, 1e-3, scan.shape) for scan in reversed(scans.points)]
    poses = np.concatenate([scans.poses, scans.poses[::-1]])
    poses[:, :3, 3] += 0.4 * np.linspace(0, 1, 40)[:, None] * poses[0, :3, 1]
    assert added_m(points, poses) > 0.02
