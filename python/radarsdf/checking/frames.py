"""Checks of frames, axes and units by the agreement of scans."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats, Ints
from radarsdf.checking.recording import Finding, Severity, some_points
from radarsdf.poses.agreement import LAGS, MIN_RETURNS, Agreement, Gain, choose_pairs, pairs_apart, relative
from radarsdf.poses.rigid import assembled
from radarsdf.scans import Scans

# Minimum gain of a note, as the mean logarithm of distances and in standard errors. The gain over standing still must
# be as large: any pattern of the sensor's cells agrees with itself if the sensor stands still.
_MIN_GAIN = 0.05
_MIN_SIGNIFICANCE = 4.0
# Gains of an error, however small the standard error. docs/checks.md lists the largest gains of wrong hypotheses
# on good recordings, and the smallest gains of right ones on broken data.
_ERROR_GAIN = 0.12
# Shrunk positions, or points taken for world points, align the cells of the sensor with each other.
_ERROR_GAINS = {"units": 0.2, "points_in_world_frame": 0.25, "sensor_turned": 0.08}
# World points agree equally badly if the poses move them forwards or backwards. Measured: at most 0.06; on good
# recordings of a sensor with coarse cells, 0.15 and more.
_FORWARDS_GAIN = 0.1
_EQUAL = 0.8  # share of the best gain: among nearly equal mistakes, the most common is reported
_NOT_BEHIND = 2.5  # standard errors
# Standard errors. Measured: below -2.3 in the sensor frame, above -0.5 in the world frame.
_FIELD_OF_VIEW_STAYS = -1.5
# Skewness of the heights. Measured: 0.6 to 2.9 in drives; -1.2 indoors, where it is misleading.
_UPSIDE_DOWN = -0.5
_UNDECIDED = {
    "mirrored": "points or positions are mirrored",
    "poses_inverted": "the poses are inverted",
    "points_in_world_frame": "the sensor stands still, so poses of any other time",
}
_AFAR = 10.0  # distance of the returns from the origin, over their spread
_MIN_PAIRS = 3


@dataclass(frozen=True)
class Effort:
    pairs: int  # number of pairs of scans
    returns: int  # largest number of returns of a scan in the tree
    queries: int  # returns of a scan looked up in another one
    all_axes: bool  # whether to try all permutations of axes
    lags: tuple[int, ...] = LAGS  # lags between the scans of a pair


FULL = Effort(pairs=48, returns=1000, queries=80, all_axes=True)
CHEAP = Effort(pairs=20, returns=400, queries=40, all_axes=False, lags=(1, 2))


def check_frames(recording: Scans, effort: Effort = FULL) -> Iterator[Finding]:
    """Find the mistake in frames, axes or units whose correction makes the scans agree best. Poses must be rigid."""
    poses = recording.poses
    pairs = choose_pairs(recording.points, poses[:, :3, 3], effort.pairs, effort.lags)
    if len(pairs) < _MIN_PAIRS:
        return
    agreement = Agreement(recording.points, effort.returns, effort.queries)
    guesses = list(hypotheses(poses, pairs, all_axes=effort.all_axes))
    motions = relative(poses, pairs)
    others = [guess.T_j_i for guess in guesses]
    scores = agreement.scores(pairs, np.stack([motions, *others, relative(poses, pairs[:, ::-1])]))
    forwards = Gain.over(scores[-1], scores[:1])
    in_world = not (forwards.mean[0] > _FORWARDS_GAIN and forwards.significance[0] > _MIN_SIGNIFICANCE)
    in_world = in_world and not _looks_out_of_its_frame(recording, pairs)
    best = _best(recording, pairs, guesses, scores[:-1], in_world)
    if best is None:
        behind = -Gain.over(scores[0], scores[1 : len(guesses) + 1]).significance
        equal = {guess.finding for guess, sigmas in zip(guesses, behind, strict=True) if sigmas < _NOT_BEHIND}
        equal &= set(_UNDECIDED)
        if equal:
            words = " or ".join(_UNDECIDED[name] for name in sorted(equal))
            evidence = f"The scans agree as well if {words} ({len(pairs)} pairs of scans)."
            unknown = "mirroring" if equal == {"mirrored"} else "motion"
            yield Finding(f"{unknown}_undecided", "note", evidence)
        return
    guess, gain, significance = best
    sure = f"{len(pairs)} pairs of scans, {significance:.0f} standard errors"
    evidence = f"If {guess.what}, returns of different scans are {np.exp(gain):.2f} times closer to each other ({sure})."
    yield Finding(guess.finding, _severity(gain, guess.finding), evidence)


def _severity(gain: float, finding: str) -> Severity:
    return "error" if gain >= _ERROR_GAINS.get(finding, _ERROR_GAIN) else "note"


def check_still(recording: Scans, effort: Effort = FULL) -> Iterator[Finding]:
    """Check whether all positions are equal although the sensor moved, so that the scans change with time."""
    positions = recording.poses[:, :3, 3]
    usable = np.flatnonzero([len(scan) >= MIN_RETURNS for scan in recording.points])
    if len(usable) < 2 or (positions != positions[0]).any():
        return
    agreement = Agreement(recording.points, effort.returns, effort.queries)
    # Neighbours, and scans half a recording apart.
    pairs = [pairs_apart(usable, lag, effort.pairs // 2) for lag in (1, max(1, len(usable) // 2))]
    near, far = (Gain.of_samples(agreement.scores(p, relative(recording.poses, p)[None])[0]) for p in pairs)
    change = far.mean - near.mean
    error = np.inf if min(near.count, far.count) < _MIN_PAIRS else np.hypot(near.error, far.error)
    moved = change > max(_MIN_GAIN, _MIN_SIGNIFICANCE * error)
    evidence = f"All {len(recording)} poses have the same position"
    if moved:
        apart = f"returns of scans far apart in time are {np.exp(change):.2f} times farther apart"
        evidence += f", but {apart} than those of neighbours ({change / error:.0f} standard errors)"
    yield Finding("poses_stand_still", "error" if moved else "warning", f"{evidence}.")


def _best(
    recording: Scans, pairs: Ints, guesses: "list[Hypothesis]", scores: Floats, in_world: bool
) -> "tuple[Hypothesis, float, float] | None":
    """Return the hypothesis that is clearly better than the data as they are, its gain and its significance."""
    # `in_world`: whether the points may be in the world frame.
    lags = pairs[:, 1] - pairs[:, 0]
    possible = np.ones(len(guesses), bool)
    possible[STILL] = in_world
    # The skewness of the heights is positive along the up axis: walls rise above the sensor.
    points = np.concatenate(some_points(recording))
    centred = points - np.median(points, axis=0)
    skewness = (centred**3).mean(axis=0) / np.maximum(centred.std(axis=0) ** 3, 1e-300)
    upright = np.array([guess.up for guess in guesses]) @ skewness > _UPSIDE_DOWN
    # Neighbours first: scans far apart observe different things, and agree best where a wrong motion makes their fields
    # of view overlap. Hypotheses clearly worse for neighbours are not tried on scans farther apart.
    noted, kinds = None, np.array([guess.finding for guess in guesses])
    for lag in np.unique(lags):
        used = lags <= lag
        if used.sum() < _MIN_PAIRS:
            continue
        others = scores[1:, used]
        gain = Gain.over(scores[0, used], others)
        good = (gain.mean >= _MIN_GAIN) & (gain.significance >= _MIN_SIGNIFICANCE) & possible
        # Returns come closer to each other, too, if the fields of view of two scans merely overlap more, most of all if the
        # sensor stands still. A hypothesis that explains the scans better than the data as they are also beats
        # that one. Measured: without this, 37 of 70 good recordings of 4 to 8 sparse scans had an error; with it, none of 258.
        beats_still = Gain.over(others[STILL], others).mean >= _MIN_GAIN
        beats_still[STILL] = True
        good &= beats_still
        if good.any():
            top = int(np.argmax(np.where(good, gain.mean, -np.inf)))
            near = good & (gain.mean >= _EQUAL * gain.mean[top])
            near &= Gain.over(others, others[top]).significance < _NOT_BEHIND
            # Scans that move on a plane agree equally well upside down.
            near = near & upright if (near & upright).any() else near
            # The most common of the mistakes with about equal gains; of its variants, the best one.
            of_kind = near & (kinds == kinds[np.argmax(near)])
            k = int(np.argmax(np.where(of_kind, gain.mean, -np.inf)))
            best = guesses[k], float(gain.mean[k]), float(gain.significance[k])
            if _severity(best[1], best[0].finding) == "error":
                return best
            noted = noted or best
        possible &= (gain.mean > -_MIN_GAIN) | (gain.significance > -_MIN_SIGNIFICANCE)
    return noted


def _looks_out_of_its_frame(recording: Scans, pairs: Ints) -> bool:
    """Whether the returns stay in one place of their own frame, but not of the sensor frame according to the poses."""
    # If the sensor moves far between scans, they agree best as if it stood still, when its field of view is the same. But in
    # the world frame, the centroid of the returns and their mean direction move.
    rows = np.unique(pairs)
    given = [np.asarray(recording.points[i], np.float64) for i in rows.tolist()]
    afar = [np.linalg.norm(np.median(scan, axis=0)) / max(scan.std(axis=0).max(), 1e-9) for scan in given]
    if np.median(afar) > _AFAR:
        return False  # no sensor has all returns in one direction, unlike UTM coordinates
    moved = [(scan - T[:3, 3]) @ T[:3, :3] for scan, T in zip(given, recording.poses[rows], strict=True)]
    first, second = np.searchsorted(rows, pairs.T)
    middles = (np.array([_middles(scan) for scan in scans]) for scans in (given, moved))
    before, after = (np.linalg.norm(middle[first] - middle[second], axis=2) for middle in middles)
    return bool(Gain.of_samples(before - after).significance.sum() / np.sqrt(2) < _FIELD_OF_VIEW_STAYS)


def _middles(scan: Floats) -> tuple[Floats, Floats]:
    """Centroid (3,) of the returns (N, 3), and their mean direction (3,)."""
    directions = scan / np.maximum(np.linalg.norm(scan, axis=1), 1e-12)[:, None]
    return np.median(scan, axis=0), np.mean(directions, axis=0)


_UNITS = {1e-3: "1/1000", 1e-2: "1/100", 0.3048: "0.3048", 1 / 0.3048: "1/0.3048", 1e2: "100", 1e3: "1000"}
# Of radar axes (x forward, y left, z up) in a camera frame (x right, y down, z forward).
_CAMERA_OF_RADAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
# Mounting angles of a sensor on its vehicle: in yaw; in pitch up to 20.
_TURNS_DEG = {"yaw": ("z", range(5, 50, 5)), "pitch": ("y", range(5, 25, 5))}
# For larger turns between scans, poses in degrees may have been taken for radians.
_FAST_RAD = np.radians(3)
_LOST_TURNS = 29  # whole turns that are tried
STILL = 1  # index of the hypothesis of a sensor that does not move between scans: points in the world frame


@dataclass(frozen=True)
class Hypothesis:
    finding: str  # name of the finding if the hypothesis is right
    what: str  # completes "the scans agree better if"
    T_j_i: Floats  # (P, 4, 4) motions between the frames of the original points of scan pairs
    up: tuple[float, ...] = (0.0, 0.0, 1.0)  # vertical axis in the frame of the original points


def hypotheses(poses: Floats, pairs: Ints, *, all_axes: bool = True) -> Iterator[Hypothesis]:
    """Yield hypotheses about rigid poses (F, 4, 4) for pairs (P, 2) of scans i and j, the more common mistakes first.

    `all_axes`: whether to try all 47 permutations and reflections of axes, of points and positions, or the eight most common.
    """
    motions, R, t = relative(poses, pairs), poses[:, :3, :3], poses[:, :3, 3]
    inverted = np.linalg.inv(poses).astype(np.float64)
    yield Hypothesis("poses_inverted", "the poses are inverted", relative(inverted, pairs))
    still = np.tile(np.eye(4), (len(pairs), 1, 1))
    yield Hypothesis("points_in_world_frame", "the points are in the world frame already", still)
    rotations_by_90 = Rotation.create_group("O").as_matrix().round()
    # All permutations and reflections of axes but the identity.
    for matrix in sorted([*rotations_by_90, *-rotations_by_90], key=_surprise)[1:]:
        axes = np.argmax(np.abs(matrix), axis=1)
        words = ", ".join("-" * int(row[k] < 0) + "xyz"[k] for row, k in zip(matrix, axes, strict=True))
        mirrored = np.array_equal(np.abs(matrix), np.eye(3)) and np.linalg.det(matrix) < 0
        camera = any(np.array_equal(matrix, m) for m in (_CAMERA_OF_RADAR, _CAMERA_OF_RADAR.T))
        kind = "camera_frame" if camera else "mirrored" if mirrored else "axes_swapped"
        # z up or down, x and y in any order; and the camera frame
        if not (all_axes or camera or matrix[2, 2] == 1 or words == "x, -y, -z"):
            continue
        turned, up = assembled(matrix), tuple(matrix[2].tolist())
        yield Hypothesis(kind, f"the points are read as ({words})", turned.T @ motions @ turned, up)
        if all_axes or not camera:
            what = f"the positions of the poses are read as ({words})"
            yield Hypothesis(kind, what, relative(assembled(R, t @ matrix.T), pairs))
    for factor, word in _UNITS.items():
        what = f"the positions of the poses are multiplied by {word}"
        yield Hypothesis("units", what, relative(assembled(R, t * factor), pairs))
    for name, what, rotations in _rotations(Rotation.from_matrix(R)):
        yield Hypothesis(name, what, relative(assembled(rotations.as_matrix(), t), pairs))
    for name, (axis, turns) in _TURNS_DEG.items():
        for degrees in (sign * turn for turn in turns for sign in (1, -1)):
            T_vehicle_sensor = assembled(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())
            what = f"the sensor is rotated by {degrees} degrees in {name} against the frame of the poses"
            yield Hypothesis("sensor_turned", what, T_vehicle_sensor.T @ motions @ T_vehicle_sensor)
    yield Hypothesis("scans_exchanged", "the order of the scans is reversed", relative(poses[::-1], pairs))


def _surprise(matrix: Floats) -> tuple[bool, bool, float]:
    """Sort key of matrices: the identity first, then those that keep z up, a more common mistake, then few signs."""
    key = matrix[2, 2] != 1 and not np.array_equal(matrix, _CAMERA_OF_RADAR.T), float((matrix < 0).sum())
    return not np.array_equal(matrix, np.eye(3)), *key


def _rotations(given: Rotation) -> Iterator[tuple[str, str, Rotation]]:
    """Yield rotations (F,) as if their angles were in another unit, or their quaternions in another order."""
    # Angles in rad taken for degrees are 57 times too small.
    vectors = np.degrees(given.as_rotvec())
    if np.linalg.norm(vectors, axis=1).max() < 2 * np.pi:
        what = "the angles of the poses are taken for rad, not degrees"
        yield "angles_in_degrees", what, Rotation.from_rotvec(vectors)
    if len(given) >= 3 and np.median((given[:-1].inv() * given[1:]).magnitude()) >= _FAST_RAD:
        # Angles in degrees taken for rad lost whole turns. Steps are small, so the turns between scans are known.
        angles = np.radians(np.unwrap(given.as_euler("ZYX"), axis=0))
        for turns in range(-_LOST_TURNS, _LOST_TURNS + 1):
            lost = np.array([turns * np.radians(2 * np.pi), 0.0, 0.0])
            what = "the angles of the poses are taken for degrees, not rad"
            yield "angles_in_degrees", what, Rotation.from_euler("ZYX", angles + lost)
    for shift, order, other in ((-1, "w x y z", "x y z w"), (1, "x y z w", "w x y z")):
        what = f"the quaternions of the poses are {order}, and were read as {other}"
        yield "quaternion_order", what, Rotation.from_quat(np.roll(given.as_quat(), shift, axis=1))
