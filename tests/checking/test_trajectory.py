# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Findings about the poses alone, about copies, and about numbers that are none."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.check import check_cheaply
from radarsdf.checking.recording import checked_input
from radarsdf.checking.trajectory import check_jumps

from .breakages import slow


@pytest.fixture(scope="module")
def lap():
    scans = radarsdf.simulate.oculii(frames=60)
    return scans.points, scans.poses


@pytest.fixture(scope="module")
def good(lap):
    """Half of it."""
    points, poses = lap
    return points[:30], poses[:30]


def names(findings):
    return [finding.name for finding in findings if finding.severity != "note"]


def test_a_displacement_from_one_scan_on_is_a_jump(lap):
    points, poses = lap
    poses = poses.copy()
    poses[30:, :3, 3] += poses[30, :3, 1] * 4
    found = check_cheaply(points, poses)
    assert names(found) == ["pose_jumps"]
    assert "after scan 29" in found[0].evidence


@pytest.mark.usefixtures("right_frames")
def test_a_pause_of_the_recording_is_no_jump(good):
    points, poses = good
    kept = [i for i in range(30) if not 12 <= i < 18]
    assert names(check_cheaply([points[i] for i in kept], poses[kept])) == []


@pytest.mark.usefixtures("right_frames")
def test_poses_that_are_held_are_named(good):
    points, poses = good
    assert names(check_cheaply(points, np.repeat(poses[::2], 2, axis=0)))[:1] == ["duplicate_poses"]


@pytest.mark.usefixtures("right_frames")
def test_a_sensor_that_stands_still_is_a_note(good):
    points, poses = good
    still = [0] * 3 + list(range(27))
    found = check_cheaply(
        [p + np.float32(1e-3 * i) for i, p in enumerate(points[j] for j in still)], poses[still]
    )
    assert names(found) == []
    assert "duplicate_poses" in [finding.name for finding in found]


@pytest.mark.usefixtures("right_frames")
def test_copies_of_scans_are_named_by_their_numbers_in_the_recording(good):
    points, poses = good
    points = [points[0][:0], *points[1:5], points[4], *points[6:]]
    found = check_cheaply(points, poses)
    assert names(found) == ["duplicate_scans"]
    assert found[0].evidence == "1 of 29 scans are copies, such as scan 5 of scan 4."


@pytest.mark.parametrize("broken", [lambda poses: poses * np.nan, lambda poses: poses + 1e-2 * np.eye(4)[3]])
def test_matrices_that_are_no_poses_are_named(good, broken):
    points, poses = good
    found = radarsdf.check(points, broken(poses))
    assert [(finding.name, finding.severity) for finding in found] == [("poses_not_rigid", "error")]


@pytest.mark.usefixtures("right_frames")
def test_what_a_fit_leaves_out_is_noted(good):
    points, poses = good
    hole, poses = points[3].copy(), poses.copy()
    hole[::2] = np.nan
    padded = [np.concatenate([scan, np.zeros((3 * len(scan), 3))]) for scan in points[:3]]
    poses[9] = np.nan
    found = check_cheaply([*padded, hole, hole[:0], *points[5:]], poses)
    assert names(found) == ["poses_not_rigid"]
    assert found[0].evidence.startswith("1 of 30 poses are no rigid transforms, the first is pose 9")
    assert {"returns_not_finite", "padding", "empty_scans"} <= {f.name for f in found if f.severity == "note"}
    none = check_cheaply([scan[:0] for scan in points], good[1])
    assert [(finding.name, finding.severity) for finding in none] == [("empty_scans", "error")]


@pytest.mark.usefixtures("right_frames")
def test_utm_coordinates_in_float32_are_named_with_their_steps(good):
    points, poses = good
    poses = poses.copy()
    poses[:, :3, 3] += [4.5e5, 5.4e6, 100.0]
    assert names(check_cheaply(points, poses)) == []
    (found,) = [f for f in check_cheaply(points, poses.astype(np.float32)) if f.severity != "note"]
    assert (found.name, found.severity) == ("positions_rounded", "warning")
    assert "steps of 0.5 m" in found.evidence


@pytest.mark.usefixtures("right_frames")
def test_a_radar_without_elevation_is_named(good):
    points, poses = good
    assert names(check_cheaply([scan * np.float32([1, 1, 0]) for scan in points], poses)) == ["no_elevation"]


@pytest.mark.usefixtures("right_frames")
def test_times_of_nothing_are_named(good):
    assert names(radarsdf.check(*good, times_s=np.zeros(30))) == ["times"]


def test_shapes_that_do_not_fit_are_refused(good):
    points, poses = good
    with pytest.raises(ValueError, match=r"poses must have shape \(30, 4, 4\)"):
        radarsdf.check(points, poses[1:])
    with pytest.raises(ValueError, match="intensities of scan 0 must have shape"):
        radarsdf.check(points, poses, [p[:, :2] for p in points])


@pytest.mark.parametrize("returns", [1, 5])
def test_a_jump_among_scans_of_few_returns_is_no_crash(good, returns):
    points, poses = good
    poses = poses.copy()
    poses[15:, :3, 3] += poses[15, :3, 1] * 40
    few = [scan[:returns] if 10 <= i < 21 else scan for i, scan in enumerate(points)]
    list(check_jumps(checked_input(few, poses), np.arange(30)))
    assert names(check_cheaply([scan[:returns] for scan in points], poses)) in ([], ["pose_jumps"])


def test_a_sensor_that_begins_to_creep_does_not_jump():
    creep = slow("oculii", 0.02, seed=6, cell=0.5)
    assert list(check_jumps(checked_input(creep.points, creep.poses), np.arange(len(creep.points)))) == []
