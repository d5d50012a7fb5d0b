"""Findings about poses alone, duplicate scans, and invalid numbers."""

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.check import check_cheaply
from radarsdf.checking.recording import checked_input
from radarsdf.checking.trajectory import (
    check_duplicates,
    check_jumps,
    check_lengths,
    check_rigid,
    check_rounding,
    check_times,
)

from .breakages import slow


@pytest.fixture(scope="module")
def lap():
    scans = radarsdf.simulate.oculii(frames=60)
    return scans.points, scans.poses


@pytest.fixture(scope="module")
def good(lap):
    """Half of the data."""
    points, poses = lap
    return points[:30], poses[:30]


def along_x(positions_m, range_m=10.0, **arrays):
    """Scans of ten distinct returns at the given ranges, from positions along x."""
    poses = np.tile(np.eye(4), (len(positions_m), 1, 1))
    poses[:, 0, 3] = positions_m
    points = [np.tile([range_m, 1e-9 * i, 0], (10, 1)) for i in range(len(positions_m))]
    return checked_input(points, poses, **arrays)


@pytest.mark.parametrize(
    ("range_m", "severity"),
    [(399, None), (401, "warning"), (999, "warning"), (1001, "error"), (0.21, None), (0.19, "warning"), (0.019, "error")],
)  # fmt: skip
def test_implausible_ranges_are_named(range_m, severity):
    found = list(check_lengths(along_x([0, 1, 2], range_m)))
    assert [(finding.name, finding.severity) for finding in found] == [("units", severity)] * bool(severity)
    assert all(f"are {range_m} m or more" in finding.evidence for finding in found)


@pytest.mark.parametrize(("step_m", "found"), [(9.9, []), (10.5, ["error: 105 m/s"])])
def test_implausible_speeds_are_named(step_m, found):
    positions_m, times_s = step_m * np.arange(4), 0.1 * np.arange(4)
    said = list(check_lengths(along_x(positions_m, times_s=times_s)))
    assert [f"{finding.severity}: {finding.evidence[-8:-1]}" for finding in said] == found
    assert list(check_lengths(along_x(positions_m))) == []


@pytest.mark.parametrize(
    ("positions_m", "severity", "evidence"),
    [([0, 1, 2, 2, 4, 5, 6, 6, 8, 9], "warning", "2 of 10 scans have exactly the pose of the scan before, and the step after is 2.0 times the usual one."),
     ([0, 1, 2, 2, 3.5, 4.5, 5.5, 5.5, 7, 8], "note", "2 of 10 scans have exactly the pose of the scan before."),
     ([0, 0, 2, 2, 4, 4, 6, 6], "warning", "4 of 8 scans have exactly the pose of the scan before, and the step after is 2.0 times the usual one."),
     ([0, 1, 2, 2, 4, 5, 6, 7, 8, 9], "note", "1 of 10 scans have exactly the pose of the scan before.")],
)  # fmt: skip
def test_held_poses_leap_and_stationary_ones_do_not(positions_m, severity, evidence):
    (found,) = check_duplicates(along_x(positions_m), np.arange(len(positions_m)))
    assert (found.name, found.severity, found.evidence) == ("duplicate_poses", severity, evidence)
    for few in ([0, 1, 2], [3, 3, 3]):
        assert list(check_duplicates(along_x(few), np.arange(3))) == []


def test_kinds_of_invalid_transforms_are_distinguished():
    poses = along_x(np.arange(1, 9)).poses
    few, half, columns, left = (poses.copy() for _ in range(4))
    few[[2, 5, 7], 0, 0] = 2
    half[::2, 0, 0] = 2
    columns[:] = columns.transpose(0, 2, 1)
    left[[1, 3, 4, 6], :3, 1] *= -1
    points = [np.ones((10, 3))] * 8
    found = [next(check_rigid(checked_input(points, broken))) for broken in (few, half, columns, left)]
    assert [(finding.name, finding.severity) for finding in found] == [
        ("poses_not_rigid", "warning"), ("poses_not_rigid", "error"), ("poses_transposed", "error"), ("mirrored", "error")
    ]  # fmt: skip
    assert found[0].evidence.startswith("3 of 8 poses are not rigid transforms, the first is pose 2")
    assert found[3].evidence.startswith("4 of 8 poses are left-handed")


def names(findings):
    return [finding.name for finding in findings if finding.severity != "note"]


def test_a_permanent_displacement_is_a_jump(lap):
    points, poses = lap
    poses = poses.copy()
    poses[30:, :3, 3] += poses[30, :3, 1] * 4
    found = check_cheaply(points, poses)
    assert names(found) == ["pose_jumps"]
    step = np.linalg.inv(poses[29]) @ poses[30]
    length_m, turn_deg = np.linalg.norm(step[:3, 3]), np.degrees(np.arccos((np.trace(step) - 2) / 2))
    largest = f"the largest after scan 29: {length_m:.3g} m and {turn_deg:.3g} degrees"
    assert found[0].evidence.startswith(f"1 of 59 steps are jumps, {largest}")
    assert found[0].severity == "warning"


@pytest.mark.usefixtures("right_frames")
def test_a_pause_of_the_recording_is_no_jump(good):
    points, poses = good
    kept = [i for i in range(30) if not 12 <= i < 18]
    assert names(check_cheaply([points[i] for i in kept], poses[kept])) == []


@pytest.mark.usefixtures("right_frames")
def test_copies_of_scans_are_named_by_their_numbers_in_the_recording(good):
    points, poses = good
    points = [points[0][:0], *points[1:5], points[4], *points[6:]]
    found = check_cheaply(points, poses)
    assert names(found) == ["duplicate_scans"]
    assert found[0].evidence == "1 of 29 scans are copies, such as scan 5 of scan 4."


@pytest.mark.parametrize("broken", [lambda poses: poses * np.nan, lambda poses: poses + 1e-2 * np.eye(4)[3]])
def test_invalid_poses_are_named(good, broken):
    points, poses = good
    found = radarsdf.check(points, broken(poses))
    assert [(finding.name, finding.severity) for finding in found] == [("poses_not_rigid", "error")]


@pytest.mark.usefixtures("right_frames")
def test_returns_excluded_from_a_fit_are_noted(good):
    points, poses = good
    hole, poses = points[3].copy(), poses.copy()
    hole[::2] = np.nan
    padded = [np.concatenate([scan, np.zeros((3 * len(scan), 3))]) for scan in points[:3]]
    poses[9] = np.nan
    found = check_cheaply([*padded, hole, hole[:0], *points[5:]], poses)
    assert names(found) == ["poses_not_rigid"]
    assert found[0].evidence.startswith("1 of 30 poses are not rigid transforms, the first is pose 9")
    total = sum(map(len, padded)) + len(hole) + sum(map(len, points[5:]))
    zeros = sum(len(scan) for scan in padded) * 3 // 4
    notes = {finding.name: finding.evidence for finding in found if finding.severity == "note"}
    assert notes["returns_not_finite"].startswith(f"{-(-len(hole) // 2)} of {total} returns")
    assert notes["padding"].startswith(f"{zeros} of {total} returns are no measurements")
    assert notes["empty_scans"] == "1 of 30 scans have no returns, the first is scan 4."
    none = check_cheaply([scan[:0] for scan in points], good[1])
    assert [(finding.name, finding.severity) for finding in none] == [("empty_scans", "error")]


@pytest.mark.usefixtures("right_frames")
@pytest.mark.parametrize("far_m", [300.0, 65_535.0])
def test_a_range_that_stands_for_no_return_is_named(good, far_m):
    points, poses = good
    assert "range_sentinel" not in names(check_cheaply(points, poses))
    broken = [scan.astype(np.float32) for scan in points]
    for scan in broken:
        scan[::90] *= far_m / np.linalg.norm(scan[::90], axis=1, keepdims=True)
    found = check_cheaply(broken, poses)
    assert "range_sentinel" in names(found)
    assert any(finding.name == "far_returns" for finding in found) == (far_m > 1000)


@pytest.mark.usefixtures("right_frames")
def test_utm_coordinates_in_float32_are_named_with_their_resolution(good):
    points, poses = good
    poses = poses.copy()
    poses[:, :3, 3] += [4.5e5, 5.4e6, 100.0]
    assert names(check_cheaply(points, poses)) == []
    (found,) = [f for f in check_cheaply(points, poses.astype(np.float32)) if f.severity != "note"]
    assert (found.name, found.severity) == ("positions_rounded", "warning")
    assert "steps of 0.5 m" in found.evidence
    assert list(check_rounding(along_x(np.float32([1.3e5, 1.31e5])))) == []  # 0.0078 m
    assert "steps of 0.0156 m" in next(check_rounding(along_x(np.float32([0, 1.32e5])))).evidence


@pytest.mark.usefixtures("right_frames")
def test_implausible_times_are_named(good):
    assert names(radarsdf.check(*good, times_s=np.zeros(30))) == ["times"]
    (found,) = check_times(along_x([0, 1, 2, 3], times_s=[0, 1, 1, np.nan]))
    assert found.evidence.startswith("2 of 3 times are not later than the one before")
    assert list(check_times(along_x([0, 1, 2], times_s=[0, 1, 2]))) == []


def test_inconsistent_shapes_are_rejected(good):
    points, poses = good
    with pytest.raises(ValueError, match=r"poses must have shape \(30, 4, 4\)"):
        radarsdf.check(points, poses[1:])
    with pytest.raises(ValueError, match="intensities of scan 0 must have shape"):
        radarsdf.check(points, poses, [p[:, :2] for p in points])


@pytest.mark.parametrize("returns", [1, 5])
def test_a_jump_among_sparse_scans_does_not_crash(good, returns):
    points, poses = good
    poses = poses.copy()
    poses[15:, :3, 3] += poses[15, :3, 1] * 40
    few = [scan[:returns] if 10 <= i < 21 else scan for i, scan in enumerate(points)]
    list(check_jumps(checked_input(few, poses), np.arange(30)))
    assert names(check_cheaply([scan[:returns] for scan in points], poses)) in ([], ["pose_jumps"])


def test_a_sensor_that_starts_slowly_does_not_jump():
    creep = slow("oculii", 0.02, seed=6, cell=0.5)
    assert list(check_jumps(checked_input(creep.points, creep.poses), np.arange(len(creep.points)))) == []
