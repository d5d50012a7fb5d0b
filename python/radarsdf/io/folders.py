# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans from folders: a plain folder with poses, or a sequence of SNAIL-Radar.

The points of each sensor are in its own frame, in m. `T_a_b` transforms points of frame b to frame a, and so does the
matrix in a file `a_T_b.txt`. There is no other transformation: if the poses are in UTM, so is the world frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
import trimesh
from numpy.typing import NDArray

from radarsdf._core import cell_keys
from radarsdf.checks import check_poses
from radarsdf.io.pcd import read_pcd
from radarsdf.io.sequence import Scans
from radarsdf.io.trajectory import MAX_GAP_S, Trajectory, read_table, read_trajectory

INTENSITY_FIELDS = ("power", "Power", "intensity", "rcs")
"""Names of the intensity in PCD files, of which the first that is present counts. Hugin: power; Oculii: Power."""

# The published calibration of the SNAIL-Radar rig, for sequences without calibration files. The axes of the body point
# forward, left and up; its origin is that of the lidar. Source: matlab/Body_T_Xt32.m and Body_T_Oculii.m ("refined"),
# multiplied out, of github.com/snail-radar/dataset_tools, commit 2f82c2c. Its python/view_radar_lidar.py has the same.
_BODY_T_XT32 = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_BODY_T_OCULII = np.array(
    [
        [0.999756831, 0.020010494, -0.009265982, 0.07],
        [-0.019750133, 0.999429818, 0.027385610, 0.0],
        [0.009808698, -0.027195946, 0.999581997, -0.115],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_LIDAR_RANGE_M = (1.0, 60.0)  # nearer points are on the platform or its operator; the radar sees no farther
_LIDAR_CELL_M = (
    0.05  # one lidar point per cell: otherwise most would lie on the ground where the platform stood
)
_LIDAR_BATCH = 50  # scans from one thinning to the next; bounds the memory
_MAX_SWEEP_S = 1.0  # larger differences between the times of a point and of its scan mean different clocks


def is_snail_radar(folder: Path) -> bool:
    """Whether the folder is a sequence of SNAIL-Radar with point clouds of the Oculii radar."""
    return (folder / "eagleg7" / "enhanced").is_dir()


def is_posed_folder(folder: Path) -> bool:
    """Whether :func:`read_posed_folder` reads the folder."""
    return (folder / "radar").is_dir() and (folder / "poses.txt").is_file()


def read_posed_folder(folder: Path, frames: int | None = None) -> Scans:
    """Reads a plain folder of scans with poses, such as a ROS bag exported.

    ::

        radar/1717252210.123456.pcd   one file per scan, named by its time, s
        poses.txt                     lines of: time x y z qx qy qz qw (TUM format), T_world_base
        base_T_radar.txt              optional: 4 x 4, if the poses are not those of the radar frame
        lidar.pcd or lidar.ply        optional: ground truth, world frame, m

    A recording of Viking Hill (Hugin A3, ROS bags) becomes such a folder as follows:

    - each message of ``/hugin_raf_1/radar_data`` is a PCD file with the fields x, y, z and power;
    - ``/icp_odom`` (poses of base_link in map) is ``poses.txt``;
    - the pose of the radar from the calibration of the data set is ``base_T_radar.txt``;
    - a reference map ``*_map_subsampled.pcd``, which is in the same map frame, is ``lidar.pcd``.

    Parameters
    ----------
    folder : Path
        A folder as above. These are left out: returns that are not finite, scans without a return, and scans before
        the first or after the last pose.
    frames : int, optional
        Number of scans to read, from the first. Default: all.

    Returns
    -------
    Scans
        Points float32, radar frame, m. Poses T_world_radar. Intensities from the first of `INTENSITY_FIELDS` that the
        first scan has, or None. Ground truth (M, 3) float64, or None.

    Raises
    ------
    ValueError
        If files are missing, damaged or do not fit together, or the poses before and after a scan are more than
        `MAX_GAP_S` apart.
    OSError
        If a file cannot be read.
    """
    trajectory = read_trajectory(folder / "poses.txt")
    T_base_radar = base_T_radar(folder)
    scans, _ = _read_radar(folder / "radar", trajectory, T_base_radar, frames)
    return Scans(scans.points, scans.poses, scans.intensities, lidar_map(folder))


def read_snail_radar(folder: Path, frames: int | None = None) -> Scans:
    """Reads a sequence of SNAIL-Radar: the enhanced clouds of the Oculii Eagle, and the lidar as ground truth.

    ::

        eagleg7/enhanced/1706001766.577286344.pcd   Oculii frame (forward, left, up); intensity: Power
        utm50r_T_xt32.txt                           time x y z qx qy qz qw: the full trajectory of the lidar
        xt32/1706001766.715735580.pcd               optional: lidar scan, lidar frame (left, back, up)
        body_T_oculii.txt, body_T_xt32.txt          optional: 4 x 4, instead of the published calibration
        lidar.pcd or lidar.ply                      optional: ground truth instead of xt32, UTM zone 50R, m

    Copy ``utm50r_T_xt32.txt`` from the data set's folder ``full_trajs/<date>/<sequence>``. Of the radar, only x, y and
    z are used: its angles are in another frame (right, down, forward). ``tf_static.launch`` is not read.

    Parameters
    ----------
    folder : Path
        A folder as above. The same returns and scans are left out as by :func:`read_posed_folder`.
    frames : int, optional
        Number of scans to read, from the first. Default: all. Lidar scans are read from the first to the last of them.

    Returns
    -------
    Scans
        As of :func:`read_posed_folder`, with UTM zone 50R as the world frame. The ground truth holds lidar points with
        a range of 1 to 60 m, at most one in each cell of 5 cm. Each is moved with the pose at its own time, or at the
        time of its scan if the file has no field ``timestamp``.

    Raises
    ------
    ValueError, OSError
        As :func:`read_posed_folder`.
    """
    snail = SnailRadar.of(folder)
    scans, times_s = _read_radar(snail.radar, snail.trajectory, snail.T_base_radar, frames)
    return Scans(scans.points, scans.poses, scans.intensities, snail.ground_truth(times_s))


@dataclass(frozen=True, eq=False)
class SnailRadar:
    """A sequence of SNAIL-Radar, as far as it is read at once; see :func:`read_snail_radar`."""

    folder: Path
    radar: Path
    """The folder of the clouds of the radar."""
    trajectory: Trajectory
    """Of the lidar, in UTM zone 50R."""
    T_base_radar: NDArray[np.float64]
    """The radar in the frame of the lidar."""

    @classmethod
    def of(cls, folder: Path) -> SnailRadar:
        """The sequence in a folder. Raises as :func:`read_snail_radar`."""
        if not (folder / "utm50r_T_xt32.txt").is_file():
            msg = (
                f"{folder} lacks utm50r_T_xt32.txt: copy it from full_trajs/<date>/<sequence> of the data set"
            )
            raise ValueError(msg)
        trajectory = read_trajectory(folder / "utm50r_T_xt32.txt")
        T_body_xt32 = _transform(folder / "body_T_xt32.txt", _BODY_T_XT32)
        T_body_oculii = _transform(folder / "body_T_oculii.txt", _BODY_T_OCULII)
        T_xt32_oculii: NDArray[np.float64] = np.linalg.inv(T_body_xt32) @ T_body_oculii
        return cls(folder, folder / "eagleg7" / "enhanced", trajectory, T_xt32_oculii)

    def files(self) -> list[tuple[float, Path]]:
        """Times, s, and files of the clouds of the radar."""
        return _stamped_files(self.radar)

    def ground_truth(self, times_s: NDArray[np.float64] | None = None) -> NDArray[np.float64] | None:
        """Lidar points (M, 3), UTM zone 50R, m, from the first to the last of these times, or of all scans."""
        points = lidar_map(self.folder)
        if points is None and (self.folder / "xt32").is_dir():
            if times_s is None:
                times_s = np.array([time_s for time_s, _ in self.files()])
                times_s = times_s[self.trajectory.covers(times_s)]
            if len(times_s):
                points = _read_lidar_scans(self.folder / "xt32", self.trajectory, times_s[0], times_s[-1])
        return points


def base_T_radar(folder: Path) -> NDArray[np.float64]:
    """T_base_radar (4, 4) of ``base_T_radar.txt`` in a folder; the identity if there is none."""
    return _transform(folder / "base_T_radar.txt", np.eye(4))


def _stamped_files(folder: Path) -> list[tuple[float, Path]]:
    """Times, s, and paths of the PCD files of a folder, in the order of time."""
    files = []
    for path in folder.glob("*.pcd"):
        try:
            time_s = float(path.stem)
        except ValueError:
            time_s = np.nan
        if not np.isfinite(time_s):
            msg = f"{path} is not named by its time in seconds"
            raise ValueError(msg)
        files.append((time_s, path))
    return sorted(files)


def _read_radar(
    folder: Path, trajectory: Trajectory, T_base_radar: NDArray[np.float64], frames: int | None
) -> tuple[Scans, NDArray[np.float64]]:
    """F scans without ground truth, and their times (F,), s."""
    files = _stamped_files(folder)
    if not files:
        msg = f"{folder} holds no .pcd files"
        raise ValueError(msg)
    covered = trajectory.covers(np.array([time_s for time_s, _ in files]))
    if not covered.any():
        span = f"{files[0][0]} to {files[-1][0]} s"
        msg = f"no scan of {folder} ({span}) lies within the poses ({trajectory.span()})"
        raise ValueError(msg)
    times_s: list[float] = []
    points: list[NDArray[Any]] = []
    intensities: list[NDArray[Any]] = []
    field = None
    for (time_s, path), inside in zip(files, covered, strict=True):
        if len(points) == frames:
            break
        if not inside:
            continue
        columns = read_pcd(path)
        if not points:
            field = next((name for name in INTENSITY_FIELDS if name in columns), None)
        xyz = _xyz(columns, path)
        if field is None:
            values = np.zeros(len(xyz))
        elif field in columns:
            values = columns[field]
        else:
            msg = f"{path} lacks the field {field}, which other scans have"
            raise ValueError(msg)
        finite = np.isfinite(xyz).all(axis=1) & np.isfinite(values)
        if finite.any():
            times_s.append(time_s)
            points.append(xyz[finite].astype(np.float32))
            intensities.append(values[finite].astype(np.float32))
    if not points:
        msg = f"the scans of {folder} hold no returns"
        raise ValueError(msg)
    times = np.array(times_s)
    poses = trajectory.poses(times, MAX_GAP_S) @ T_base_radar
    return Scans(points, poses, None if field is None else intensities), times


def lidar_map(folder: Path) -> NDArray[np.float64] | None:
    """Points (M, 3), world frame, m, of ``lidar.pcd`` or ``lidar.ply``. None if there is neither."""
    if (path := folder / "lidar.pcd").is_file():
        points = _xyz(read_pcd(path), path)
    elif (path := folder / "lidar.ply").is_file():
        points = _read_ply(path)
    else:
        return None
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        msg = f"{path} holds no points"
        raise ValueError(msg)
    return points


def _read_ply(path: Path) -> NDArray[np.float64]:
    try:
        vertices = getattr(trimesh.load(path, process=False), "vertices", np.zeros((0, 3)))
        return np.asarray(vertices, np.float64)
    except OSError:
        raise
    except Exception as error:  # trimesh raises exceptions of many kinds for damaged files
        msg = f"{path} is not a whole PLY file of points: {error}"
        raise ValueError(msg) from error


def _read_lidar_scans(
    folder: Path, trajectory: Trajectory, first_s: float, last_s: float
) -> NDArray[np.float64] | None:
    """Points (M, 3), world frame, m, of all lidar scans between two times, at most one in each cell."""
    origin = trajectory.positions[0]  # cell keys are relative to it: UTM coordinates are out of their range
    found = [np.zeros((0, 3))]
    for count, world in enumerate(_lidar_scans(folder, trajectory, first_s, last_s), 1):
        found.append(_thin(world - origin))
        if count % _LIDAR_BATCH == 0:
            found = [_thin(np.concatenate(found))]
    points = _thin(np.concatenate(found)) + origin
    return points if len(points) else None


def _lidar_scans(
    folder: Path, trajectory: Trajectory, first_s: float, last_s: float
) -> Iterator[NDArray[np.float64]]:
    for time_s, path in _stamped_files(folder):
        if not first_s <= time_s <= last_s:
            continue
        columns = read_pcd(path)
        xyz = _xyz(columns, path)
        times_s = columns.get("timestamp", np.full(len(xyz), time_s)).astype(np.float64)
        ranges_m = np.linalg.norm(xyz, axis=1)
        used = (ranges_m >= _LIDAR_RANGE_M[0]) & (ranges_m <= _LIDAR_RANGE_M[1]) & np.isfinite(times_s)
        if (np.abs(times_s[used] - time_s) > _MAX_SWEEP_S).any():
            msg = f"{path}: the times of its points differ by more than {_MAX_SWEEP_S} s from the time in its name"
            raise ValueError(msg)
        used &= trajectory.covers(times_s)
        yield trajectory.move(xyz[used], times_s[used], MAX_GAP_S)


def _thin(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The first point (K, 3) in each cell of points (N, 3)."""
    _, first = np.unique(cell_keys(points, _LIDAR_CELL_M), return_index=True)
    kept: NDArray[np.float64] = points[np.sort(first)]
    return kept


def _xyz(columns: dict[str, NDArray[Any]], path: Path) -> NDArray[np.float64]:
    if missing := [name for name in "xyz" if name not in columns]:
        msg = f"{path} lacks the fields {', '.join(missing)}: it has {', '.join(columns)}"
        raise ValueError(msg)
    return np.stack([columns[name].astype(np.float64) for name in "xyz"], axis=1)


def _transform(path: Path, default: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rigid transform (4, 4) from a text file, or the default if there is no file."""
    if not path.is_file():
        return default
    matrix = read_table(path, 4)
    try:
        poses = check_poses(matrix[None], 1)
    except ValueError as error:
        msg = f"{path} does not hold a rigid transform: {error}"
        raise ValueError(msg) from error
    transform: NDArray[np.float64] = poses[0]
    return transform
