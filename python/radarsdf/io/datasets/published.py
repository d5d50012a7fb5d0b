# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Published data sets, found by the shape of their folders. A class for each; `DATASETS` lists them.

Each knows where the scans, the poses and the pose of the radar on its platform are. What a user gives to
:func:`radarsdf.io.read` comes first: poses, extrinsic, topics, fields.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sized
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import check_pose
from radarsdf.io.bags.files import bags_in
from radarsdf.io.bags.reading import read_bags
from radarsdf.io.datasets.folders import BASE_T_RADAR, base_T_radar
from radarsdf.io.datasets.snail_radar import SnailRadar, is_snail_radar
from radarsdf.io.poses.reading import poses_of, read_calibration
from radarsdf.io.poses.trajectory import pose_matrices_of, read_table, trajectory_of
from radarsdf.io.scans import Scans
from radarsdf.io.sources import Request, natural, scans_of_files
from radarsdf.io.text import read_text


class Dataset(Protocol):
    """A published data set."""

    name: str

    def fits(self, folder: Path) -> bool:
        """Whether a folder has the shape of this data set."""

    def read(self, folder: Path, request: Request) -> Scans:
        """Its scans; see :func:`radarsdf.io.read`."""


class NTU4DRadLM:
    """A sequence of NTU4DRadLM: bags and ``gt_odom.txt`` (TUM), github.com/junzhang2016/NTU4DRadLM.

    The scans are of ``/radar_enhanced_pcl``, a ``sensor_msgs/PointCloud``. The poses are those of the platform: the folder
    ``calib`` of the data set has the calibrations, to be given by `extrinsic`.
    """

    name = "NTU4DRadLM"

    def fits(self, folder: Path) -> bool:
        """Whether a folder has the shape of this data set."""
        return (folder / "gt_odom.txt").is_file() and bool(self._bags(folder))

    def read(self, folder: Path, request: Request) -> Scans:
        """Its scans; see :func:`radarsdf.io.read`."""
        if request.poses is None:
            request = dataclasses.replace(request, poses=folder / "gt_odom.txt")
        _say_without_extrinsic(self.name, "gt_odom.txt", request)
        return read_bags(self._bags(folder), request)

    def _bags(self, folder: Path) -> list[Path]:
        return [path for path in bags_in(folder) if path.stem != "gt_odom"]


class MscRad4R:
    """A sequence of MSC-RAD4R: ``3_RADAR/PCD/000000.pcd`` and ``3_RADAR/timestamp_radar.txt``.

    A line of the latter is a number, seconds and nanoseconds. The data set has positions but no poses: they must be given,
    such as a TUM file of odometry.
    """

    name = "MSC-RAD4R"

    def fits(self, folder: Path) -> bool:
        """Whether a folder has the shape of this data set."""
        return (folder / "3_RADAR" / "PCD").is_dir() and (
            folder / "3_RADAR" / "timestamp_radar.txt"
        ).is_file()

    def read(self, folder: Path, request: Request) -> Scans:
        """Its scans; see :func:`radarsdf.io.read`."""
        if request.poses is None:
            msg = f"{folder}: MSC-RAD4R has positions but no poses: give poses, such as a TUM file of lidar odometry"
            raise ValueError(msg)
        stamps = read_table(folder / "3_RADAR" / "timestamp_radar.txt", 3)
        files = sorted((folder / "3_RADAR" / "PCD").glob("*.pcd"), key=natural)
        times_s = [float(seconds + 1e-9 * nanoseconds) for _, seconds, nanoseconds in stamps]
        _check_count(times_s, files, folder / "3_RADAR" / "timestamp_radar.txt")
        return _of_files(files, times_s, request.extrinsic, request)


class ColoRadar:
    """A sequence of ColoRadar, of its single-chip radar, arpg.github.io/coloradar.

    ``single_chip/pointclouds/data/radar_pointcloud_0.bin`` has rows of x, y, z, intensity and Doppler; poses of the
    platform are in ``groundtruth``. The pose of the radar is looked for in ``calib/transforms`` of the folder and of the two
    above it.
    """

    name = "ColoRadar"

    def fits(self, folder: Path) -> bool:
        """Whether a folder has the shape of this data set."""
        return (folder / "single_chip" / "pointclouds" / "data").is_dir()

    def read(self, folder: Path, request: Request) -> Scans:
        """Its scans; see :func:`radarsdf.io.read`."""
        clouds = folder / "single_chip" / "pointclouds"
        files = sorted((clouds / "data").glob("radar_pointcloud_*.bin"), key=natural)
        times_s = read_table(clouds / "timestamps.txt", 1)[:, 0].tolist()
        _check_count(times_s, files, clouds / "timestamps.txt")
        poses = request.poses
        if poses is None:
            stamps = read_table(folder / "groundtruth" / "timestamps.txt", 1)[:, 0]
            table = read_table(folder / "groundtruth" / "groundtruth_poses.txt", 7)
            _check_count(stamps, table, folder / "groundtruth" / "timestamps.txt")
            poses = trajectory_of(
                np.column_stack([stamps, table]), f"{folder / 'groundtruth'}", request.notes
            )
        T_base_sensor = request.extrinsic
        if T_base_sensor is None:
            places = (folder, *folder.resolve().parents[:2])
            found = [place / "calib" / "transforms" / "base_to_single_chip.txt" for place in places]
            file = next((path for path in found if path.is_file()), None)
            if file is None:
                request.notes.add(
                    "there is no calib/transforms/base_to_single_chip.txt: the poses are taken as those of the radar"
                )
            else:
                T_base_sensor = _translation_and_quaternion(file)
        request = dataclasses.replace(request, poses=poses, columns=request.columns or 5)
        return _of_files(files, times_s, T_base_sensor, request)


class ViewOfDelft:
    """View-of-Delft, whole or one of its radar folders, github.com/tudelft-iv/view-of-delft-dataset.

    ``radar/training/velodyne/00000.bin`` has rows of x, y, z, RCS, v_r, compensated v_r and time;
    ``radar/training/calib`` the pose of the radar in the camera, and ``lidar/training/pose`` that of the camera in the map.
    Of the whole data set, ``radar`` is read; ``radar_3frames`` and ``radar_5frames`` are read by their own names.
    """

    name = "View-of-Delft"

    def fits(self, folder: Path) -> bool:
        """Whether a folder has the shape of this data set."""
        return self._parts(folder) is not None

    def _parts(self, folder: Path) -> tuple[Path, Path] | None:
        """The training folders of the radar, and of the poses."""
        folder = folder.resolve()
        for radar, poses in ((folder / "radar", folder / "lidar"), (folder, folder.parent / "lidar")):
            if (radar / "training" / "velodyne").is_dir() and (poses / "training" / "pose").is_dir():
                return radar / "training", poses / "training"
        return None

    def read(self, folder: Path, request: Request) -> Scans:
        """Its scans; see :func:`radarsdf.io.read`."""
        parts = self._parts(folder)
        assert parts is not None
        radar, lidar = parts
        files = sorted((radar / "velodyne").glob("*.bin"), key=natural)
        request = dataclasses.replace(request, columns=request.columns or 7)
        if request.poses is not None:
            return _of_files(files, None, request.extrinsic, request)
        posed_files = [path for path in files if (lidar / "pose" / f"{path.stem}.json").is_file()]
        if not posed_files:
            msg = f"{lidar / 'pose'} has a pose for none of the {len(files)} scans in {radar / 'velodyne'}"
            raise ValueError(msg)
        if len(posed_files) < len(files):
            request.notes.add(f"{len(files) - len(posed_files)} scans left out: they have no file of a pose")
        request.notes.add("the scans have no times; the world is the map frame of View-of-Delft")
        poses = np.stack([self._pose(path.stem, radar, lidar, request.extrinsic) for path in posed_files])
        return scans_of_files(posed_files, None, poses, None, request)

    def _pose(
        self, frame: str, radar: Path, lidar: Path, extrinsic: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """T_map_radar (4, 4) of a frame. ``mapToCamera`` is T_map_camera, whatever its name says."""
        path = lidar / "pose" / f"{frame}.json"
        T_map_camera = None
        try:
            for line in read_text(path).splitlines():  # an object a line
                if line.strip() and "mapToCamera" in (record := json.loads(line)):
                    T_map_camera = np.array(record["mapToCamera"], np.float64).reshape(4, 4)
            if T_map_camera is None:
                msg = "it lacks mapToCamera"
                raise ValueError(msg)
            T_map_camera = check_pose(T_map_camera, "mapToCamera")
        except (ValueError, TypeError, RecursionError) as error:
            msg = f"{path} is not a pose of View-of-Delft: {error}"
            raise ValueError(msg) from error
        T_camera_radar = extrinsic
        if T_camera_radar is None:
            T_camera_radar = read_calibration(radar / "calib" / f"{frame}.txt")
        if T_camera_radar is None:
            msg = f"{radar / 'calib' / frame}.txt lacks Tr_velo_to_cam"
            raise ValueError(msg)
        T_map_radar: NDArray[np.float64] = T_map_camera @ T_camera_radar
        return T_map_radar


class VikingHill:
    """A sequence of Viking Hill: bags with ``/hugin_raf_1/radar_data`` and ``/icp_odom``.

    A file ``base_T_radar.txt`` beside them, 4 x 4, is the pose of the radar on the platform. Its export as a folder of PCD
    files with ``poses.txt`` is read as any folder of scans.
    """

    name = "Viking Hill"

    def fits(self, folder: Path) -> bool:
        """Whether a folder has the shape of this data set."""
        return (folder / BASE_T_RADAR).is_file() and bool(bags_in(folder))

    def read(self, folder: Path, request: Request) -> Scans:
        """Its scans; see :func:`radarsdf.io.read`."""
        if request.extrinsic is None:
            request = dataclasses.replace(request, extrinsic=base_T_radar(folder))
        return read_bags(bags_in(folder), request)


class Snail:
    """A sequence of SNAIL-Radar, or one radar of it; see :class:`radarsdf.io.datasets.snail_radar.SnailRadar`.

    ``data3`` means its Oculii Eagle, ``data3/ars548/points`` its Continental ARS548.
    """

    name = "SNAIL-Radar"

    def fits(self, folder: Path) -> bool:
        """Whether a folder has the shape of this data set."""
        return is_snail_radar(folder)

    def read(self, folder: Path, request: Request) -> Scans:
        """Its scans; see :func:`radarsdf.io.read`."""
        snail = SnailRadar.of(folder)
        if snail.others() and folder.resolve() == snail.folder:
            others = " and ".join(snail.others())
            request.notes.add(f"{snail.radar} is read; {others} are read as folders of their own")
        files = snail.files()
        poses = snail.trajectory if request.poses is None else request.poses
        extrinsic = snail.T_base_radar if request.extrinsic is None else request.extrinsic
        request = dataclasses.replace(request, poses=poses, truth=request.truth or snail.ground_truth)
        return _of_files([path for _, path in files], [time_s for time_s, _ in files], extrinsic, request)


DATASETS: tuple[Dataset, ...] = (Snail(), ViewOfDelft(), ColoRadar(), MscRad4R(), NTU4DRadLM(), VikingHill())
"""The data sets. The first that fits a folder reads it."""

# What cannot be mapped by returns in 3D, by what is in its folders, and why.
_NAVTECH = "its radar turns in a plane and measures no heights"
_REFUSED: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("Boreas", ("applanix", "radar/*.png"), _NAVTECH),
    ("Oxford Radar RobotCar", ("radar.timestamps",), _NAVTECH),
    ("MulRan", ("sensor_data/radar", "polar/*.png"), _NAVTECH),
    ("K-Radar", ("radar_tesseract", "radar_zyx_cube"), "it has tensors of power, no returns"),
    ("RaDelft", ("RadarCubes", "radar_cubes"), "it has cubes of power, no returns"),
)


def find(folder: Path) -> Dataset | None:
    """The data set whose shape a folder has; None if it has none.

    Raises
    ------
    ValueError
        If it is of a data set that cannot be read, with the reason.
    """
    for dataset in DATASETS:
        if dataset.fits(folder):
            return dataset
    for name, marks, why in _REFUSED:
        if any(next(folder.glob(mark), None) is not None for mark in marks):
            msg = f"{folder} looks like {name}, which cannot be mapped: {why}. Returns in 3D with poses are needed"
            raise ValueError(msg)
    return None


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


def _say_without_extrinsic(name: str, poses: str, request: Request) -> None:
    if request.extrinsic is None:
        request.notes.add(
            f"{name}: no extrinsic is given, so the poses of {poses} are taken as those of the radar; "
            "the calibration of the data set has it"
        )


def _translation_and_quaternion(path: Path) -> NDArray[np.float64]:
    """T_base_sensor (4, 4) of two lines: x y z, and qx qy qz qw."""
    try:
        rows = [
            [float(word) for word in line.split()] for line in read_text(path).splitlines() if line.strip()
        ]
        if [len(row) for row in rows] != [3, 4]:
            msg = "it has not one line x y z and one line qx qy qz qw"
            raise ValueError(msg)
        return check_pose(pose_matrices_of(np.array([[*rows[0], *rows[1]]]))[0], "it")
    except ValueError as error:
        msg = f"{path} is not a transform: {error}"
        raise ValueError(msg) from error
