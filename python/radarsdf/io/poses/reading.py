# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses from files, and which scan has which: by time stamp, or in their order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import are_rigid, check_pose, check_poses, pose_matrices, real_array
from radarsdf.io.files import are_numbers, check_regular_file
from radarsdf.io.npz import array_in
from radarsdf.io.poses.columns import pose_columns, rotations_of
from radarsdf.io.poses.trajectory import Trajectory, listed, pose_matrices_of, trajectory_of
from radarsdf.io.scans import Notes
from radarsdf.io.text import numbers_of, read_text, text_rows
from radarsdf.io.units import SCALES, in_seconds, without_unit

POSE_FILES = ("poses.txt", "poses.tum", "poses.csv", "poses.npy", "trajectory.txt", "traj.txt", "gt_odom.txt")
"""Names of files of poses that are found beside scans."""

FIND_POSES = "radarsdf poses finds them from the radar alone"
"""Ends what is said of scans without poses."""

_TUM_COLUMNS, _KITTI_COLUMNS, _MATRIX_COLUMNS = 8, 12, 16
_CALIBRATION_KEYS = ("Tr", "Tr_velo_to_cam")


class StampedPoses(Protocol):
    """Poses by time."""

    def pose_at(self, time_s: float, max_gap_s: float) -> NDArray[np.float64] | None:
        """T_world_base (4, 4) at a time, s; None if there is none near enough."""

    def span(self) -> str:
        """First and last time, for messages."""


class NoPoses(ValueError):
    """Scans have no poses, and none are given."""


class _Unposed:
    """Scans without poses: the identity at all times."""

    def pose_at(self, time_s: float, max_gap_s: float) -> NDArray[np.float64]:  # noqa: ARG002
        return np.eye(4)

    def span(self) -> str:
        return "all times"

    def __repr__(self) -> str:
        return "UNPOSED"


UNPOSED: StampedPoses = _Unposed()
"""In place of poses, reads scans that have none, such as for :func:`radarsdf.odometry`: each pose is the identity."""


@dataclass(frozen=True, eq=False)
class TransformChain:
    """A product of transforms, each of which is constant or moves: T_world_a · T_a_b · … of a tree of frames."""

    links: tuple[Trajectory | NDArray[np.float64], ...]

    def pose_at(self, time_s: float, max_gap_s: float) -> NDArray[np.float64] | None:
        """T_world_base (4, 4) at a time, s; None if a link has none near enough."""
        pose = np.eye(4)
        for link in self.links:
            part = link.pose_at(time_s, max_gap_s) if isinstance(link, Trajectory) else link
            if part is None:
                return None
            pose = pose @ part
        return pose

    def moving(self) -> list[Trajectory]:
        """The links that are not constant."""
        return [link for link in self.links if isinstance(link, Trajectory)]

    def span(self) -> str:
        """First and last time of its moving links, for messages."""
        return ", ".join(link.span() for link in self.moving())


@dataclass(frozen=True, eq=False)
class ScanPoses:
    """The pose of the radar for each scan: of its time, or of its number."""

    poses: StampedPoses | NDArray[np.float64]
    """T_world_base by time, or (F, 4, 4) in the order of the scans."""
    T_base_sensor: NDArray[np.float64]
    max_gap_s: float

    def of(self, number: int, time_s: float | None) -> NDArray[np.float64] | None:
        """T_world_sensor (4, 4) of scan `number`, which was taken at `time_s`; None if it has none."""
        if isinstance(self.poses, np.ndarray):
            T_world_base = self.poses[number] if number < len(self.poses) else None
            if T_world_base is not None and np.isnan(T_world_base[0, 0]):
                return None
        elif time_s is None:
            return None
        else:
            T_world_base = self.poses.pose_at(time_s, self.max_gap_s)
        if T_world_base is None:
            return None
        T_world_sensor: NDArray[np.float64] = T_world_base @ self.T_base_sensor
        return T_world_sensor


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
    return poses_or_nan(matrices, "the given array", notes)


def read_poses(
    path: Path, notes: Notes, calibration: Sequence[Path] = ()
) -> StampedPoses | NDArray[np.float64]:
    """Reads a file of poses.

    Parameters
    ----------
    path : Path
        One of

        - a table whose first line, or a comment above it, names its columns, in any order: a time, x, y and z, and
          qx, qy, qz and qw or roll, pitch and yaw, as in files of EuRoC, evo and ``rostopic echo -p``. T_world_base by
          time, or without a time in order; other columns are not used;
        - TUM: lines of ``time x y z qx qy qz qw``, s and m: T_world_base by time;
        - KITTI: lines of twelve numbers, the first three rows of a matrix. With a calibration ``Tr``, the transform from
          the sensor to the camera, T_world_sensor = inv(Tr) · P · Tr, so that the world is the first scan's sensor frame;
          without one, the lines are taken as T_world_base;
        - our own: 4 x 4 matrices T_world_base, as lines of sixteen numbers or blocks of four lines, or an array
          (F, 4, 4) in an ``.npy`` file.

        Text may have commas or semicolons, and comments after ``#``. Times may be in ms, µs or ns since 1970, or in the
        unit of their name. Poses that are not finite or have no unit quaternion, and those whose time repeats, are left
        out; times out of order are sorted.
    notes : Notes
        Takes what was assumed.
    calibration : sequence of Path
        Files in which the ``Tr`` of a KITTI calibration is looked for.

    Returns
    -------
    Trajectory or ndarray
        Poses by time, or (F, 4, 4) float64 in their order.

    Raises
    ------
    ValueError
        If the file has another format, or a pose is not rigid.
    OSError
        If it cannot be read.
    """
    check_regular_file(path)
    if path.suffix.lower() == ".npy":
        return poses_or_nan(np.array(array_in(path)), str(path), notes)
    try:
        heads, rows = text_rows(path)
    except ValueError as error:
        msg = f"{path} is not a table of poses: {error}"
        raise ValueError(msg) from error
    if not any(are_numbers(words[-1:]) for _, words in rows):
        msg = f"{path} is not a table of poses: it has no rows of numbers"
        raise ValueError(msg)
    width = Counter(len(words) for _, words in rows).most_common(1)[0][0]
    heads = [head for head in heads if len(head) == width]
    table, lines = numbers_of(rows, width), [line for line, _ in rows]
    for head in reversed(heads):
        if (columns := pose_columns(head)) is not None:
            return _named(table, columns, head, path, notes, lines)
    if width == _TUM_COLUMNS:
        if heads:
            notes.add(
                f"{path.name}: its columns are taken as time x y z qx qy qz qw: names above them are not known"
            )
        return _stamped(table, path, notes, lines)
    if width == _KITTI_COLUMNS:
        return _kitti(table, path, notes, lines, calibration)
    if width == _MATRIX_COLUMNS or (width == 4 and len(table) % 4 == 0):
        return poses_or_nan(table.reshape(-1, 4, 4), str(path), notes, lines[:: 16 // width])
    msg = (
        f"{path} has {width} columns: poses have 8 (TUM: time x y z qx qy qz qw), 12 (KITTI), or 16, or four in blocks "
        "of four lines; or name the columns in the first line, such as time,x,y,z,qw,qx,qy,qz"
    )
    raise ValueError(msg)


def read_calibration(path: Path) -> NDArray[np.float64] | None:
    """``Tr``, or ``Tr_velo_to_cam``, of a KITTI calibration, as T_camera_sensor (4, 4); None if the file has neither."""
    check_regular_file(path)
    try:
        lines = [line.partition(":") for line in read_text(path).splitlines()]
        found = {key.strip(): values.split() for key, _, values in lines}
        key = next((key for key in _CALIBRATION_KEYS if key in found), None)
        if key is None:
            return None
        T_camera_sensor = np.eye(4)
        T_camera_sensor[:3] = np.array(found[key], np.float64).reshape(3, 4)
    except ValueError as error:
        msg = f"{path} is not a KITTI calibration: {error}"
        raise ValueError(msg) from error
    return check_pose(T_camera_sensor, f"{path}: Tr")


def _named(
    table: NDArray[np.float64],
    columns: dict[str, int],
    head: list[str],
    path: Path,
    notes: Notes,
    lines: list[int],
) -> StampedPoses | NDArray[np.float64]:
    """Poses of named columns: by time, or in their order."""
    if missing := [role for role in ("z", "roll", "pitch") if "qw" not in columns and role not in columns]:
        notes.add(f"{path.name} has no {', '.join(missing)}: taken as 0")
    position = [table[:, columns[axis]] if axis in columns else np.zeros(len(table)) for axis in "xyz"]
    poses = np.column_stack([*position, rotations_of(table, columns, head, path.name, notes)])
    if "nsec" in columns:
        times = table[:, columns["sec"]] + 1e-9 * table[:, columns["nsec"]]
    elif "time" in columns:
        times = table[:, columns["time"]] * SCALES.get(without_unit(head[columns["time"]])[1], 1.0)
    else:
        return poses_or_nan(pose_matrices_of(poses), str(path), notes, lines)
    return _stamped(np.column_stack([times, poses]), path, notes, lines)


def _kitti(
    table: NDArray[np.float64], path: Path, notes: Notes, lines: list[int], calibration: Sequence[Path]
) -> NDArray[np.float64]:
    """Poses of rows (F, 12), turned from the camera to the sensor if there is a calibration."""
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table.reshape(-1, 3, 4)
    checked = poses_or_nan(poses, str(path), notes, lines)
    for file in calibration:
        if file.is_file() and (T_camera_sensor := read_calibration(file)) is not None:
            notes.add(
                f"KITTI poses with Tr of {file.name}: T_world_sensor = inv(Tr) P Tr, the world is the first scan"
            )
            moved: NDArray[np.float64] = np.linalg.inv(T_camera_sensor) @ checked @ T_camera_sensor
            return moved
    notes.add(f"{path.name} has KITTI poses and there is no calibration Tr: they are taken as T_world_sensor")
    return checked


def _stamped(table: NDArray[np.float64], path: Path, notes: Notes, lines: list[int]) -> Trajectory:
    """The trajectory in rows (P, 8) of time, position and quaternion."""
    finite = np.isfinite(table[:, 0])
    table[finite, 0] = in_seconds(table[finite, 0], path.name, notes)
    return trajectory_of(table, str(path), notes, lines)


def poses_or_nan(
    poses: NDArray[Any], name: str, notes: Notes, lines: Sequence[int] | None = None
) -> NDArray[np.float64]:
    """Poses (F, 4, 4) in the order of scans. Those that are not finite or rigid are NaN, and named: their scans have none."""
    if poses.ndim != 3 or poses.dtype.kind not in "iuf":
        msg = f"{name} must hold poses (F, 4, 4), not {poses.dtype} {poses.shape}"
        raise ValueError(msg)
    try:
        matrices = pose_matrices(poses)
        missing = ~np.isfinite(matrices).all(axis=(1, 2)) | ~matrices[:, :3, :3].any(axis=(1, 2))
        bad = ~are_rigid(matrices)
        if 2 * (bad & ~missing).sum() >= max((~missing).sum(), 1):
            check_poses(matrices[~missing])
    except ValueError as error:
        msg = f"{name}: {error}"
        raise ValueError(msg) from error
    if bad.all() and len(bad):
        msg = f"{name}: no pose is finite"
        raise ValueError(msg)
    if bad.any():
        notes.add(
            f"scans left out: {bad.sum()} of {len(bad)} poses of {name} are not finite and rigid: {listed(bad, lines)}"
        )
    return np.where(bad[:, None, None], np.nan, matrices)
