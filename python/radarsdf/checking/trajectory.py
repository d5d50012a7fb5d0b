"""Checks of the trajectory: rigid transforms, rounding, units, times, duplicates, jumps."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from radarsdf.arrays import Floats, Ints
from radarsdf.checking.agreement import MIN_RETURNS, Agreement, Comparison, relative
from radarsdf.checking.frames import FULL, Effort
from radarsdf.checking.recording import Finding, ascending_times_s, some_points
from radarsdf.checks import are_rigid
from radarsdf.poses.checked_scans import median_range_m
from radarsdf.poses.rigid import step_vectors, transform
from radarsdf.scans import Scans

# No imaging radar has most of its returns beyond the first two ranges, or within the third, at its own housing.
_FAR_M, _VERY_FAR_M, _NEAR_M = 400.0, 1000.0, 0.2
_COARSE_M = 0.01  # spacing of positions: finer rounding is below the noise of any radar
_FAST_MPS = 100.0  # faster than cars and drones
_JUMP = 3.0  # ratio to the neighbouring steps
_LEAST_JUMP = 0.2  # smallest jump, in spacings of a scan's returns: the resolution
_NEAR = 3  # neighbouring steps on each side
_JUMPS_TRIED = 12
_MIN_GAIN, _MIN_SIGNIFICANCE = 0.1, 3.0  # as in frames.py; few pairs straddle a jump
_CLOSES = 0.5  # share of the difference to scans next to the jump
_CAUGHT_UP = 1.5  # ratio to the median step


def check_rigid(recording: Scans) -> Iterator[Finding]:
    """Check that the matrices are rigid transforms, and diagnose those that are not."""
    poses, usable = recording.poses, are_rigid(recording.poses)
    count, wrong, first = len(poses), int((~usable).sum()), int(np.argmin(usable))
    if wrong == 0:
        return
    name = "poses_not_rigid"
    evidence = f"{wrong} of {count} poses are not rigid transforms, the first is pose {first}: {poses[first].round(3).tolist()}."
    if 2 * wrong >= count:
        if are_rigid(poses.transpose(0, 2, 1)).all():
            name, evidence = "poses_transposed", "The translations are in the last row of the poses."
        elif (are_rigid(poses * [1.0, -1, 1, 1]) | usable).all():
            name = "mirrored"
            evidence = f"{wrong} of {count} poses are left-handed: their rotations have determinant -1."
    yield Finding(name, "warning" if 2 * wrong < count else "error", evidence)


def check_rounding(recording: Scans) -> Iterator[Finding]:
    """Check for positions rounded to float32 far from the origin, as with UTM coordinates."""
    positions = recording.poses[:, :3, 3]
    rounded = positions.astype(np.float32)
    step_m = float(np.spacing(np.abs(rounded).max()))
    if step_m >= _COARSE_M and (rounded == positions).all():
        evidence = f"The positions of the poses are float32, which has steps of {step_m:.3g} m there."
        yield Finding("positions_rounded", "warning", evidence)


def check_lengths(recording: Scans) -> Iterator[Finding]:
    """Check whether ranges and speeds are plausible in metres. The poses must be finite."""
    range_m, times = median_range_m(some_points(recording)), ascending_times_s(recording)
    if range_m > _FAR_M or range_m < _NEAR_M:
        # World points far from the origin, such as UTM, have no ranges; distances from the sensor replace them.
        error = range_m > _VERY_FAR_M or range_m < _NEAR_M / 10
        evidence = f"Half of the returns are {range_m:.4g} m or more from the sensor."
        yield Finding("units", "error" if error else "warning", evidence)
    elif times is not None and len(recording) > 2:
        speed = float(np.median(_steps_m(recording) / np.diff(times)))
        if speed > _FAST_MPS:
            yield Finding("units", "error", f"By its poses, the sensor moves at {speed:.4g} m/s.")


def check_times(recording: Scans) -> Iterator[Finding]:
    times = recording.times_s
    if times is None or len(times) < 2 or ascending_times_s(recording) is not None:
        return
    wrong = int((~(np.diff(times) > 0)).sum())
    late = f"{wrong} of {len(times) - 1} times are not later than the one before"
    evidence = f"{late}, or not finite: none is used."
    yield Finding("times", "warning", evidence)


def check_duplicates(recording: Scans, numbers: Ints) -> Iterator[Finding]:
    """Check for duplicate scans, or poses shared by different scans. `numbers` (F,): of the scans, for messages."""
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
        first, copy = numbers[list(repeated[0])]
        count = f"{len(repeated)} of {len(recording)}"
        evidence = f"{count} scans are copies, such as scan {copy} of scan {first}."
        yield Finding("duplicate_scans", "warning", evidence)
    same_pose = (recording.poses[1:] == recording.poses[:-1]).all(axis=(1, 2))
    same_pose[[later - 1 for earlier, later in repeated if later == earlier + 1]] = False
    lengths = _steps_m(recording)
    if len(recording) < 3 or not same_pose.any() or same_pose.all():
        return
    # A stationary sensor has equal poses too. One whose poses are held catches up with a leap.
    after = lengths[1:][same_pose[:-1] & ~same_pose[1:]]
    plain = lengths[1:][~same_pose[:-1] & ~same_pose[1:]]
    usual = float(np.median(plain)) if len(plain) >= _NEAR else float(np.median(lengths[~same_pose])) / 2
    held = len(after) >= 2 and float(np.median(after)) > _CAUGHT_UP * usual > 0
    evidence = f"{same_pose.sum()} of {len(recording)} scans have exactly the pose of the scan before"
    leap = f", and the step after is {np.median(after) / usual:.1f} times the usual one" if held else ""
    yield Finding("duplicate_poses", "warning" if held else "note", f"{evidence}{leap}.")


def check_jumps(recording: Scans, numbers: Ints, effort: Effort = FULL) -> Iterator[Finding]:
    """Find jumps: steps far longer than their neighbours, without which the scans agree better.

    A recording that pauses while the sensor moves has long steps too, but the scans agree with them.
    """
    count, times = len(recording), ascending_times_s(recording)
    if count < 2 * _NEAR:
        return
    durations = np.ones(count - 1) if times is None else np.diff(times)
    # Rotations count as the displacement of returns at a typical range.
    moved = step_vectors(recording.poses)
    lever_m = np.repeat([1.0, median_range_m(some_points(recording))], 3)
    vectors = moved * lever_m / durations[:, None]
    changes = np.zeros(len(vectors))
    for k in range(len(vectors)):
        others = np.concatenate([vectors[max(0, k - _NEAR) : k], vectors[k + 1 : k + 1 + _NEAR]])
        changes[k] = np.linalg.norm(vectors[k] - np.median(others, axis=0))
    usual = float(np.median(changes))
    least = _JUMP * max(usual, 0.1 * float(np.median(np.linalg.norm(vectors, axis=1))))
    agreement = Agreement(recording.points, effort.returns, 2 * effort.queries)
    jumps = np.flatnonzero(changes > least).tolist()
    suspects = [k for k in jumps if changes[k] * durations[k] > _LEAST_JUMP * agreement.spacing_m(k)]
    suspects = sorted(sorted(suspects, key=lambda k: -changes[k])[:_JUMPS_TRIED])
    confirmed = [k for k in suspects if _agree_without(recording, agreement, k, suspects, moved, durations)]
    if confirmed:
        worst = max(confirmed, key=lambda k: changes[k])
        step_m, turn_deg = np.linalg.norm(moved[worst, :3]), np.degrees(np.linalg.norm(moved[worst, 3:]))
        evidence = (
            f"{len(confirmed)} of {count - 1} steps are jumps, the largest after scan {numbers[worst]}: {step_m:.3g} m and "
            f"{turn_deg:.3g} degrees; without them, the scans agree better."
        )
        yield Finding("pose_jumps", "error" if len(confirmed) > count // 10 else "warning", evidence)


def _agree_without(
    recording: Scans, agreement: Agreement, jump: int, suspects: list[int], moved: Floats, durations: Floats
) -> bool:
    """Whether the scans near a step agree clearly better if it is replaced by the motion of the neighbouring steps."""
    # If that repairs the poses, the scans then agree about as well as those next to the step. Without this condition,
    # scans that observe different things would agree better wherever the replaced motion makes their fields of view overlap.
    poses = recording.poses
    near = [k for k in range(jump - _NEAR, jump + 1 + _NEAR) if 0 <= k < len(moved) and k not in suspects]
    if not near:
        return False
    replaced = transform(moved[:, 3:], moved[:, :3])
    for k in {jump, *(s for s in suspects if abs(s - jump) <= 1)}:
        nearest = min(near, key=lambda n: abs(n - k))
        factor = durations[k] / durations[nearest]
        replaced[k] = transform(factor * moved[nearest, 3:], factor * moved[nearest, :3])
    scans = [i for i in range(jump - _NEAR + 1, jump + _NEAR + 1) if 0 <= i < len(poses)]
    scans = [i for i in scans if len(recording.points[i]) >= MIN_RETURNS]
    pairs = [(i, j) for i in scans for j in scans if i < j]
    if not pairs:
        return False
    regular = [(i, j) for i, j in pairs if not any(i <= k < j for k in suspects)] or pairs
    usual = float(agreement.scores(np.array(regular), relative(poses, np.array(regular))[None]).mean())
    # Either all poses from here on are displaced, or only one is, and the next step reverts it.
    across = [(i, j) for i, j in pairs if i <= jump < j]
    for chosen in (across, *([pair for pair in pairs if k in pair] for k in (jump, jump + 1))):
        if len(chosen) < 2:
            continue
        rows = np.array(chosen, np.int64)
        other = np.stack([functools.reduce(np.matmul, replaced[i:j]) for i, j in chosen])
        scores = agreement.scores(rows, np.stack([relative(poses, rows), np.linalg.inv(other)]))
        comparison = Comparison.of(scores[0], scores[1:])
        gain = float(comparison.gains[0])
        closes = gain > _CLOSES * (float(scores[0].mean()) - usual)
        if gain > _MIN_GAIN and comparison.significance[0] > _MIN_SIGNIFICANCE and closes:
            return True
    return False


def _steps_m(recording: Scans) -> Floats:
    """(F - 1,) lengths of the steps between poses."""
    return np.linalg.norm(np.diff(recording.poses[:, :3, 3], axis=0), axis=1)
