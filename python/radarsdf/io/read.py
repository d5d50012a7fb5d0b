"""Read scans from files, folders and bags of any supported kind."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from radarsdf.arrays import ArrayLike
from radarsdf.checks import AnyPath, check, check_pose, path_of, positions, positive
from radarsdf.io import poses as pose_files
from radarsdf.io import recordings
from radarsdf.io.bag_messages import BAG_SUFFIXES, is_bag
from radarsdf.io.bags import read_bags
from radarsdf.io.clouds import READERS, read_points
from radarsdf.io.columns import columns_of
from radarsdf.io.datasets import find_dataset
from radarsdf.io.npz import read_scans
from radarsdf.rig import checked_rotation
from radarsdf.scans import Notes, Scans


def read(
    path: AnyPath | Sequence[AnyPath],
    poses: AnyPath | ArrayLike | pose_files.StampedPoses | None = None,
    *,
    extrinsic: ArrayLike | None = None,
    topic: str | Sequence[str] | None = None,
    pose_topic: str | None = None,
    imu_topic: str | None = None,
    R_sensor_imu: ArrayLike | None = None,
    world_frame: str | None = None,
    stamps: str | None = None,
    fields: Mapping[str, Any] | None = None,
    columns: int | Sequence[str] | None = None,
    max_gap_s: float = pose_files.MAX_GAP_S,
    ground_truth: AnyPath | ArrayLike | None = None,
) -> Scans:
    """Read scans with poses from a file, a folder or bags.

    Assumptions and omissions are logged by ``radarsdf.io``, and kept in the ``notes`` of the scans. Returns with a non-finite
    coordinate or intensity, unreadable files, and scans with non-finite poses are skipped and counted.

    Parameters
    ----------
    path : path-like, or a sequence of them
        One of

        - our ``.npz`` (see :func:`read_scans`);
        - the file of a scan, or a folder of them: PCD, PLY, ``.bin`` of KITTI, ``.npy``, CSV or other text, LAS or LAZ, in natural
          order or in that of the times in their names, with ``lidar.pcd`` or ``lidar.ply`` as ground truth;
        - a folder of a published data set, recognised by its layout;
        - a ROS 1 bag, a ROS 2 bag (a folder, ``.mcap`` or ``.db3``), a folder of bags, or a sequence of bags of one drive.
    poses : path-like, array_like or poses by time, optional
        (F, 4, 4) T_world_sensor, m, or T_world_body of several radars with mountings, or a file: TUM, KITTI, 4 x 4
        matrices, or a table that names its columns. By default those of the data set, of the ``.npz``, of a file such as ``poses.txt`` in the folder, or of `pose_topic`.
        `radarsdf.io.UNPOSED` reads scans without poses; an ``.npz`` keeps its own.
    extrinsic : (4, 4) array_like, optional
        T_base_sensor, m, if the poses are T_world_base.
    topic : str or sequence of str, optional
        In a bag, the topics of the scans, merged by time. By default the radar's, if there is one. Several topics, or
        frames of one topic, are the labels of several radars. Static transforms give their mountings.
    pose_topic : str, optional
        In a bag, the topic of the poses (Odometry, PoseStamped, Path or TF). By default the only one whose child frame is
        rigidly attached to that of the scans, else TF, else the only one.
    imu_topic : str, optional
        In a bag, the topic of the IMU, for `Scans.imu`. By default the only one.
    R_sensor_imu : (3, 3) array_like, optional
        Rotation from the axes of the IMU to those of the radar. By default that of the file, or of a bag's static transforms.
    world_frame : str, optional
        World frame of poses from TF. By default the root of its tree.
    stamps : {"header", "record"}, optional
        In a bag, the clock of the scans. By default the header stamps, unless they are zero or constant.
    fields : mapping, optional
        Field of the file by role, where names are unknown or misleading: ``{"intensity": "Power"}``. None leaves a role out.
        Roles are x, y, z, range, azimuth, elevation, intensity, doppler, sigma_range, sigma_azimuth and sigma_elevation.
    columns : int or sequence of str, optional
        Of files without column names: how many a point has, or their names. By default ``.bin`` is float32 x, y, z, intensity.
    max_gap_s : float
        Longest gap between two poses to interpolate across, s. Scans in longer gaps are skipped and counted.
    ground_truth : path-like or (M, 3) array_like, optional
        Lidar points, world frame, m, in place of those that come with the scans.

    Returns
    -------
    Scans
        Scans, read lazily while iterated, with memory bounded by one scan. Points keep the precision of the file;
        intensities, Doppler and standard deviations are float32.

    Raises
    ------
    NoPoses
        If the scans have no poses. It is a ValueError.
    ValueError
        If files are damaged or do not fit together, something is missing, or a choice is ambiguous.
    OSError
        If a file cannot be read.
    ImportError
        If a library is not installed; the message names it.

    Examples
    --------
    >>> import numpy as np, radarsdf
    >>> np.save("0.npy", [[5.0, 0.0, 0.0, 70.0], [6.0, 1.0, np.nan, 80.0]])
    >>> scans = radarsdf.io.read("0.npy", [np.eye(4)])
    >>> [(scan.points.tolist(), scan.intensities.tolist()) for scan in scans]
    [([[5.0, 0.0, 0.0]], [70.0])]
    >>> scans.notes
    ['1 returns left out: a coordinate or the intensity is not a finite number']
    """
    check(stamps in (None, "header", "record"), f'stamps must be "header" or "record", not {stamps!r:.50}')
    single = isinstance(path, (str, PathLike))
    paths = [path_of(part, "path") for part in ([path] if single or not isinstance(path, Iterable) else path)]
    files = [value for value in (poses, ground_truth) if isinstance(value, (str, PathLike))]
    for file in (*paths, *map(Path, files)):
        # Many readers would not name it.
        check(file.exists(), f"{file} does not exist", FileNotFoundError)
    request = recordings.Request(
        poses=poses,
        extrinsic=None if extrinsic is None else check_pose(extrinsic, "extrinsic T_base_sensor"),
        topic=(topic,) if isinstance(topic, str) else tuple(topic or ()),
        pose_topic=pose_topic,
        imu_topic=imu_topic,
        R_sensor_imu=None if R_sensor_imu is None else checked_rotation(R_sensor_imu),
        world_frame=world_frame,
        stamps=stamps,
        fields=fields,
        columns=columns,
        max_gap_s=positive(max_gap_s, "max_gap_s"),
        notes=Notes(str(path) if single else "the bags"),
    )
    if poses is pose_files.UNPOSED:
        request.refuse("scans are read without poses", *recordings.OF_POSES)
    scans = _read(paths[0], request) if single else read_bags(paths, request)
    if R_sensor_imu is not None and scans.imu is None:
        request.refuse(f"{request.notes.about} has no IMU, or several", "R_sensor_imu")
    if ground_truth is None:
        return scans
    if isinstance(ground_truth, (str, PathLike)):
        return scans.with_ground_truth(partial(read_points, ground_truth))
    points = positions(ground_truth, "ground_truth")
    return scans.with_ground_truth(lambda: points)


def _read(path: Path, request: recordings.Request) -> Scans:
    if is_bag(path):
        return read_bags([path], request)
    dataset = find_dataset(path)
    inner = sorted(path.iterdir()) if path.is_dir() and dataset is None else []
    bags = [entry for entry in inner if is_bag(entry) and not entry.name.startswith(".")]
    if bags:  # NTU4DRadLM and Viking Hill have files next to them
        if request.extrinsic is None:
            T_base_sensor = pose_files.read_transform(path / recordings.BASE_T_RADAR)
            request = replace(request, extrinsic=T_base_sensor)
        file = recordings.first_file([path], pose_files.POSE_FILES)
        if file is not None and request.poses is None and request.pose_topic is None:
            request.notes.add(f"poses: of {file.name}")
            request = replace(request, poses=file)
        return read_bags(bags, request)
    request.refuse(f"{path} is not a bag", *recordings.OF_BAGS)
    if dataset is not None:
        return dataset.read(path, request)
    if path.is_dir():
        files = recordings.cloud_files(path, request.notes)
        return recordings.read_files(files, path, request, partial(recordings.lidar_map, path))
    suffix = path.suffix.lower()
    kinds = ", ".join((".npz", *BAG_SUFFIXES, *READERS))
    known = suffix == ".npz" or suffix in READERS
    check(known, f"{path} is of no kind that can be read: {kinds}, or a folder of them")
    return _npz(path, request) if suffix == ".npz" else recordings.read_files([path], path.parent, request)


def _npz(path: Path, request: recordings.Request) -> Scans:
    notes = request.notes
    request.refuse(f"{path} has names of columns", "columns")
    scans = read_scans(path)
    if own := request.poses is None or request.poses is pose_files.UNPOSED:
        request.refuse(f"{path} contains its own poses", "extrinsic")
        poses: pose_files.Poses = pose_files.rigid_or_nan(scans.poses, str(path), notes)
    else:
        poses = pose_files.poses_of(request.poses, notes)
        notes.add(f"the given poses are used in place of those in {path.name}, without its ground truth")
    times_s = None if scans.times_s is None else scans.times_s.tolist()
    matched, _ = recordings.scan_poses(poses, len(scans), times_s, request.extrinsic, request)
    mountings = scans.T_body_sensor
    raw_scans = []
    for i, s in enumerate(scans):
        read, name = partial(columns_of, s, s.points), f"{path}: scan {i}"
        raw_scans.append(recordings.RawScan(read, s.time_s, name, str(s.sensor or ""), sensor=s.sensor))
    truth, imu = scans.ground_truth if own else None, scans.imu
    if imu is not None and request.R_sensor_imu is not None:
        imu = replace(imu, R_sensor_imu=request.R_sensor_imu)
    of_radars = {label: recordings.poses_on(matched, T) for label, T in (mountings or {}).items()}
    find: recordings.FindPoses = lambda label: of_radars.get(label, matched)
    source = partial(recordings.posed, lambda: raw_scans, find, request)
    return Scans.of_source(source, notes, lambda: truth, lambda: imu, lambda: mountings)
