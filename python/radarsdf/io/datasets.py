# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Published data sets, found by the shape of their folders; `DATASETS` lists them.

The reader of each knows where the scans, the poses and the pose of the radar on its platform are. What a user gives to
:func:`radarsdf.io.read` comes first: poses, extrinsic, topics, fields.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sized
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import check_pose
from radarsdf.io import snail_radar
from radarsdf.io.bags.reading import bags_in, read_bags
from radarsdf.io.files import reading
from radarsdf.io.folders import BASE_T_RADAR, natural, scans_of_files
from radarsdf.io.poses.files import poses_of, read_calibration, read_transform
from radarsdf.io.poses.trajectory import pose_matrices_of, trajectory_of
from radarsdf.io.recordings import Request
from radarsdf.io.scans import Scans
from radarsdf.io.text import read_numbers, read_text


@dataclass(frozen=True)
class Dataset:
    """A published data set."""

    name: str
    fits: Callable[[Path], bool]
    """Whether a folder has its shape."""
    read: Callable[[Path, Request], Scans]
    """The scans of a folder; see :func:`radarsdf.io.read`."""


def _ntu4dradlm_bags(folder: Path) -> list[Path]:
    return [path for path in bags_in(folder) if path.stem != "gt_odom"]


def _ntu4dradlm(folder: Path, request: Request) -> Scans:
    """Bags and ``gt_odom.txt`` (TUM), github.com/junzhang2016/NTU4DRadLM.

    The scans are of ``/radar_enhanced_pcl``, a ``sensor_msgs/PointCloud``. The poses are those of the platform: the folder
    ``calib`` of the data set has the calibrations, to be given by `extrinsic`.
    """
    if request.poses is None:
        request = replace(request, poses=folder / "gt_odom.txt")
    if request.extrinsic is None:
        request.notes.add(
            "NTU4DRadLM: no extrinsic is given, so the poses of gt_odom.txt are taken as those of the radar; "
            "the calibration of the data set has it"
        )
    return read_bags(_ntu4dradlm_bags(folder), request)


def _msc_rad4r(folder: Path, request: Request) -> Scans:
    """``3_RADAR/PCD/000000.pcd`` and ``3_RADAR/timestamp_radar.txt``: lines of a number, seconds and nanoseconds.

    The data set has positions but no poses: they must be given, such as a TUM file of odometry.
    """
    if request.poses is None:
        msg = f"{folder}: MSC-RAD4R has positions but no poses: give poses, such as a TUM file of lidar odometry"
        raise ValueError(msg)
    stamps = folder / "3_RADAR" / "timestamp_radar.txt"
    times_s = [float(seconds + 1e-9 * nanoseconds) for _, seconds, nanoseconds in read_numbers(stamps, 3)]
    files = sorted((folder / "3_RADAR" / "PCD").glob("*.pcd"), key=natural)
    _check_count(times_s, files, stamps)
    return _of_files(files, times_s, request.extrinsic, request)


def _coloradar(folder: Path, request: Request) -> Scans:
    """The single-chip radar of ColoRadar, arpg.github.io/coloradar.

    ``single_chip/pointclouds/data/radar_pointcloud_0.bin`` has rows of x, y, z, intensity and Doppler; poses of the
    platform are in ``groundtruth``. The pose of the radar is looked for in ``calib/transforms`` of the folder and of the two
    above it.
    """
    clouds, truth = folder / "single_chip" / "pointclouds", folder / "groundtruth"
    files = sorted((clouds / "data").glob("radar_pointcloud_*.bin"), key=natural)
    times_s = read_numbers(clouds / "timestamps.txt", 1)[:, 0].tolist()
    _check_count(times_s, files, clouds / "timestamps.txt")
    poses, extrinsic = request.poses, request.extrinsic
    if poses is None:
        stamps = read_numbers(truth / "timestamps.txt", 1)
        table = read_numbers(truth / "groundtruth_poses.txt", 7)
        _check_count(stamps, table, truth / "timestamps.txt")
        poses = trajectory_of(np.column_stack([stamps, table]), str(truth), request.notes)
    if extrinsic is None:
        places = (folder, *folder.resolve().parents[:2])
        found = [place / "calib" / "transforms" / "base_to_single_chip.txt" for place in places]
        file = next((path for path in found if path.is_file()), None)
        if file is not None:
            extrinsic = _translation_and_quaternion(file)
        else:
            request.notes.add(
                "there is no calib/transforms/base_to_single_chip.txt: the poses are taken as those of the radar"
            )
    return _of_files(files, times_s, extrinsic, replace(request, poses=poses, columns=request.columns or 5))


def _delft_parts(folder: Path) -> tuple[Path, Path] | None:
    """The training folders of the radar, and of the poses."""
    folder = folder.resolve()
    for radar, poses in ((folder / "radar", folder / "lidar"), (folder, folder.parent / "lidar")):
        if (radar / "training" / "velodyne").is_dir() and (poses / "training" / "pose").is_dir():
            return radar / "training", poses / "training"
    return None


def _view_of_delft(folder: Path, request: Request) -> Scans:
    """View-of-Delft, whole or one of its radar folders, github.com/tudelft-iv/view-of-delft-dataset.

    ``radar/training/velodyne/00000.bin`` has rows of x, y, z, RCS, v_r, compensated v_r and time;
    ``radar/training/calib`` the pose of the radar in the camera, and ``lidar/training/pose`` that of the camera in the map.
    Of the whole data set, ``radar`` is read; ``radar_3frames`` and ``radar_5frames`` are read by their own names.
    """
    parts = _delft_parts(folder)
    assert parts is not None
    radar, lidar = parts
    files = sorted((radar / "velodyne").glob("*.bin"), key=natural)
    request = replace(request, columns=request.columns or 7)
    if request.poses is not None:
        return _of_files(files, None, request.extrinsic, request)
    posed_files = [path for path in files if (lidar / "pose" / f"{path.stem}.json").is_file()]
    if not posed_files:
        msg = f"{lidar / 'pose'} has a pose for none of the {len(files)} scans in {radar / 'velodyne'}"
        raise ValueError(msg)
    if len(posed_files) < len(files):
        request.notes.add(f"{len(files) - len(posed_files)} scans left out: they have no file of a pose")
    request.notes.add("the scans have no times; the world is the map frame of View-of-Delft")
    poses = np.stack([_delft_pose(path.stem, radar, lidar, request.extrinsic) for path in posed_files])
    return scans_of_files(posed_files, None, poses, None, request)


def _delft_pose(
    frame: str, radar: Path, lidar: Path, extrinsic: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """T_map_radar (4, 4) of a frame. ``mapToCamera`` is T_map_camera, whatever its name says."""
    path = lidar / "pose" / f"{frame}.json"
    with reading(path, "a pose mapToCamera of View-of-Delft", TypeError, IndexError, RecursionError):
        # An object a line.
        lines = [json.loads(line) for line in read_text(path).splitlines() if line.strip()]
        T_map_camera = [record["mapToCamera"] for record in lines if "mapToCamera" in record][-1]
        T_map_camera = check_pose(np.array(T_map_camera, np.float64).reshape(4, 4), "mapToCamera")
    T_camera_radar = extrinsic
    if T_camera_radar is None:
        T_camera_radar = read_calibration(radar / "calib" / f"{frame}.txt")
    if T_camera_radar is None:
        msg = f"{radar / 'calib' / frame}.txt lacks Tr_velo_to_cam"
        raise ValueError(msg)
    T_map_radar: NDArray[np.float64] = T_map_camera @ T_camera_radar
    return T_map_radar


def _viking_hill(folder: Path, request: Request) -> Scans:
    """Bags with ``/hugin_raf_1/radar_data`` and ``/icp_odom``, and the pose of the radar on the platform.

    Its export as a folder of PCD files with ``poses.txt`` is read as any folder of scans.
    """
    if request.extrinsic is None:
        request = replace(request, extrinsic=read_transform(folder / BASE_T_RADAR, np.eye(4)))
    return read_bags(bags_in(folder), request)


DATASETS = (
    Dataset("SNAIL-Radar", snail_radar.is_snail_radar, snail_radar.read),
    Dataset("View-of-Delft", lambda folder: _delft_parts(folder) is not None, _view_of_delft),
    Dataset("ColoRadar", lambda folder: (folder / "single_chip/pointclouds/data").is_dir(), _coloradar),
    Dataset(
        "MSC-RAD4R",
        lambda folder: (
            (folder / "3_RADAR/PCD").is_dir() and (folder / "3_RADAR/timestamp_radar.txt").is_file()
        ),
        _msc_rad4r,
    ),
    Dataset(
        "NTU4DRadLM",
        lambda folder: (folder / "gt_odom.txt").is_file() and bool(_ntu4dradlm_bags(folder)),
        _ntu4dradlm,
    ),
    Dataset(
        "Viking Hill",
        lambda folder: (folder / BASE_T_RADAR).is_file() and bool(bags_in(folder)),
        _viking_hill,
    ),
)
"""The data sets. The first that fits a folder reads it."""


def find(folder: Path) -> Dataset | None:
    """The data set whose shape a folder has; None if it has none."""
    return next((dataset for dataset in DATASETS if dataset.fits(folder)), None)


def _of_files(
    files: list[Path],
    times_s: list[float] | None,
    T_base_sensor: NDArray[np.float64] | None,
    request: Request,
) -> Scans:
    """Scans of one file each, with the poses of the request."""
    if not files:
        msg = "the folder of the scans is empty"
        raise ValueError(msg)
    return scans_of_files(files, times_s, poses_of(request.poses, request.notes), T_base_sensor, request)


def _check_count(times: Sized, wanted: Sized, path: Path) -> None:
    if len(times) != len(wanted):
        msg = f"{path} has {len(times)} lines for {len(wanted)} scans or poses"
        raise ValueError(msg)


def _translation_and_quaternion(path: Path) -> NDArray[np.float64]:
    """T_base_sensor (4, 4) of two lines: x y z, and qx qy qz qw."""
    with reading(path, "two lines x y z and qx qy qz qw"):
        numbers = np.array(read_text(path).split(), np.float64)
        return check_pose(pose_matrices_of(numbers.reshape(1, 7))[0], "it")
