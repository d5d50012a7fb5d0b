"""Agreement of returns of different scans, and hypotheses about mistakes in the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Array, Floats, Ints
from radarsdf.poses.rigid import assembled, between, turned_by

_NEIGHBOURS = 4  # nearest returns of the same scan whose mean distance is the spacing at a return
MIN_RETURNS = _NEIGHBOURS + 2  # scans with fewer are not compared
# Limits of the quotients. A return in empty space must not count more than one next to
# a surface, or hypotheses would win that merely make the fields of view overlap.
_LEAST, _MOST = 0.1, 1.5
LAGS = (1, 2, 4, 8)
"""Lags between the scans of a pair; multiplied by a stride if the sensor is slow."""
_MOTION = 0.05  # share of the median range: smaller motions hardly show errors of the poses


class Agreement:
    """Agreement of scans (N_i, 3), each compared with the k-d tree of at most `returns` returns of another one.

    About `queries` returns per scan are looked up. They are sampled at equal steps, not at random.
    """

    def __init__(self, scans: Sequence[Array], returns: int, queries: int) -> None:
        self._scans, self._returns, self._queries = scans, returns, queries
        self._trees: dict[int, tuple[cKDTree, Floats, Floats]] = {}

    def scores(self, pairs: Ints, T_j_i: Floats) -> Floats:
        """Scores (H, P) of pairs (P, 2) of scans i and j under H hypotheses; lower scores mean better agreement.

        `T_j_i` (H, P, 4, 4): isometries, proper or improper, from the frame of scan i to that of scan j.
        """
        back = np.asarray(np.linalg.inv(T_j_i), np.float64)
        found = np.zeros(T_j_i.shape[:2])
        for p, (i, j) in enumerate(pairs.tolist()):
            found[:, p] = 0.5 * (self._one_way(i, j, T_j_i[:, p]) + self._one_way(j, i, back[:, p]))
        return found

    def spacing_m(self, i: int) -> float:
        """Median distance between neighbouring returns of scan i, m; 0 if it has too few."""
        return float(np.median(self._tree(i)[1])) if len(self._scans[i]) >= MIN_RETURNS else 0.0

    def _one_way(self, i: int, j: int, T_j_i: Floats) -> Floats:
        """Mean logarithms (H,) of the distances of returns of scan i from scan j, over the spacing there."""
        queries = self._tree(i)[2]
        tree, spacing, _ = self._tree(j)
        moved = np.einsum("hab,nb->hna", T_j_i[:, :3, :3], queries) + T_j_i[:, None, :3, 3]
        # Beyond this bound, the quotient is clipped to _MOST anyway; it saves most of the search.
        distances, nearest = tree.query(moved.reshape(-1, 3), distance_upper_bound=_MOST * spacing.max())
        quotients = distances / np.append(spacing, 1.0)[nearest]  # the row is n if none was found
        logs = np.log(np.clip(quotients, _LEAST, _MOST)).reshape(moved.shape[:2])
        return logs.mean(axis=1)

    def _tree(self, i: int) -> tuple[cKDTree, Floats, Floats]:
        """Tree, spacing at its returns, and queries of a scan."""
        if i not in self._trees:
            scan = self._scans[i]
            kept, queries = (
                np.asarray(scan[:: -(-len(scan) // count)], np.float64)
                for count in (self._returns, self._queries)
            )
            tree = cKDTree(kept)
            spacing = tree.query(kept, _NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
            least = 1e-9 * max(float(np.abs(kept).max()), 1.0)  # coincident returns have no spacing
            self._trees[i] = tree, np.maximum(spacing, least), queries
        return self._trees[i]


@dataclass(frozen=True)
class Comparison:
    """Gain in agreement of H hypotheses over the data as they are, over P pairs of scans."""

    gains: Floats  # (H,) mean decrease of the score. exp(-gain) is the factor by which the distances shrink
    errors: Floats  # (H,) standard error of the mean, from the differences between the pairs

    @classmethod
    def of(cls, given: Floats, others: Floats) -> Comparison:
        """Compare scores `given` (P,) or (H, P) with scores `others` (H, P)."""
        better = given - others
        count = better.shape[1]
        # The mean of a few pairs that agree by chance must not look certain.
        spread = better.std(axis=1, ddof=1) if count > 1 else np.full(len(better), np.inf)
        return cls(better.mean(axis=1), np.maximum(spread, 1e-3) / np.sqrt(count))

    @property
    def significance(self) -> Floats:
        """(H,) gains over their standard errors."""
        return self.gains / self.errors


def choose_pairs(scans: Sequence[Array], positions: Floats, count: int, lags: Sequence[int] = LAGS) -> Ints:
    """Choose about `count` pairs (P, 2) of scans, spread over the drive, at small and large lags.

    Neighbours overlap most; but at high frame rates, the sensor hardly moves between them, and every hypothesis agrees.
    So in some pairs, the sensor moved by a share of its range, according to the poses. Scans with too few returns are skipped.
    """
    usable = np.flatnonzero([len(scan) >= MIN_RETURNS for scan in scans])
    if len(usable) < 2:
        return np.zeros((0, 2), np.int64)
    some = usable[:: -(-len(usable) // 20)]
    middle = np.median([np.median(np.linalg.norm(scans[i], axis=1)) for i in some])
    step = np.median(np.linalg.norm(np.diff(positions[usable], axis=0), axis=1))
    most = max(1, len(usable) // 2)
    stride = int(np.clip(_MOTION * middle / step if step > 0 else 1, 1, max(1, most // lags[-1])))
    ways = sorted({min(lag, most) for lag in lags} | {lag * stride for lag in lags if lag * stride <= most})
    return np.concatenate([pairs_apart(usable, lag, -(-count // len(ways))) for lag in ways])


def pairs_apart(scans: Ints, lag: int, count: int) -> Ints:
    """Pairs (P, 2) of scans (K,) at a lag: about `count`, at equal steps."""
    last = len(scans) - lag
    firsts = np.unique(np.linspace(0, last - 1, min(last, count)).round().astype(int))
    return np.stack([scans[firsts], scans[firsts + lag]], 1)


def relative(T_world_sensor: Floats, pairs: Ints) -> Floats:
    """(P, 4, 4) motions T_j_i of pairs (P, 2) of poses (F, 4, 4), from scan i to scan j."""
    return between(T_world_sensor[pairs[:, 1]], T_world_sensor[pairs[:, 0]])


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
    """A hypothetical interpretation of the data."""

    finding: str  # name of the finding if the hypothesis is right
    what: str  # completes "the scans agree better if"
    T_j_i: Floats  # (P, 4, 4) motions between the frames of the original points of scan pairs
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # vertical axis in the frame of the original points


def hypotheses(T_world_sensor: Floats, pairs: Ints, *, all_axes: bool = True) -> list[Hypothesis]:
    """Hypotheses about rigid poses (F, 4, 4) for pairs (P, 2) of scans i and j, the more common mistakes first.

    `all_axes`: whether to try all 47 permutations and reflections of axes, of points and positions, or the eight most common.
    """
    poses, motions = T_world_sensor, relative(T_world_sensor, pairs)

    def positions(values: Floats) -> Floats:
        return relative(assembled(poses[:, :3, :3], values), pairs)

    def rotations(values: Rotation) -> Floats:
        return relative(assembled(values.as_matrix(), poses[:, :3, 3]), pairs)

    still = np.tile(np.eye(4), (len(pairs), 1, 1))
    found = [
        Hypothesis(
            "poses_inverted",
            "the poses are inverted",
            relative(np.asarray(np.linalg.inv(poses), np.float64), pairs),
        ),
        Hypothesis("points_in_world_frame", "the points are in the world frame already", still),
    ]
    rotations_by_90 = Rotation.create_group("O").as_matrix().round()
    # All permutations and reflections of axes but the identity.
    for matrix in sorted([*rotations_by_90, *-rotations_by_90], key=_surprise)[1:]:
        words, kind = _written(matrix), _kind(matrix)
        camera = kind == "camera_frame"
        # z up or down, x and y in any order; and the camera frame
        if not (all_axes or camera or matrix[2, 2] == 1 or words == "x, -y, -z"):
            continue
        turned = assembled(matrix)
        up = float(matrix[2, 0]), float(matrix[2, 1]), float(matrix[2, 2])
        what = f"the points are read as ({words})"
        found.append(Hypothesis(kind, what, turned.T @ motions @ turned, up))
        if all_axes or not camera:
            what = f"the positions of the poses are read as ({words})"
            found.append(Hypothesis(kind, what, positions(poses[:, :3, 3] @ matrix.T)))
    for factor, word in _UNITS.items():
        what = f"the positions of the poses are multiplied by {word}"
        found.append(Hypothesis("units", what, positions(poses[:, :3, 3] * factor)))
    for what, angles in _angles(poses):
        found.append(Hypothesis("angles_in_degrees", what, rotations(angles)))
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    for shift, order, other in ((-1, "w x y z", "x y z w"), (1, "x y z w", "w x y z")):
        what = f"the quaternions of the poses are {order}, and were read as {other}"
        rolled = Rotation.from_quat(np.roll(quaternions, shift, axis=1))
        found.append(Hypothesis("quaternion_order", what, rotations(rolled)))
    for name, (axis, turns) in _TURNS_DEG.items():
        for degrees in (sign * turn for turn in turns for sign in (1, -1)):
            T_vehicle_sensor = assembled(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())
            what = f"the sensor is rotated by {degrees} degrees in {name} against the frame of the poses"
            moved = T_vehicle_sensor.T @ motions @ T_vehicle_sensor
            found.append(Hypothesis("sensor_turned", what, moved))
    found.append(
        Hypothesis("scans_exchanged", "the order of the scans is reversed", relative(poses[::-1], pairs))
    )
    return found


def _written(matrix: Floats) -> str:
    """Format a signed permutation as a user would write it: x, -y, -z."""
    axes = np.argmax(np.abs(matrix), axis=1)
    return ", ".join("-" * int(row[axis] < 0) + "xyz"[axis] for row, axis in zip(matrix, axes, strict=True))


def _surprise(matrix: Floats) -> tuple[bool, bool, float]:
    """Sort key of matrices: the identity first, then those that keep z up, a more common mistake, then few signs."""
    key = matrix[2, 2] != 1 and not np.array_equal(matrix, _CAMERA_OF_RADAR.T), float((matrix < 0).sum())
    return not np.array_equal(matrix, np.eye(3)), *key


def _kind(matrix: Floats) -> str:
    """Name of the finding for axes that must be mapped by this matrix."""
    if any(np.array_equal(matrix, m) for m in (_CAMERA_OF_RADAR, _CAMERA_OF_RADAR.T)):
        return "camera_frame"
    keeps_axes = np.array_equal(np.abs(matrix), np.eye(3))
    return "mirrored" if keeps_axes and np.linalg.det(matrix) < 0 else "axes_swapped"


def _angles(poses: Floats) -> Iterator[tuple[str, Rotation]]:
    """Rotations (F,) as if their angles were in another unit, with a description."""
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    # Angles in rad taken for degrees are 57 times too small.
    vectors = np.degrees(rotations.as_rotvec())
    if np.linalg.norm(vectors, axis=1).max() < 2 * np.pi:
        yield "the angles of the poses are taken for rad, not degrees", Rotation.from_rotvec(vectors)
    if len(rotations) < 3 or np.median(turned_by(poses[:-1], poses[1:])) < _FAST_RAD:
        return
    # Angles in degrees taken for rad lost whole turns. Steps are small, so the turns between scans are known.
    angles = np.radians(np.unwrap(rotations.as_euler("ZYX"), axis=0))
    for turns in range(-_LOST_TURNS, _LOST_TURNS + 1):
        lost = np.array([turns * np.radians(2 * np.pi), 0.0, 0.0])
        what = "the angles of the poses are taken for degrees, not rad"
        yield what, Rotation.from_euler("ZYX", angles + lost)
