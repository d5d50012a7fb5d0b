"""Checks of the trajectory: rigid transforms, rounding, units, times, duplicates, jumps, drift, and faults that refined poses would hide."""

import functools
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats, Ints
from radarsdf.checking.frames import FULL, Effort
from radarsdf.checking.recording import COARSE_M, Finding, ascending_times_s, some_points
from radarsdf.checks import are_rigid
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import LAGS, MIN_RETURNS, Agreement, Gain, relative
from radarsdf.poses.checked_scans import median_range_m
from radarsdf.poses.refine import refine_poses
from radarsdf.poses.rigid import lengths_of_steps_m, nearest_rotation, step_vectors, transform
from radarsdf.returns.noise import SensorNoise
from radarsdf.scans import Scans

# No imaging radar has most of its returns beyond the first two ranges, or within the third, at its own housing.
_FAR_M, _VERY_FAR_M, _NEAR_M = 400.0, 1000.0, 0.2
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
    if step_m >= COARSE_M and (rounded == positions).all():
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
        speed = float(np.median(lengths_of_steps_m(recording.poses) / np.diff(times)))
        if speed > _FAST_MPS:
            yield Finding("units", "error", f"By its poses, the sensor moves at {speed:.4g} m/s.")


def check_times(recording: Scans) -> Iterator[Finding]:
    times = recording.times_s
    if times is None or len(times) < 2 or ascending_times_s(recording) is not None:
        return
    wrong, count = int((~(np.diff(times) > 0)).sum()), len(times) - 1
    evidence = f"{wrong} of {count} times are not later than the one before, or not finite: none is used."
    yield Finding("times", "warning", evidence)


def check_duplicates(recording: Scans, numbers: Ints) -> Iterator[Finding]:
    """Check for duplicate scans, or poses shared by different scans. `numbers` (F,): of the scans, for messages."""
    first_of: dict[tuple[object, ...], int] = {}
    repeated = []
    for i, scan in enumerate(recording.points):
        if len(scan) < MIN_RETURNS:
            continue
        same = first_of.setdefault((len(scan), *scan[0].tolist(), *scan[-1].tolist()), i)
        if same != i and np.array_equal(recording.points[same], scan):
            repeated.append((same, i))
    if repeated:
        first, copy = numbers[list(repeated[0])]
        count = f"{len(repeated)} of {len(recording)}"
        evidence = f"{count} scans are copies, such as scan {copy} of scan {first}."
        yield Finding("duplicate_scans", "warning", evidence)
    same_pose = (recording.poses[1:] == recording.poses[:-1]).all(axis=(1, 2))
    same_pose[[later - 1 for earlier, later in repeated if later == earlier + 1]] = False
    lengths = lengths_of_steps_m(recording.poses)
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
        largest = f"the largest after scan {numbers[worst]}: {step_m:.3g} m and {turn_deg:.3g} degrees"
        evidence = f"{len(confirmed)} of {count - 1} steps are jumps, {largest}; without them, the scans agree better."
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
        comparison = Gain.over(scores[0], scores[1:])
        gain = float(comparison.mean[0])
        closes = gain > _CLOSES * (float(scores[0].mean()) - usual)
        if gain > _MIN_GAIN and comparison.significance[0] > _MIN_SIGNIFICANCE and closes:
            return True
    return False


# Sizes of a sample of windows, scans and returns, evenly spread, so that a large recording takes no longer than a small one.
_WINDOWS, _SCANS, _RETURNS = 3, 60, 60_000
_LEAST_SCANS = 4
# Smallest displacement of returns, as a share of their standard deviation. Measured: true poses of slow sensors with cells
# of 0.5 m: up to 0.09; a detected drift of 0.01 m and 0.05 degrees per step: 0.27 and more.
_LEAST_MOVED = 0.15
# Margin over the share that is expected of four steps. Measured: at most 0.95 for drifts; 1.1 to 3 for single steps.
_CONCENTRATED = 1.25
_SURE = 5.0  # log likelihood ratio of a fault to drift: below, it is undecided
_LEAST_STEPS = 8  # that a fault explains
_LEAST_ERROR = 1e-6  # of a step, m
# Pairs whose median score is the usual one: scenes overlap more in some places than in others.
_NEAR_PAIRS = 17
_MOST_CUTS = 10
# Of the best of some hundred exchanges. Measured: 14 and more for exchanges, 4 on a handheld radar with dead reckoning.
_EXCHANGE_GAIN, _EXCHANGE_SIGNIFICANCE = 0.05, 8.0


def check_drift(recording: Scans, config: FitConfig, *, undecided: bool = False) -> Iterator[Finding]:
    """Check whether held-out returns agree better with refined poses, in the clearest of some windows of scans.

    Drift is only one explanation of errors in the steps: a fault that explains them better is reported in its place. `undecided`:
    whether the scans do not show the motion.
    """
    count = len(recording)
    if count < _LEAST_SCANS:
        return
    begins = np.linspace(0, max(count - _SCANS, 0), min(_WINDOWS, max(1, count // _SCANS))).astype(np.int64)
    improved, shares, faults = [], [], []
    for begin in begins.tolist():
        part = recording.select(np.arange(begin, min(begin + _SCANS, count)))
        # Every n-th return, since returns of a scan are ordered by angle.
        every = max(1, -(-sum(map(len, part.points)) // _RETURNS))
        points = [np.asarray(scan[::every], np.float64) for scan in part.points]
        times_s, doppler_mps = ascending_times_s(part), None
        if part.doppler_mps is not None and times_s is not None:
            doppler_mps = [speeds[::every] for speeds in part.doppler_mps]
        options: dict[str, Any] = {"doppler_mps": doppler_mps, "times_s": times_s, "config": config}
        refined = refine_poses(points, part.poses, **options, progress=False)
        if refined.improved:
            report, range_m = refined.report, median_range_m(points)
            moved_m = np.hypot(report["moved_m"], range_m * report["moved_rad"])
            noise = SensorNoise(**report["noise"])
            if moved_m > _LEAST_MOVED * np.hypot(noise.range_m, range_m * noise.angle_rad):
                improved.append(report)
                lever_m = np.repeat([1.0, range_m], 3)
                given, found = (step_vectors(poses) * lever_m for poses in (recording.poses, refined.poses))
                off_m2 = np.sort(((found - given[begin : begin + len(found)]) ** 2).sum(axis=1))
                # Of the four largest errors of steps, over that of exponentially distributed ones.
                shares.append(off_m2[-4:].sum() / off_m2.sum() * len(off_m2) / (4 * np.log(len(off_m2))))
                faults += [*_time_offsets(given, found, begin), *_mountings(given, found, begin)]
    if improved:
        best = max(improved, key=lambda report: float(report["gain"] / report["gain_error"]))
        evidence = (
            f"With refined poses, returns of other scans are {np.expm1(best['gain']):.1%} denser at held-out returns "
            f"({best['gain'] / best['gain_error']:.0f} standard errors): steps have errors of {best['sigma_m']:.3f} m and "
            f"{np.degrees(best['sigma_rad']):.2f} degrees ({len(improved)} of {len(begins)} windows of the recording)."
        )
        ratio, finding = max(faults, key=lambda fault: fault[0], default=(0.0, None))
        if finding is not None and ratio > _SURE:
            yield finding
        elif finding is not None and ratio > 0:
            yield Finding("undecided", "warning", f"{finding.evidence} {evidence}")
        elif max(shares) > _CONCENTRATED:
            yield Finding("undecided", "warning", f"Few steps differ from refined ones. {evidence}")
        else:
            yield Finding("undecided" if undecided else "poses_drift", "warning", evidence)


def _log_errors(errors: Floats) -> Floats:
    """Negative log likelihoods (N,) of errors (N, 6) of steps, m, of unknown scale: few large ones hardly count."""
    return np.log(np.maximum(np.linalg.norm(errors, axis=1), _LEAST_ERROR))


def _time_offsets(given: Floats, refined: Floats, begin: int) -> Iterator[tuple[float, Finding]]:
    """Log likelihood ratios of time offsets to drift, by steps (K, 6), m, of refined scans from `begin` on, and all given ones."""
    last, drift = len(given) - 1, _log_errors(refined - given[begin : begin + len(refined)])
    offsets = [-0.5, 0.5, *range(-last, last + 1)]

    def fit(offset: float) -> tuple[Ints, Floats]:
        at = begin + np.arange(len(refined)) + offset
        rows = np.flatnonzero((at >= 0) & (at <= last))
        moved = given[np.floor(at[rows]).astype(np.int64)] + given[np.ceil(at[rows]).astype(np.int64)]
        return rows, _log_errors(refined[rows] - 0.5 * moved)

    for offset in offsets:
        rows, errors = fit(offset)
        if offset == 0 or len(rows) < _LEAST_STEPS:
            continue
        other = drift[rows].mean()
        if offset % 1:  # means of two steps have smaller errors, whatever the offset
            other = min(other, fit(-offset)[1].mean())
        ratio = len(rows) * (other - errors.mean()) - np.log(len(offsets))
        when = f"about {abs(offset):g} scans {'later' if offset > 0 else 'earlier'}"
        evidence = f"The scans move as the poses do {when} (log likelihood ratio to drift: {ratio:.0f})."
        yield float(ratio), Finding("clock_offset", "error", evidence)


def _mountings(given: Floats, refined: Floats, begin: int) -> Iterator[tuple[float, Finding]]:
    """Log likelihood ratios to drift of a sensor that is turned against the frame of the poses, from some scan on."""
    count = len(refined)
    given = given[begin : begin + count]
    drift = _log_errors(refined - given)
    for first in (0, *range(3, count - _LEAST_STEPS)):
        vectors, others = given[first:].reshape(-1, 3), refined[first:].reshape(-1, 3)
        turn = nearest_rotation(np.einsum("ni,nj->ij", others, vectors))
        left = _log_errors((others - np.einsum("ij,nj->ni", turn, vectors)).reshape(-1, 6))
        # Schwarz's criterion for the three angles, and the choice of the scan.
        ratio = (drift[first:] - left).sum() - 1.5 * np.log(count - first) - np.log(count) * (first > 0)
        degrees = np.degrees(Rotation.from_matrix(turn).magnitude())
        since = f" from scan {begin + first} on" if first else ""
        moves = f"The scans move as if turned by {degrees:.1f} degrees against the frame of the poses{since}"
        evidence = f"{moves} (log likelihood ratio to drift: {ratio:.0f})."
        yield float(ratio), Finding("sensor_turned", "warning", evidence)


def check_order(recording: Scans, numbers: Ints) -> Iterator[Finding]:
    """Find two scans or blocks of scans that changed places. `numbers` (F,): of the scans."""
    rows = np.flatnonzero([len(scan) >= MIN_RETURNS for scan in recording.points])
    count = len(rows)
    if count < 2 * max(LAGS):
        return
    agreement = Agreement([recording.points[i] for i in rows], FULL.returns, FULL.queries)
    pairs = np.concatenate([np.stack([np.arange(count - lag), np.arange(lag, count)], 1) for lag in LAGS[:3]])
    motions = relative(recording.poses[rows], pairs)[None]
    scores = agreement.scores(pairs, motions)[0]
    excess = scores[: count - 1] - median_filter(scores[: count - 1], _NEAR_PAIRS, mode="nearest")
    places = [0, *np.sort(np.argsort(-excess, kind="stable")[:_MOST_CUTS] + 1).tolist(), count]
    # Of adjacent blocks, one may be longer: it was moved past the other.
    blocks = [(a, b, b, c) for a, b, c in itertools.combinations(places, 3)]
    blocks += [ends for ends in itertools.combinations(places, 4) if ends[1] - ends[0] == ends[3] - ends[2]]
    best = _EXCHANGE_GAIN, 0.0, (0, 0, 0, 0)
    for a, b, c, d in blocks:
        # Other scans with the motion of the same poses: their fields of view overlap as much, whatever is right.
        others = np.r_[0:a, c:d, b:c, a:b, d:count][pairs]
        cuts = np.array([a, b, c, d, a + d - c, a + d - b])
        across = ((pairs[:, :1] < cuts) & (cuts <= pairs[:, 1:])).any(axis=1)
        crossing = np.flatnonzero(across & (others != pairs).any(axis=1))
        neighbours = crossing[crossing < count - 1]
        for chosen in (neighbours, crossing):
            compared = Gain.over(scores[chosen], agreement.scores(others[chosen], motions[:, chosen]))
            gain, significance = float(compared.mean[0]), float(compared.significance[0])
            needed = best[0] if chosen is crossing else _EXCHANGE_GAIN
            if gain < max(needed, _CLOSES * excess[neighbours].mean()):
                break
        else:
            if significance >= _EXCHANGE_SIGNIFICANCE:
                best = gain, significance, (a, b, c, d)
    gain, significance, (a, b, c, d) = best
    if not d:
        return
    first, second = (f"{numbers[rows[i]]} to {numbers[rows[j - 1]]}" for i, j in ((a, b), (c, d)))
    closer = f"{np.exp(gain):.2f} times closer to each other at the ends of these blocks ({significance:.0f} standard errors)"
    exchange = f"If scans {first} and scans {second} change places"
    evidence = f"{exchange}, returns of neighbouring scans are {closer}."
    yield Finding("scans_exchanged", "error", evidence)
