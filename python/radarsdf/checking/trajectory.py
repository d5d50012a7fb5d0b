# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Checks of the trajectory: rigid transforms, rounding, units, times, duplicates, jumps."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checking.agreement import MIN_RETURNS, Agreement, Comparison, relative
from radarsdf.checking.frames import FULL, Effort
from radarsdf.checking.recording import Finding, FloatArray, Recording, Severity
from radarsdf.checks import are_rigid
from radarsdf.poses.rigid import steps, turned_by
from radarsdf.returns.moving import folding_interval_mps, sensor_velocity

_MAX_ROTATION_ERROR = 1e-3  # as of the poses that a fit accepts
# No radar that gives points sees most of them from farther away, and none has most of them at its own housing.
_FAR_M, _VERY_FAR_M, _NEAR_M = 400.0, 1000.0, 0.2
_COARSE_M = 0.01  # steps of positions. Smaller ones are less than the noise of any radar
_FAST_MPS = 100.0  # faster than cars and drones
_JUMP = 3.0  # times the steps round it
_LEAST_JUMP = 0.2  # in distances between returns of a scan: smaller ones are below what scans measure
_ROUND = 3  # steps before and after
_JUMPS_TRIED = 12
_MIN_GAIN, _MIN_SIGNIFICANCE = 0.1, 3.0  # as in frames.py; few pairs lie across a jump
_CLOSES = 0.5  # of the difference to scans beside the jump
_DOPPLER_SLACK_M = 1.0  # a step may be longer by this than the speed allows twice
_CAUGHT_UP = 1.5  # times the median step


def check_rigid(recording: Recording) -> Iterator[Finding]:
    """Whether the matrices are rigid transforms, and what they may be if not."""
    poses, usable = recording.poses, are_rigid(recording.poses)
    count, wrong = len(poses), int((~usable).sum())
    if wrong == 0:
        return
    which = f"{wrong} of {count} poses are no rigid transforms, the first is pose {np.argmin(usable)}"
    from_quaternions = "Make rotations from unit quaternions in the order x y z w, or from angles in rad."
    if 2 * wrong < count:
        yield Finding(
            "poses_not_rigid", "warning", f"{which}.", f"A fit leaves out their scans. {from_quaternions}"
        )
        return
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    last = np.array([0.0, 0, 0, 1])
    ends = (poses[:, 3] == last).all(axis=1)
    pose = poses[np.argmin(usable)]
    rotations = np.where(finite[:, None, None], poses[:, :3, :3], np.eye(3))
    products = rotations @ rotations.transpose(0, 2, 1)
    orthogonal = np.abs(products - np.eye(3)).max(axis=(1, 2)) < _MAX_ROTATION_ERROR
    left_handed = np.linalg.det(rotations) < 0
    scale2 = float(np.trace(products[np.argmin(usable)])) / 3
    scaled = np.abs(products[np.argmin(usable)] / max(scale2, 1e-300) - np.eye(3)).max() < _MAX_ROTATION_ERROR
    name, evidence, mend = next(
        texts
        for holds, *texts in (
            (
                not finite.all(),
                "poses_not_rigid",
                f"{(~finite).sum()} of {count} poses are not finite, the first is pose {np.argmin(finite)}.",
                "Leave out these poses and their scans.",
            ),
            (
                (poses[:, :, 3] == last).all() and not ends.all(),
                "poses_transposed",
                "The translations are in the last row of the poses, and the last column is 0 0 0 1.",
                "Transpose each pose: poses.transpose(0, 2, 1).",
            ),
            (
                orthogonal.all() and left_handed.any(),
                "mirrored",
                f"{left_handed.sum()} of {count} poses are left-handed: their rotations have determinant -1.",
                "Use right-handed frames: x forward, y left, z up.",
            ),
            (
                not (pose[3] == last).all(),
                "poses_not_rigid",
                f"{which}: its last row is not 0 0 0 1.",
                "Make each pose of a rotation and a position.",
            ),
            (
                scaled,
                "poses_not_rigid",
                f"{which}: its rotation is multiplied by {np.sqrt(scale2):.4g}.",
                "Divide the rotations by this factor; a scaled map has positions without a metre.",
            ),
            (
                True,
                "poses_not_rigid",
                f"{which}: the rows of its rotation are not orthogonal, with numbers up to {np.abs(pose[:3, :3]).max():.3g}.",
                from_quaternions,
            ),
        )
        if holds
    )
    yield Finding(name, "error", evidence, mend)


def check_rounding(recording: Recording) -> Iterator[Finding]:
    """Whether the positions were rounded to float32 far from the origin, as with UTM coordinates."""
    positions = recording.poses[:, :3, 3]
    rounded = positions.astype(np.float32)
    step_m = float(np.spacing(np.abs(rounded).max()))
    if step_m >= _COARSE_M and (rounded == positions).all():
        yield Finding(
            "positions_rounded",
            "warning",
            f"The positions of the poses are float32, which has steps of {step_m:.3g} m there: they are off by up to "
            f"{step_m / 2:.3g} m.",
            "Keep poses in float64, or subtract an origin before they become float32.",
        )


def check_lengths(recording: Recording) -> Iterator[Finding]:
    """Whether ranges and speeds can be in metres. The poses must be finite."""
    scans = (
        np.asarray(recording.points[i], np.float64)
        for i in recording.some_scans()
        if len(recording.points[i])
    )
    medians = [float(np.median(np.linalg.norm(scan, axis=1))) for scan in scans]
    median_m = float(np.median(medians)) if medians else 1.0
    mend = "Pass points and positions in metres."
    if median_m > _FAR_M or median_m < _NEAR_M:
        # Points of a world frame far from its origin, such as UTM, have no ranges. Their distances to the sensor do.
        severity: Severity = "error" if median_m > _VERY_FAR_M or median_m < _NEAR_M / 10 else "warning"
        yield Finding(
            "units", severity, f"Half of the returns are {median_m:.4g} m or more from the sensor.", mend
        )
    elif recording.ascending_times_s is not None and len(recording) > 2:
        speed = float(np.median(_steps_m(recording) / np.diff(recording.ascending_times_s)))
        if speed > _FAST_MPS:
            yield Finding("units", "error", f"By its poses, the sensor moves at {speed:.4g} m/s.", mend)


def check_times(recording: Recording) -> Iterator[Finding]:
    """Whether the times can be those of the scans."""
    times = recording.times_s
    if times is None or len(times) < 2 or recording.ascending_times_s is not None:
        return
    infinite, waits = int((~np.isfinite(times)).sum()), np.diff(times)
    evidence, mend = next(
        texts
        for holds, *texts in (
            (
                infinite,
                f"{infinite} of {len(times)} times are not finite: none is used.",
                "Leave out these scans.",
            ),
            (
                (waits == 0).all(),
                f"All scans have the time {times[0]:g} s.",
                "Use the times of record, if those of the messages were never set.",
            ),
            (
                True,
                f"{(waits <= 0).sum()} of {len(waits)} times are not later than the one before.",
                "Sort scans, poses and times together, and leave out scans that come twice.",
            ),
        )
        if holds
    )
    yield Finding("times", "warning", evidence, mend)


def check_duplicates(recording: Recording) -> Iterator[Finding]:
    """Whether scans, or the poses of different scans, are the same."""
    first_of: dict[tuple[object, ...], int] = {}
    repeated = []
    for i, scan in enumerate(recording.points):
        if len(scan) < MIN_RETURNS:
            continue
        key = (len(scan), *scan[0].tolist(), *scan[-1].tolist())
        same = first_of.setdefault(key, i)
        if same != i and np.array_equal(recording.points[same], scan):
            repeated.append((same, i))
    if repeated:
        yield Finding(
            "duplicate_scans",
            "warning",
            f"{len(repeated)} of {len(recording)} scans are copies of another one, such as scan {repeated[0][1]} of "
            f"scan {repeated[0][0]}.",
            "Leave out the copies: they count as measurements that never were.",
        )
    if len(recording) < 3:
        return
    same_pose = (recording.poses[1:] == recording.poses[:-1]).all(axis=(1, 2))
    same_pose[[later - 1 for earlier, later in repeated if later == earlier + 1]] = False
    lengths = _steps_m(recording)
    moving = lengths[~same_pose]
    if not same_pose.any() or not len(moving):
        return
    # A sensor that stands still has such poses too. One whose poses are held catches up with a leap.
    after = lengths[1:][same_pose[:-1] & ~same_pose[1:]]
    plain = lengths[1:][~same_pose[:-1] & ~same_pose[1:]]
    usual = float(np.median(plain)) if len(plain) >= _ROUND else float(np.median(moving)) / 2
    held = len(after) >= 2 and float(np.median(after)) > _CAUGHT_UP * usual > 0
    leap = f", and the step after is {np.median(after) / usual:.1f} times the usual one" if held else ""
    yield Finding(
        "duplicate_poses",
        "warning" if held else "note",
        f"{same_pose.sum()} of {len(recording)} scans have exactly the pose of the scan before{leap}.",
        "Interpolate the poses at the times of the scans."
        if held
        else "Nothing needs to be done where the sensor stood still.",
    )


def check_jumps(recording: Recording, effort: Effort = FULL) -> list[Finding]:
    """Where the trajectory jumps: a step far longer than those round it, without which the scans agree better.

    A recording that pauses while the sensor moves has long steps too; then the scans agree with them.
    """
    count = len(recording)
    if count < 2 * _ROUND:
        return []
    poses = recording.poses
    durations = np.ones(count - 1)
    if recording.ascending_times_s is not None:
        durations = np.diff(recording.ascending_times_s)
    sizes = _sizes(recording) / durations
    changes = _changes(recording, durations)
    usual = float(np.median(changes))
    suspects = np.flatnonzero(changes > _JUMP * max(usual, 0.1 * float(np.median(sizes)))).tolist()
    agreement = Agreement(recording.points, effort.returns, 2 * effort.queries)
    suspects = [k for k in suspects if changes[k] * durations[k] > _LEAST_JUMP * agreement.spacing_m(k)]
    suspects = sorted(sorted(suspects, key=lambda k: -changes[k])[:_JUMPS_TRIED])
    interval = None if recording.doppler_mps is None else folding_interval_mps(recording.doppler_mps)
    confirmed = [
        k
        for k in suspects
        if _faster_than_doppler(recording, k, interval)
        or _agree_without(recording, agreement, k, suspects, durations)
    ]
    if not confirmed:
        return []
    worst = max(confirmed, key=lambda k: changes[k])
    step = float(np.linalg.norm(poses[worst + 1, :3, 3] - poses[worst, :3, 3]))
    turn = float(np.degrees(_turns(recording)[worst]))
    return [
        Finding(
            "pose_jumps",
            "error" if len(confirmed) > count // 10 else "warning",
            f"{len(confirmed)} of {count - 1} steps are jumps, the largest after scan {worst}: {step:.3g} m and "
            f"{turn:.3g} degrees, off the motion round it by {changes[worst] / max(usual, 1e-9):.0f} times the usual; Doppler or the agreement of the scans denies it.",
            "Use poses that were smoothed over the whole drive, or leave out the scans at the jumps.",
        )
    ]


def _faster_than_doppler(recording: Recording, jump: int, interval_mps: float | None) -> bool:
    """Whether a step is far longer than the speeds by the Doppler of the scans before and after it allow."""
    times = recording.times_s
    if recording.doppler_mps is None or times is None or not times[jump + 1] > times[jump]:
        return False
    velocities = [
        sensor_velocity(recording.points[i], recording.doppler_mps[i], interval_mps=interval_mps).velocity_mps
        for i in (jump, jump + 1)
    ]
    way = float(np.linalg.norm(velocities, axis=1).max() * (times[jump + 1] - times[jump]))
    return bool(_steps_m(recording)[jump] > 2 * way + _DOPPLER_SLACK_M)  # False for NaN: no velocity


def _agree_without(
    recording: Recording, agreement: Agreement, jump: int, suspects: list[int], durations: FloatArray
) -> bool:
    """Whether the scans round a step agree clearly better if it is replaced by the motion of the steps round it.

    If that mends the poses, the scans then agree about as well as those beside the step do. Without that condition,
    scans that see different things would agree better wherever the replaced motion makes their fields of view overlap.
    """
    poses = recording.poses
    near = [
        k for k in range(max(0, jump - _ROUND), min(len(poses) - 1, jump + 1 + _ROUND)) if k not in suspects
    ]
    if not near:
        return False
    motions = steps(poses)
    replaced = motions.copy()
    for k in {jump, *(s for s in suspects if abs(s - jump) <= 1)}:
        nearest = min(near, key=lambda n: abs(n - k))
        factor = durations[k] / durations[nearest]
        replaced[k] = np.eye(4)
        vector = Rotation.from_matrix(motions[nearest, :3, :3]).as_rotvec()
        replaced[k, :3, :3] = Rotation.from_rotvec(factor * vector).as_matrix()
        replaced[k, :3, 3] = factor * motions[nearest, :3, 3]
    scans = [i for i in range(jump - _ROUND + 1, jump + _ROUND + 1) if 0 <= i < len(poses)]
    scans = [i for i in scans if len(recording.points[i]) >= MIN_RETURNS]
    all_pairs = [(i, j) for i in scans for j in scans if i < j]
    if not all_pairs:
        return False
    beside = [(i, j) for i, j in all_pairs if not any(i <= k < j for k in suspects)]
    across = [(i, j) for i, j in all_pairs if i <= jump < j]
    # Either all is displaced from here on, or one pose is, and the step after takes it back.
    choices = [across] + [[(i, j) for i, j in all_pairs if k in {i, j}] for k in (jump, jump + 1)]
    regular = np.array(beside or all_pairs, np.int64)
    usual = float(agreement.scores(regular, relative(poses, regular)[None]).mean())
    for chosen in choices:
        if len(chosen) < 2:
            continue
        pairs = np.array(chosen, np.int64)
        other = np.stack([functools.reduce(np.matmul, replaced[i:j]) for i, j in chosen])
        scores = agreement.scores(pairs, np.stack([relative(poses, pairs), np.linalg.inv(other)]))
        comparison = Comparison.of(scores[0], scores[1:])
        gain = float(comparison.gains[0])
        closes = gain > _CLOSES * (float(scores[0].mean()) - usual)
        if gain > _MIN_GAIN and comparison.significance[0] > _MIN_SIGNIFICANCE and closes:
            return True
    return False


def _changes(recording: Recording, durations: FloatArray) -> FloatArray:
    """(F - 1,) how far each motion is off the median of those round it, for one unit of time, m.

    Turns count as ways of the returns at a typical range.
    """
    motions = steps(recording.poses)
    turns = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec() * _typical_range_m(recording)
    vectors = np.concatenate([motions[:, :3, 3], turns], axis=1) / durations[:, None]
    changes = np.zeros(len(vectors))
    for k in range(len(vectors)):
        others = np.concatenate([vectors[max(0, k - _ROUND) : k], vectors[k + 1 : k + 1 + _ROUND]])
        changes[k] = np.linalg.norm(vectors[k] - np.median(others, axis=0))
    return changes


def _steps_m(recording: Recording) -> FloatArray:
    """(F - 1,) lengths of the steps between poses."""
    lengths: FloatArray = np.linalg.norm(np.diff(recording.poses[:, :3, 3], axis=0), axis=1)
    return lengths


def _turns(recording: Recording) -> FloatArray:
    """(F - 1,) angles between poses, rad."""
    return turned_by(recording.poses[:-1], recording.poses[1:])


def _sizes(recording: Recording) -> FloatArray:
    """(F - 1,) lengths of the steps, with turns as ways of the returns at a typical range, m."""
    return np.hypot(_steps_m(recording), _typical_range_m(recording) * _turns(recording))


def _typical_range_m(recording: Recording) -> float:
    some = [np.asarray(recording.points[i], np.float64) for i in recording.some_scans(10)]
    return float(np.median([np.median(np.linalg.norm(scan, axis=1)) for scan in some]))
