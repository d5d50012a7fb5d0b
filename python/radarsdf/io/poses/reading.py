# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses from files, and which scan has which: by time stamp, or in their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checks import check_pose, check_poses, real_array
from radarsdf.io.files import check_regular_file
from radarsdf.io.npz import array_in
from radarsdf.io.poses.trajectory import Trajectory, in_seconds, read_table, trajectory_of_table
from radarsdf.io.scans import Notes
from radarsdf.io.text import read_text

POSE_FILES = ("poses.txt", "poses.tum", "poses.csv", "poses.npy", "trajectory.txt", "traj.txt", "gt_odom.txt")
"""Names of files of poses that are found beside scans."""

FIND_POSES = "radarsdf poses finds them from the radar alone"
"""Ends what is said of scans without poses."""

_TUM_COLUMNS, _KITTI_COLUMNS, _MATRIX_COLUMNS = 8, 12, 16
_MIN_QUATERNION, _MAX_QUATERNION = 0.49, 1.01  # largest of the four numbers of a unit quaternion
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
        elif time_s is None:
            return None
        else:
            T_world_base = self.poses.pose_at(time_s, self.max_gap_s)
        if T_world_base is None:
            return None
        T_world_sensor: NDArray[np.float64] = T_world_base @ self.T_base_sensor
        return T_world_sensor


def extrinsic_of(extrinsic: Any) -> NDArray[np.float64] | None:
    """`extrinsic` as a checked T_base_sensor (4, 4), or None.

    Raises
    ------
    ValueError
        If it is not a rigid transform.
    """
    return None if extrinsic is None else check_pose(extrinsic, "extrinsic T_base_sensor")


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
    return check_poses(matrices)


def read_poses(
    path: Path, notes: Notes, calibration: Sequence[Path] = ()
) -> StampedPoses | NDArray[np.float64]:
    """Reads a file of poses.

    Parameters
    ----------
    path : Path
        One of

        - TUM: lines of ``time x y z qx qy qz qw``, s and m: T_world_base by time;
        - KITTI: lines of twelve numbers, the first three rows of a matrix. With a calibration ``Tr``, the transform from
          the sensor to the camera, T_world_sensor = inv(Tr) · P · Tr, so that the world is the first scan's sensor frame;
          without one, the lines are taken as T_world_base;
        - our own: 4 x 4 matrices T_world_base, as lines of sixteen numbers or blocks of four lines, or an array
          (F, 4, 4) in an ``.npy`` file.

        Text may have commas or semicolons, names in its first line, and comments after ``#``. Times of TUM may be in ms,
        µs or ns since 1970.
    notes : Notes
        Is told what was assumed.
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
        return _checked(np.array(array_in(path)), path)
    table = read_table(path)
    if table.shape[1] == _TUM_COLUMNS:
        table[:, 0] = in_seconds(table[:, 0], path, notes)
        return trajectory_of_table(table, path)
    if table.shape[1] == _KITTI_COLUMNS:
        poses = np.tile(np.eye(4), (len(table), 1, 1))
        poses[:, :3] = table.reshape(-1, 3, 4)
        checked = _checked(poses, path)
        for file in calibration:
            if file.is_file() and (T_camera_sensor := read_calibration(file)) is not None:
                notes.add(
                    f"KITTI poses with Tr of {file.name}: T_world_sensor = inv(Tr) P Tr, the world is the first scan"
                )
                moved: NDArray[np.float64] = np.linalg.inv(T_camera_sensor) @ checked @ T_camera_sensor
                return moved
        notes.add(
            f"{path.name} has KITTI poses and there is no calibration Tr: they are taken as T_world_sensor"
        )
        return checked
    if table.shape[1] == _MATRIX_COLUMNS:
        return _checked(table.reshape(-1, 4, 4), path)
    if table.shape[1] == 4 and len(table) % 4 == 0:
        return _checked(table.reshape(-1, 4, 4), path)
    msg = (
        f"{path} has {table.shape[1]} columns: poses have 8 (TUM: time x y z qx qy qz qw), 12 (KITTI), or 16, or four "
        "in blocks of four lines"
    )
    raise ValueError(msg)


def read_calibration(path: Path) -> NDArray[np.float64] | None:
    """``Tr``, or ``Tr_velo_to_cam``, of a KITTI calibration, as T_camera_sensor (4, 4); None if the file has neither.

    Raises
    ------
    ValueError
        If it does not hold twelve numbers, or they are no rigid transform.
    OSError
        If the file cannot be read.
    """
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
    checked: NDArray[np.float64] = _checked(T_camera_sensor[None], path)[0]
    return checked


def trajectory_of(
    times_s: Sequence[float] | NDArray[np.float64], positions: Any, quaternions: Any, name: str
) -> Trajectory:
    """A trajectory of poses in any order, such as of a bag. Of several at one time, the first counts.

    Raises
    ------
    ValueError
        If there are fewer than two poses, or they are no poses.
    """
    times, first = np.unique(np.asarray(times_s, np.float64), return_index=True)
    if len(times) < 2:
        msg = f"{name} holds {len(times)} poses at different times; at least two are needed"
        raise ValueError(msg)
    xyz = np.asarray(positions, np.float64).reshape(-1, 3)[first]
    quats = np.asarray(quaternions, np.float64).reshape(-1, 4)[first]
    largest = np.abs(quats).max(axis=1)  # not the length, whose square overflows for damaged numbers
    if not (np.isfinite(xyz).all() and ((largest >= _MIN_QUATERNION) & (largest <= _MAX_QUATERNION)).all()):
        msg = f"{name} holds poses that are not finite, or without a unit quaternion"
        raise ValueError(msg)
    return Trajectory(times, xyz, Rotation.from_quat(quats), name)


def _checked(poses: NDArray[Any], path: Path) -> NDArray[np.float64]:
    if poses.ndim != 3 or poses.dtype.kind not in "iuf":
        msg = f"{path} must hold poses (F, 4, 4), not {poses.dtype} {poses.shape}"
        raise ValueError(msg)
    try:
        return check_poses(poses)
    except ValueError as error:
        msg = f"{path}: {error}"
        raise ValueError(msg) from error
