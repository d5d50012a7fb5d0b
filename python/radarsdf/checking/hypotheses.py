# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What may be wrong with points and poses: each hypothesis is a way to read the same numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checking.agreement import inverse, relative
from radarsdf.poses.rigid import turned_by

FloatArray = NDArray[np.float64]

_AXES = "xyz"
_UNITS = {1e-3: "1/1000", 1e-2: "1/100", 0.3048: "0.3048", 1 / 0.3048: "1/0.3048", 1e2: "100", 1e3: "1000"}
# Of radar axes (x forward, y left, z up) in a camera frame (x right, y down, z forward).
_CAMERA_OF_RADAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
_TURNS_DEG = (5, 10, 15, 20, 25, 30, 35, 40, 45)  # of a sensor on its vehicle, in yaw; in pitch up to 20
_MAX_PITCH_DEG = 20
_FAST_RAD = np.radians(
    3
)  # a sensor that turns more between scans may have poses of degrees taken for radians


@dataclass(frozen=True)
class Hypothesis:
    """One way to read the data."""

    finding: str
    """Name of the finding, if this is right."""
    what: str
    """What the data are, in words that follow "the scans agree better if"."""
    mend: str
    """What to do, if this is right."""
    T_j_i: FloatArray
    """(P, 4, 4) motions of the pairs of scans, between the frames of the points as given."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """The axis of the points as given that is up then."""


def hypotheses(
    T_world_sensor: FloatArray, pairs: NDArray[np.int64], *, all_axes: bool = True
) -> list[Hypothesis]:
    """Hypotheses about poses (F, 4, 4), float64, for pairs (P, 2) of scans. The more common a mistake, the earlier.

    Parameters
    ----------
    T_world_sensor : ndarray
        Rigid transforms.
    pairs : ndarray
        Scans i and j of each pair.
    all_axes : bool
        Whether to try all 47 ways to swap and turn axes, of points and of positions. If not, the most common eight.
    """
    found = [
        Hypothesis(
            "poses_inverted",
            "the poses are inverted",
            "Invert each pose: np.linalg.inv(poses).",
            relative(inverse(T_world_sensor), pairs),
        ),
        Hypothesis(
            "points_in_world_frame",
            "the points are in the world frame already",
            "Move them back: (points - pose[:3, 3]) @ pose[:3, :3], or pass the points of the sensor frame.",
            np.tile(np.eye(4), (len(pairs), 1, 1)),
        ),
    ]
    found += _axes(T_world_sensor, pairs, all_axes)
    for factor, word in _UNITS.items():
        scaled = T_world_sensor.copy()
        scaled[:, :3, 3] *= factor
        found.append(
            Hypothesis(
                "units",
                f"the positions of the poses are multiplied by {word}",
                f"Use metres for both: multiply the positions by {word}, or divide the points by it.",
                relative(scaled, pairs),
            )
        )
    found += [
        Hypothesis(
            "angles_in_degrees",
            what,
            "Make the rotations of the poses anew, from angles in rad.",
            relative(T, pairs),
        )
        for what, T in _angles(T_world_sensor)
    ]
    found += _quaternions(T_world_sensor, pairs)
    found += _turned(relative(T_world_sensor, pairs))
    return found


def standing_still(guesses: list[Hypothesis]) -> int:
    """Number of the hypothesis under which the sensor does not move between scans: points in the world frame."""
    return next(k for k, guess in enumerate(guesses) if guess.finding == "points_in_world_frame")


def _quaternions(T_world_sensor: FloatArray, pairs: NDArray[np.int64]) -> Iterator[Hypothesis]:
    """Quaternions whose real part comes first taken for ones where it comes last, and the other way round."""
    read = Rotation.from_matrix(T_world_sensor[:, :3, :3]).as_quat()
    for shift, order, other in ((-1, "w x y z", "x y z w"), (1, "x y z w", "w x y z")):
        poses = T_world_sensor.copy()
        poses[:, :3, :3] = Rotation.from_quat(np.roll(read, shift, axis=1)).as_matrix()
        yield Hypothesis(
            "quaternion_order",
            f"the quaternions of the poses are {order}, and were read as {other}",
            f"Make the rotations of the poses anew, from quaternions in the order {order}.",
            relative(poses, pairs),
        )


def _turned(motions: FloatArray) -> Iterator[Hypothesis]:
    """The poses are those of a vehicle on which the sensor looks to the side, or up or down."""
    for axis, name, turns in (
        ("z", "yaw", _TURNS_DEG),
        ("y", "pitch", [turn for turn in _TURNS_DEG if turn <= _MAX_PITCH_DEG]),
    ):
        for degrees in (sign * turn for turn in turns for sign in (1, -1)):
            T_vehicle_sensor = np.eye(4)
            T_vehicle_sensor[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
            yield Hypothesis(
                "sensor_turned",
                f"the sensor is turned by {degrees} degrees of {name} on what the poses are of",
                "Pass poses of the sensor: poses @ T_vehicle_sensor, by its calibration.",
                T_vehicle_sensor.T @ motions @ T_vehicle_sensor,
            )


def _signed_permutations() -> Iterator[FloatArray]:
    """The 47 matrices that swap axes or change their signs, the identity left out."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if not np.array_equal(matrix, np.eye(3)):
                yield matrix


def _written(matrix: FloatArray) -> str:
    """A signed permutation as a user would write it: x, -y, -z."""
    words = []
    for row in matrix:
        axis = int(np.argmax(np.abs(row)))
        words.append(("-" if row[axis] < 0 else "") + _AXES[axis])
    return ", ".join(words)


def _surprise(matrix: FloatArray) -> tuple[bool, float]:
    """To sort matrices by: where z stays up, the mistake is more common. Few signs before many."""
    return (matrix[2, 2] != 1 and not np.array_equal(matrix, _CAMERA_OF_RADAR.T), float((matrix < 0).sum()))


def _kind(matrix: FloatArray) -> str:
    """Name of the finding that the axes have to be mapped by this matrix."""
    if any(np.array_equal(matrix, m) for m in (_CAMERA_OF_RADAR, _CAMERA_OF_RADAR.T)):
        return "camera_frame"
    keeps_axes = np.array_equal(np.abs(matrix), np.eye(3))
    return "mirrored" if keeps_axes and np.linalg.det(matrix) < 0 else "axes_swapped"


def _axes(T_world_sensor: FloatArray, pairs: NDArray[np.int64], all_axes: bool) -> list[Hypothesis]:
    matrices = sorted(_signed_permutations(), key=_surprise)
    if not all_axes:  # z up or down, x and y in any order; and the frame of a camera
        matrices = [
            m for m in matrices if m[2, 2] == 1 or _kind(m) == "camera_frame" or _written(m) == "x, -y, -z"
        ]
    found = []
    motions = relative(T_world_sensor, pairs)
    for matrix in matrices:
        turned = np.eye(4)
        turned[:3, :3] = matrix
        words = _written(matrix)
        found.append(
            Hypothesis(
                _kind(matrix),
                f"the points are read as ({words})",
                f"Pass points with the columns ({words}): x forward, y left, z up.",
                turned.T @ motions @ turned,
                up=(float(matrix[2, 0]), float(matrix[2, 1]), float(matrix[2, 2])),
            )
        )
        moved = T_world_sensor.copy()
        moved[:, :3, 3] = moved[:, :3, 3] @ matrix.T
        if _kind(matrix) != "camera_frame" or all_axes:
            found.append(
                Hypothesis(
                    _kind(matrix),
                    f"the positions of the poses are read as ({words})",
                    "Make positions and rotations of the poses in one right-handed world frame with z up.",
                    relative(moved, pairs),
                )
            )
    return found


def _angles(T_world_sensor: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Poses (F, 4, 4) if their angles had been taken for another unit, and what that means in words."""
    rotations = Rotation.from_matrix(T_world_sensor[:, :3, :3])

    def with_rotations(R_world_sensor: Rotation) -> FloatArray:
        poses = T_world_sensor.copy()
        poses[:, :3, :3] = R_world_sensor.as_matrix()
        return poses

    # Angles in rad, taken for degrees, are 57 times too small.
    vectors = np.degrees(rotations.as_rotvec())
    if np.linalg.norm(vectors, axis=1).max() < 2 * np.pi:
        yield (
            "the angles of the poses are taken for rad, not degrees",
            with_rotations(Rotation.from_rotvec(vectors)),
        )
    if len(rotations) < 3 or np.median(turned_by(T_world_sensor[:-1], T_world_sensor[1:])) < _FAST_RAD:
        return
    # Angles in degrees, taken for rad, have lost whole turns. Steps are small, so the turns between scans are known.
    angles = np.radians(np.unwrap(rotations.as_euler("ZYX"), axis=0))
    turn = np.radians(2 * np.pi)  # what a lost turn was
    for turns in range(-29, 30):
        lost = np.array([turns * turn, 0.0, 0.0])
        yield (
            "the angles of the poses are taken for degrees, not rad",
            with_rotations(Rotation.from_euler("ZYX", angles + lost)),
        )
