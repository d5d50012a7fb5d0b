"""Published data sets, recognised by the layout of their folders."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checks import check, check_pose
from radarsdf.io import poses as pose_files
from radarsdf.io.columns import read_numbers, read_text
from radarsdf.io.files import reading
from radarsdf.io.recordings import Request, first_file, lidar_map, natural, read_files
from radarsdf.scans import Scans


class Dataset(NamedTuple):
    name: str
    fits: Callable[[Path], bool]  # whether a folder has its layout
    read: Callable[[Path, Request], Scans]  # with its poses and mounting, unless the request has others


def find_dataset(folder: Path) -> Dataset | None:
    return next((dataset for dataset in _DATASETS if dataset.fits(folder)), None)


def _msc_rad4r(folder: Path, request: Request) -> Scans:
    """Read PCD files, and ``timestamp_radar.txt`` with lines of a number, seconds and nanoseconds. It has no poses."""
    return read_files(sorted((folder / "3_RADAR/PCD").glob("*.pcd"), key=natural), folder, request)


def _coloradar(folder: Path, request: Request) -> Scans:
    """Read the single-chip radar: rows of x, y, z, intensity and Doppler; poses of the platform in ``groundtruth``."""
    if request.poses is None:
        truth = folder / "groundtruth"
        with reading(truth, "a folder with a time for each pose"):
            stamps = read_numbers(truth / "timestamps.txt", 1)
            table = read_numbers(truth / "groundtruth_poses.txt", 7)
            poses = pose_files.trajectory_of(np.column_stack([stamps, table]), str(truth), request.notes)
        request = replace(request, poses=poses)
    if request.extrinsic is None:
        places = [place / "calib/transforms" for place in (folder, *folder.resolve().parents[:2])]
        file = first_file(places, ["base_to_single_chip.txt"])
        if file is None:
            request.notes.add("no base_to_single_chip.txt: the poses are taken as those of the radar")
        else:
            with reading(file, "two lines x y z and qx qy qz qw"):
                numbers = np.array(read_text(file).split(), np.float64).reshape(1, 7)
                T_base_sensor = check_pose(pose_files.pose_matrices_of(numbers)[0], "it")
                request = replace(request, extrinsic=T_base_sensor)
    files = (folder / "single_chip/pointclouds/data").glob("radar_pointcloud_*.bin")
    return read_files(sorted(files, key=natural), folder, replace(request, columns=request.columns or 5))


def _delft_folders(folder: Path) -> tuple[Path, Path]:
    radar = folder.resolve() / ("training" if (folder / "training/velodyne").is_dir() else "radar/training")
    return radar, radar.parents[1] / "lidar/training"


def _view_of_delft(folder: Path, request: Request) -> Scans:
    """Read View-of-Delft, complete or only its radar folder: a calibration and a pose for each frame."""
    radar, lidar = _delft_folders(folder)
    files = sorted((radar / "velodyne").glob("*.bin"), key=natural)
    request = replace(request, columns=request.columns or 7)
    if request.poses is not None:
        return read_files(files, folder, request)
    posed = [path for path in files if (lidar / "pose" / f"{path.stem}.json").is_file()]
    if len(posed) < len(files):
        request.notes.add(f"{len(files) - len(posed)} scans left out: they have no file of a pose")
    poses = np.array([_delft_pose(path.stem, radar, lidar, request.extrinsic) for path in posed])
    return read_files(posed, folder, replace(request, poses=poses, extrinsic=np.eye(4)))


def _delft_pose(frame: str, radar: Path, lidar: Path, extrinsic: Floats | None) -> Floats:
    """T_map_radar (4, 4) of a frame. ``mapToCamera`` is T_map_camera, despite its name."""
    path = lidar / "pose" / f"{frame}.json"
    with reading(path, "a pose mapToCamera of View-of-Delft", TypeError, IndexError, RecursionError):
        records = [json.loads(line) for line in read_text(path).splitlines() if line.strip()]
        T_map_camera = [record["mapToCamera"] for record in records if "mapToCamera" in record][-1]
        T_map_camera = check_pose(np.array(T_map_camera, np.float64).reshape(4, 4), "mapToCamera")
    calibration = radar / "calib" / f"{frame}.txt"
    T_camera_radar = pose_files.read_calibration(calibration) if extrinsic is None else extrinsic
    if T_camera_radar is None:
        msg = f"{calibration} lacks Tr_velo_to_cam"
        raise ValueError(msg)
    return np.asarray(T_map_camera @ T_camera_radar)


_SNAIL_RADARS = ("eagleg7/enhanced", "eagleg7/pcl")  # the first that exists is read

# The published calibration. The axes of the body point forward, left and up; its origin is that of the lidar. Source:
# matlab/Body_T_Xt32.m and Body_T_Oculii.m ("refined") of github.com/snail-radar/dataset_tools, 2f82c2c.
_BODY_T_XT32 = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_BODY_T_OCULII = np.array([[0.999756831, 0.020010494, -0.009265982, 0.07],
                           [-0.019750133, 0.999429818, 0.027385610, 0.0],
                           [0.009808698, -0.027195946, 0.999581997, -0.115],
                           [0.0, 0.0, 0.0, 1.0]])  # fmt: skip


def _snail_radar(folder: Path, request: Request) -> Scans:
    """Read the Oculii Eagle (forward, left, up) of snail-radar.github.io: poses of the lidar in UTM zone 50R, the world frame."""
    points = next(folder / radar for radar in _SNAIL_RADARS if (folder / radar).is_dir())
    if request.poses is None:
        path = folder / "utm50r_T_xt32.txt"
        check(path.is_file(), f"{folder} lacks {path.name}: copy it from full_trajs/<date>/<sequence>")
        request = replace(request, poses=path)
    if request.extrinsic is None:
        request = replace(request, extrinsic=np.linalg.inv(_BODY_T_XT32) @ _BODY_T_OCULII)
    files = sorted(points.glob("*.pcd"), key=natural)
    return read_files(files, folder, request, partial(lidar_map, folder))


_DATASETS = (
    Dataset("SNAIL-Radar", lambda f: any((f / radar).is_dir() for radar in _SNAIL_RADARS), _snail_radar),
    Dataset("View-of-Delft", lambda f: (_delft_folders(f)[1] / "pose").is_dir(), _view_of_delft),
    Dataset("ColoRadar", lambda f: (f / "single_chip/pointclouds/data").exists(), _coloradar),
    Dataset("MSC-RAD4R", lambda f: (f / "3_RADAR/timestamp_radar.txt").exists(), _msc_rad4r),
)
