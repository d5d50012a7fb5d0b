# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Good data have no finding worse than a note; broken in one way, the finding is named."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.check import check_cheaply

from tests.conftest import recorded_scans

_CAMERA_OF_RADAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def with_positions(poses, positions):
    moved = poses.copy()
    moved[:, :3, 3] = positions
    return moved


def in_world(points, poses):
    return [scan @ pose[:3, :3].T + pose[:3, 3] for scan, pose in zip(points, poses, strict=True)]


BREAKAGES = {
    "points_in_world_frame": lambda points, poses: (in_world(points, poses), poses),
    "poses_inverted": lambda points, poses: (points, np.linalg.inv(poses)),
    "camera_frame": lambda points, poses: ([p @ _CAMERA_OF_RADAR.T for p in points], poses),
    "mirrored": lambda points, poses: ([p * [1, -1, 1] for p in points], poses),
    "axes_swapped": lambda points, poses: ([p[:, [1, 0, 2]] for p in points], poses),
    "units": lambda points, poses: (points, with_positions(poses, 100 * poses[:, :3, 3])),
}


def worse_than_notes(findings):
    return [finding.name for finding in findings if finding.severity != "note"]


@pytest.fixture(scope="module", params=["wall", "astyx", "oculii"])
def good(request):
    scans = getattr(radarsdf.simulate, request.param)(
        frames={"wall": 24, "astyx": 12, "oculii": 48}[request.param]
    )
    return scans.points, scans.poses


def test_good_data_have_no_finding(good):
    assert worse_than_notes(radarsdf.check(*good)) == []
    assert worse_than_notes(check_cheaply(*good)) == []


@pytest.mark.parametrize("finding", BREAKAGES)
def test_a_breakage_is_named(good, finding):
    found = radarsdf.check(*BREAKAGES[finding](*good))
    assert (found[0].name, found[0].severity) == (finding, "error")


def test_far_from_the_origin_nothing_changes(good):
    points, poses = good
    far = with_positions(poses, poses[:, :3, 3] + [4.5e5, 5.4e6, 100.0])
    assert worse_than_notes(radarsdf.check(points, far)) == []
    assert radarsdf.check(*BREAKAGES["poses_inverted"](points, far))[0].name == "poses_inverted"
    assert radarsdf.check(*BREAKAGES["points_in_world_frame"](points, far))[0].name == "points_in_world_frame"


def test_the_same_data_give_the_same_findings(good):
    broken = BREAKAGES["mirrored"](*good)
    assert radarsdf.check(*broken) == radarsdf.check(*broken)


def test_millimetres_on_both_sides_are_found_by_the_ranges(good):
    points, poses = good
    found = radarsdf.check([1000 * p for p in points], with_positions(poses, 1000 * poses[:, :3, 3]))
    assert (found[0].name, found[0].severity) == ("units", "error")


def test_a_clock_that_is_off_is_found_where_the_motion_changes():
    scans = radarsdf.simulate.wall(frames=30)
    found = radarsdf.check(scans.points[1:], scans.poses[:-1])
    assert "clock_offset" in worse_than_notes(found)


@pytest.mark.parametrize("name", ["r0009_0024", "r0057_0068", "r0133_0142", "r0144_0167", "r0309_0320"])
def test_recorded_drives_have_no_finding_until_their_poses_are_inverted(name):
    with np.load(recorded_scans(name)) as drive:
        points = [drive["points"][drive["frame"] == i] for i in range(len(drive["poses"]))]
        poses = drive["poses"]
    assert worse_than_notes(radarsdf.check(points, poses)) == []
    assert radarsdf.check(points, np.linalg.inv(poses))[0].name == "poses_inverted"
