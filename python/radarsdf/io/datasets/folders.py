# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans from a plain folder with poses, and what such folders share with data sets.

The points of each sensor are in its own frame, in m. `T_a_b` transforms points of frame b to frame a, and so does the
matrix in a file `a_T_b.txt`. There is no other transformation: if the poses are in UTM, so is the world frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import check_poses
from radarsdf.interrupts import whole_import
from radarsdf.io.clouds.pcd import read_pcd
from radarsdf.io.poses.trajectory import MAX_GAP_S, Trajectory, read_table, read_trajectory
from radarsdf.io.scans import Scans

BASE_T_RADAR = "base_T_radar.txt"
"""A file beside scans: 4 x 4, the pose of the radar in the frame that has the poses."""

INTENSITY_FIELDS = ("power", "Power", "intensity", "rcs")
"""Names of the intensity in PCD files, of which the first that is present counts. Hugin: power; Oculii: Power."""


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
    scans, _ = read_stamped_scans(folder / "radar", trajectory, T_base_radar, frames)
    return Scans(scans.points, scans.poses, scans.intensities, lidar_map(folder))


def base_T_radar(folder: Path) -> NDArray[np.float64]:
    """T_base_radar (4, 4) of ``base_T_radar.txt`` in a folder; the identity if there is none."""
    return read_transform(folder / BASE_T_RADAR, np.eye(4))


def stamped_files(folder: Path) -> list[tuple[float, Path]]:
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


def read_stamped_scans(
    folder: Path, trajectory: Trajectory, T_base_radar: NDArray[np.float64], frames: int | None
) -> tuple[Scans, NDArray[np.float64]]:
    """F scans without ground truth, and their times (F,), s."""
    files = stamped_files(folder)
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
        xyz = xyz_of(columns, path)
        if field is None:
            values = np.zeros(len(xyz))
        elif field in columns:
            values = columns[field]
        else:
            msg = f"{path} lacks the field {field}, which other scans have"
            raise ValueError(msg)
        if field is None and (found := [name for name in INTENSITY_FIELDS if name in columns]):
            msg = f"{path} has the field {found[0]}, which scans before it lack"
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
        points = xyz_of(read_pcd(path), path)
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
    with whole_import():
        import trimesh  # noqa: PLC0415 - takes long

    try:
        vertices = getattr(trimesh.load(path, process=False), "vertices", np.zeros((0, 3)))
        return np.asarray(vertices, np.float64)
    except OSError:
        raise
    except Exception as error:  # trimesh raises exceptions of many kinds for damaged files
        msg = f"{path} is not a whole PLY file of points: {error}"
        raise ValueError(msg) from error


def xyz_of(columns: dict[str, NDArray[Any]], path: Path) -> NDArray[np.float64]:
    if missing := [name for name in "xyz" if name not in columns]:
        msg = f"{path} lacks the fields {', '.join(missing)}: it has {', '.join(columns)}"
        raise ValueError(msg)
    return np.stack([columns[name].astype(np.float64) for name in "xyz"], axis=1)


def read_transform(path: Path, default: NDArray[np.float64]) -> NDArray[np.float64]:
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
