# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of poses: tables with named columns, TUM, KITTI, and 4 x 4 matrices."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checks import are_rigid, check_pose, check_poses, path_of, pose_matrices, real_array
from radarsdf.io.files import check_regular_file, reading, write_whole
from radarsdf.io.npz import array_in
from radarsdf.io.poses.trajectory import StampedPoses, Trajectory, listed, pose_matrices_of, trajectory_of
from radarsdf.io.scans import Notes
from radarsdf.io.text import (
    SCALES,
    are_degrees,
    in_seconds,
    read_numbers,
    read_table,
    read_text,
    without_unit,
)

POSE_FILES = ("poses.txt", "poses.tum", "poses.csv", "poses.npy", "trajectory.txt", "traj.txt", "gt_odom.txt")
"""Names of files of poses that are found beside scans."""

POSE_SUFFIXES = (".tum", ".kitti", ".npy")
"""Of files that :func:`write_poses` writes."""

FIND_POSES = "radarsdf poses finds them from the radar alone"
"""Ends what is said of scans without poses."""

_TUM_COLUMNS, _KITTI_COLUMNS, _MATRIX_COLUMNS = 8, 12, 16
_CALIBRATION_KEYS = ("Tr", "Tr_velo_to_cam")

_POSITION = "(?:t|p|pos|position|trans|translation|loc|location|pose)"
_QUATERNION = "(?:q|quat|quaternion|orientation|rot|rotation)"
_EULER = ("yaw", "pitch", "roll")
_TIMES = ("header stamp", "stamp", "timestamp", "time", "t")
_ROLES = (
    (rf"(?:{_QUATERNION} .* |(?:.* )?{_QUATERNION} ?)([xyzw])", "q{}"),
    (rf"(?:{_POSITION} .* |(?:.* )?{_POSITION} ?|)([xyz])", "{}"),
    (r"(?:.* )?(yaw|pitch|roll)", "{}"),
    (r"(?:.* )?(?:sec|secs|seconds)", "sec"),
    (r"(?:.* )?(?:nsec|nsecs|nanosec|nanosecs|nanoseconds)", "nsec"),
    (r"(?:.*? )?(header stamp|stamp|timestamp|time|t)", "{}"),
)
"""What words, whole, mean as the name of a column."""


def poses_of(
    poses: Any, notes: Notes, calibration: Sequence[Path] = ()
) -> StampedPoses | NDArray[np.float64]:
    """Poses as a user gives them: an array (F, 4, 4), poses by time, or a file for :func:`read_poses`."""
    if isinstance(poses, (str, PathLike)):
        return read_poses(Path(poses), notes, calibration)
    if hasattr(poses, "pose_at"):
        stamped: StampedPoses = poses
        return stamped
    matrices = real_array(poses, "poses")
    if matrices.ndim != 3:
        msg = f"poses must be (F, 4, 4) T_world_sensor, or a file of poses, not an array {matrices.shape}"
        raise ValueError(msg)
    return _rigid_or_nan(matrices, "the given array", notes)


def read_poses(
    path: Path, notes: Notes, calibration: Sequence[Path] = ()
) -> StampedPoses | NDArray[np.float64]:
    """Poses by time, or (F, 4, 4) in the order of the scans, of a file of one of these kinds.

    - A table whose first line, or a comment above it, names its columns in any order: a time, x, y and z, and qx, qy, qz
      and qw or roll, pitch and yaw, as in files of EuRoC, evo and ``rostopic echo -p``. Without a time it is in order.
    - TUM: ``time x y z qx qy qz qw``, s and m.
    - KITTI: lines of twelve numbers, the first three rows of a matrix. With a ``Tr`` in one of the files `calibration`,
      T_world_sensor = inv(Tr) P Tr, so that the world is the first scan's sensor frame.
    - 4 x 4 matrices, as lines of sixteen numbers or blocks of four lines, or an array (F, 4, 4) in an ``.npy`` file.

    Times may be in ms, µs or ns since 1970, or in the unit of their name. Damaged poses, and those whose time repeats, are
    left out; times out of order are sorted. A file of another format raises a ValueError.
    """
    check_regular_file(path)
    if path.suffix.lower() == ".npy":
        return _rigid_or_nan(np.array(array_in(path)), str(path), notes)
    with reading(path, "a table of poses"):
        table = read_table(path)
        values, lines, width = table.values, table.lines, table.values.shape[1]
        if len(values) == 0:
            msg = "it has no rows of numbers"
            raise ValueError(msg)
    heads = [head for head in table.heads if len(head) == width]
    named = next((found for head in reversed(heads) if (found := _pose_columns(head, values))), None)
    if named is not None:
        return _of_columns(*named, path, notes, lines)
    if width == _TUM_COLUMNS:
        if heads:
            notes.add(
                f"{path.name}: its columns are taken as time x y z qx qy qz qw: names above them are not known"
            )
        return _stamped(values, path, notes, lines)
    if width == _KITTI_COLUMNS:
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3] = values.reshape(-1, 3, 4)
        P = _rigid_or_nan(poses, str(path), notes, lines)
        for file in calibration:
            if file.is_file() and (Tr := read_calibration(file)) is not None:
                notes.add(
                    f"KITTI poses with Tr of {file.name}: T_world_sensor = inv(Tr) P Tr, the world is the first scan"
                )
                return np.linalg.inv(Tr) @ P @ Tr
        notes.add(
            f"{path.name} has KITTI poses and there is no calibration Tr: they are taken as T_world_sensor"
        )
        return P
    if width == _MATRIX_COLUMNS or (width == 4 and len(values) % 4 == 0):
        return _rigid_or_nan(values.reshape(-1, 4, 4), str(path), notes, lines[:: 16 // width])
    msg = (
        f"{path} has {width} columns: poses have 8 (TUM: time x y z qx qy qz qw), 12 (KITTI), or 16, or four in blocks "
        "of four lines; or name the columns in the first line, such as time,x,y,z,qw,qx,qy,qz"
    )
    raise ValueError(msg)


def read_transform(path: Path, default: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rigid transform (4, 4) of a text file, or the default if there is no file."""
    if not path.is_file():
        return default
    matrix = read_numbers(path, 4)
    with reading(path, "a rigid transform"):
        return check_pose(matrix, "the matrix")


def read_calibration(path: Path) -> NDArray[np.float64] | None:
    """``Tr``, or ``Tr_velo_to_cam``, of a KITTI calibration, as T_camera_sensor (4, 4); None if the file has neither."""
    check_regular_file(path)
    with reading(path, "a KITTI calibration"):
        lines = [line.partition(":") for line in read_text(path).splitlines()]
        found = {key.strip(): values.split() for key, _, values in lines}
        key = next((key for key in _CALIBRATION_KEYS if key in found), None)
        if key is None:
            return None
        T_camera_sensor = np.eye(4)
        T_camera_sensor[:3] = np.array(found[key], np.float64).reshape(3, 4)
        return check_pose(T_camera_sensor, key)


def check_pose_suffix(path: str | PathLike[str]) -> None:
    """Raises a ValueError for a name that :func:`write_poses` would refuse."""
    if path_of(path, "path").suffix.lower() not in POSE_SUFFIXES:
        msg = f"{path} is no file of poses that can be written: those end in {', '.join(POSE_SUFFIXES)}"
        raise ValueError(msg)


def check_pose_times(path: str | PathLike[str], times_s: ArrayLike | None) -> None:
    """Raises a ValueError if :func:`write_poses` would refuse to write without times."""
    if times_s is None and path_of(path, "path").suffix.lower() == ".tum":
        msg = (
            f"{path} needs times, when each pose was taken, s, and there are none: .kitti and .npy do without"
        )
        raise ValueError(msg)


def write_poses(path: str | PathLike[str], poses: ArrayLike, times_s: ArrayLike | None = None) -> None:
    """Writes a trajectory, whole or not at all.

    Parameters
    ----------
    path : path-like
        The suffix says the format: ``.tum``, lines of ``time x y z qx qy qz qw``; ``.kitti``, lines of twelve numbers, the
        first three rows of each matrix; ``.npy``, the array (F, 4, 4). evo reads the first two.
    poses : (F, 4, 4) array_like
        T_world_sensor, m.
    times_s : (F,) array_like, optional
        s. ``.tum`` needs them; the others have no place for them.

    Raises
    ------
    ValueError
        If the suffix is none of these, poses are no rigid transforms, or times are missing, not finite or not as many.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from radarsdf.io import write_poses
    >>> write_poses("poses.tum", [np.eye(4)], [12.5])
    >>> print(Path("poses.tum").read_text().strip())
    12.500000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000
    """
    check_pose_suffix(path)
    check_pose_times(path, times_s)
    suffix = path_of(path, "path").suffix.lower()
    matrices = check_poses(poses)
    text = io.BytesIO()
    if suffix == ".npy":
        np.save(text, matrices)
    elif suffix == ".kitti":
        np.savetxt(text, matrices[:, :3].reshape(-1, 12), "%.12g")
    else:
        times_s = real_array(times_s, "times_s")
        if times_s.shape != (len(matrices),) or not np.isfinite(times_s).all():
            msg = f"times_s must be one finite number for each of {len(matrices)} poses, not {times_s.shape}"
            raise ValueError(msg)
        quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
        np.savetxt(text, np.column_stack([times_s, matrices[:, :3, 3], quaternions]), "%.9f")
    write_whole(path, text.getvalue())


_Columns = dict[str, NDArray[np.float64]]


def _pose_columns(names: list[str], table: NDArray[np.float64]) -> tuple[_Columns, str] | None:
    """Columns by role, times in s, and the unit in the names of angles; None if the names are no pose's.

    Roles are time, sec, nsec, x, y, z, qx, qy, qz, qw, roll, pitch and yaw.
    """
    found: _Columns = {}
    unit_of_angles = ""
    for name, column in zip(names, table.T, strict=True):
        bare, unit = without_unit(name)
        words = re.sub(r"[\W_]+", " ", bare).strip()
        for pattern, template in _ROLES:
            if match := re.fullmatch(pattern, words):
                role = template.format(*match.groups())
                unit_of_angles = unit_of_angles or (unit if role in _EULER else "")
                found.setdefault(role, column * SCALES.get(unit, 1.0) if role in _TIMES else column)
                break
    if {"sec", "nsec"} <= set(found):
        found["time"] = found["sec"] + 1e-9 * found["nsec"]
    elif times := [found[name] for name in (*_TIMES, "sec") if name in found]:
        found["time"] = times[0]
    rotation = {"qx", "qy", "qz", "qw"} <= set(found) or "yaw" in found
    is_pose = rotation and {"x", "y"} <= set(found) and ("z" in found or "yaw" in found)
    return (found, unit_of_angles) if is_pose else None


def _of_columns(
    columns: _Columns, unit_of_angles: str, path: Path, notes: Notes, lines: list[int]
) -> StampedPoses | NDArray[np.float64]:
    """Poses of named columns: by time, or in their order."""
    zeros = np.zeros_like(columns["x"])
    if missing := [role for role in ("z", "roll", "pitch") if "qw" not in columns and role not in columns]:
        notes.add(f"{path.name} has no {', '.join(missing)}: taken as 0")
    if "qw" in columns:
        quaternions = np.stack([columns[role] for role in ("qx", "qy", "qz", "qw")], axis=1)
    else:
        angles = np.stack([columns.get(role, zeros) for role in _EULER], axis=1)
        degrees = are_degrees(angles[:, 0], angles[:, 1], unit_of_angles)
        unit, by = "degrees" if degrees else "rad", "name" if unit_of_angles else "their numbers"
        notes.add(f"{path.name}: roll, pitch and yaw are in {unit} by {by}, R = Rz(yaw) Ry(pitch) Rx(roll)")
        quaternions = np.full((len(angles), 4), np.nan)
        finite = np.isfinite(angles).all(axis=1)
        if finite.any():
            quaternions[finite] = Rotation.from_euler("ZYX", angles[finite], degrees=degrees).as_quat()
    poses = np.column_stack([*(columns.get(axis, zeros) for axis in "xyz"), quaternions])
    if "time" not in columns:
        return _rigid_or_nan(pose_matrices_of(poses), str(path), notes, lines)
    return _stamped(np.column_stack([columns["time"], poses]), path, notes, lines)


def _stamped(table: NDArray[np.float64], path: Path, notes: Notes, lines: list[int]) -> Trajectory:
    """The trajectory in rows (P, 8) of time, position and quaternion."""
    finite = np.isfinite(table[:, 0])
    table[finite, 0] = in_seconds(table[finite, 0], path.name, notes)
    return trajectory_of(table, str(path), notes, lines)


def _rigid_or_nan(
    poses: NDArray[Any], name: str, notes: Notes, lines: Sequence[int] | None = None
) -> NDArray[np.float64]:
    """Poses (F, 4, 4) in the order of scans. Damaged ones are NaN, and named: their scans have none."""
    with reading(name, "poses (F, 4, 4)", TypeError):
        matrices = pose_matrices(poses)
        bad = ~are_rigid(matrices)
        # What is missing is no error: NaN, or a rotation of zeros. Half of the others are poses of another meaning.
        known = np.isfinite(matrices).all(axis=(1, 2)) & matrices[:, :3, :3].any(axis=(1, 2))
        if 2 * (bad & known).sum() >= max(known.sum(), 1) or (len(bad) and bad.all()):
            check_poses(matrices)
    if bad.any():
        notes.add(
            f"scans left out: {bad.sum()} of {len(bad)} poses of {name} are not finite and rigid: {listed(bad, lines)}"
        )
    return np.where(bad[:, None, None], np.nan, matrices)
