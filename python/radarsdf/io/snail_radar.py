# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Sequences of SNAIL-Radar, snail-radar.github.io: its two radars, the poses of its lidar, and the lidar as ground truth.

`T_a_b` transforms points of frame b to frame a, and so does the matrix in a file `a_T_b.txt`. The poses are in UTM, and so
is the world frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf._core import cell_keys
from radarsdf.io.clouds.fields import Fields
from radarsdf.io.clouds.reading import read_columns
from radarsdf.io.folders import lidar_map, scans_of_files
from radarsdf.io.poses.files import poses_of, read_transform
from radarsdf.io.poses.trajectory import MAX_GAP_S, Trajectory, trajectory_of
from radarsdf.io.recordings import Request
from radarsdf.io.scans import Notes, Scans
from radarsdf.io.text import read_numbers

RADARS = ("eagleg7/enhanced", "eagleg7/pcl", "ars548/points")
"""Folders of clouds in a sequence: of the Oculii Eagle, and of the Continental ARS548. The first that is there counts."""

_TRAJECTORY = "utm50r_T_xt32.txt"

# The published calibration of the SNAIL-Radar rig, for sequences without calibration files. The axes of the body point
# forward, left and up; its origin is that of the lidar. Source: matlab/Body_T_Xt32.m, Body_T_Oculii.m ("refined") and
# Body_T_Ars548.m, multiplied out, of github.com/snail-radar/dataset_tools, commit 2f82c2c. Its
# python/view_radar_lidar.py has the same, for the first of the dates below.
_BODY_T_XT32 = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_BODY_T_OCULII = np.array(
    [
        [0.999756831, 0.020010494, -0.009265982, 0.07],
        [-0.019750133, 0.999429818, 0.027385610, 0.0],
        [0.009808698, -0.027195946, 0.999581997, -0.115],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_ARS548_POSITION_M = (0.0, 0.0, 0.07)
# Its orientation, qx qy qz qw, was set anew several times: from this day on. Afternoons and evenings are half a day later.
_ARS548_ORIENTATIONS = (
    (20231104.0, (0.004112068, -0.127365674, -0.006945404, 0.991822987)),
    (20231105.5, (-0.001244648, 0.001010494, -0.018245103, 0.999832259)),
    (20231109.0, (-0.008126773, 0.001224424, -0.024923832, 0.999655570)),
    (20231201.0, (-0.002238636, -0.013322733, -0.022325986, 0.999659464)),
    (20231208.0, (-0.002173148, -0.012493422, -0.022981144, 0.999655470)),
    (20231213.0, (-0.003973179, -0.011377850, -0.020249871, 0.999722312)),
    (20240113.0, (-0.001835193, -0.014938248, -0.025422503, 0.999563493)),
)
_DAY = re.compile(r"(\d{8})(_aft|_eve)?$")

_LIDAR_RANGE_M = (1.0, 60.0)  # nearer points are on the platform or its operator; the radar sees no farther
_LIDAR_CELL_M = 0.05  # a lidar point a cell: else most would lie on the ground where the platform stood
_LIDAR_BATCH = 50  # scans from one thinning to the next; bounds the memory
_MAX_SWEEP_S = 1.0  # larger differences between the times of a point and of its scan mean different clocks


def is_snail_radar(folder: Path) -> bool:
    """Whether the folder is a sequence of SNAIL-Radar, or the folder of one of its radars."""
    return _parts(folder) is not None


def _parts(folder: Path) -> tuple[Path, str] | None:
    """The sequence and the radar, of `RADARS`, that a folder means: a sequence, or a folder in it. None: it is neither."""
    here = folder.resolve()
    for sequence in (here, *here.parents[:2]):
        for radar in RADARS:
            if (sequence / radar).is_dir() and (sequence / radar).is_relative_to(here):
                return sequence, radar
    return None


def read(folder: Path, request: Request) -> Scans:
    """A sequence, or one radar of it: ``data3`` means its Oculii Eagle, ``data3/ars548/points`` its Continental ARS548.

    ::

        eagleg7/enhanced/1706001766.577286344.pcd   Oculii frame (forward, left, up); intensity: Power
        ars548/points/1706001762.429354169.pcd      ARS548 frame (forward, left, up); intensity: RCS + 128
        utm50r_T_xt32.txt                           time x y z qx qy qz qw: the full trajectory of the lidar
        xt32/1706001766.715735580.pcd               optional: lidar scan, lidar frame (left, back, up)
        body_T_oculii.txt, body_T_ars548.txt,       optional: 4 x 4, instead of the published calibration
        body_T_xt32.txt
        lidar.pcd or lidar.ply                      optional: ground truth instead of xt32, UTM zone 50R, m

    Copy ``utm50r_T_xt32.txt`` from the data set's folder ``full_trajs/<date>/<sequence>``. The calibration of the ARS548
    is that of the date, the name of the folder above. Of the Oculii, only x, y and z are used: its angles are in another
    frame (right, down, forward). ``tf_static.launch`` is not read.
    """
    found = _parts(folder)
    assert found is not None
    sequence, radar = found
    others = [other for other in RADARS if other != radar and (sequence / other).is_dir()]
    if others and folder.resolve() == sequence:
        request.notes.add(f"{radar} is read; {' and '.join(others)} are read as folders of their own")
    files = _stamped_files(sequence / radar)
    times_s = [time_s for time_s, _ in files]
    if not files:
        msg = f"{sequence / radar} holds no scans"
        raise ValueError(msg)
    poses = _trajectory(sequence) if request.poses is None else poses_of(request.poses, request.notes)
    extrinsic = _T_xt32_radar(sequence, radar) if request.extrinsic is None else request.extrinsic
    truth = partial(_ground_truth, sequence, np.array(times_s))
    return scans_of_files([path for _, path in files], times_s, poses, extrinsic, request, truth)


def _trajectory(sequence: Path) -> Trajectory:
    """Of the lidar, in UTM zone 50R."""
    path = sequence / _TRAJECTORY
    if not path.is_file():
        msg = f"{sequence} lacks {_TRAJECTORY}: copy it from full_trajs/<date>/<sequence> of the data set"
        raise ValueError(msg)
    return trajectory_of(read_numbers(path, 8), str(path), Notes())


def _T_xt32_radar(sequence: Path, radar: str) -> NDArray[np.float64]:
    """The radar in the frame of the lidar, (4, 4). Raises a ValueError if it is not known."""
    T_body_xt32 = read_transform(sequence / "body_T_xt32.txt", _BODY_T_XT32)
    if radar.startswith("ars548"):
        file = sequence / "body_T_ars548.txt"
        T_body_radar = read_transform(file, np.eye(4)) if file.is_file() else _body_T_ars548(sequence, file)
    else:
        T_body_radar = read_transform(sequence / "body_T_oculii.txt", _BODY_T_OCULII)
    T_xt32_radar: NDArray[np.float64] = np.linalg.inv(T_body_xt32) @ T_body_radar
    return T_xt32_radar


def _body_T_ars548(sequence: Path, file: Path) -> NDArray[np.float64]:
    """The published calibration of the day."""
    name = sequence.parent.name
    found = _DAY.match(name)
    day = float(found[1]) + 0.5 * (found[2] is not None) if found else 0.0
    known = [orientation for first, orientation in _ARS548_ORIENTATIONS if first <= day]
    if not known:
        msg = (
            f"{sequence}: the calibration of the ARS548 depends on the day, which is the name of the folder above, such "
            f"as 20231105_aft, but that is {name}: give extrinsic, or the radar in the body (4 x 4) in {file.name}"
        )
        raise ValueError(msg)
    T_body_ars548 = np.eye(4)
    T_body_ars548[:3, :3] = Rotation.from_quat(known[-1]).as_matrix()
    T_body_ars548[:3, 3] = _ARS548_POSITION_M
    return T_body_ars548


def _ground_truth(sequence: Path, times_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Lidar points (M, 3), UTM zone 50R, m, of all lidar scans while the radar's were taken, at most one in each cell."""
    points = lidar_map(sequence)
    if points is not None or not (sequence / "xt32").is_dir() or not (sequence / _TRAJECTORY).is_file():
        return points
    trajectory = _trajectory(sequence)
    times_s = times_s[trajectory.covers(times_s)]
    if not len(times_s):
        return None
    origin = trajectory.positions[0]  # cell keys are relative to it: UTM coordinates are out of their range
    found = [np.zeros((0, 3))]
    for count, world in enumerate(_lidar_scans(sequence / "xt32", trajectory, times_s[0], times_s[-1]), 1):
        found.append(_thin(world - origin))
        if count % _LIDAR_BATCH == 0:
            found = [_thin(np.concatenate(found))]
    points = _thin(np.concatenate(found)) + origin
    return points if len(points) else None


def _lidar_scans(
    folder: Path, trajectory: Trajectory, first_s: float, last_s: float
) -> Iterator[NDArray[np.float64]]:
    """(K, 3) world, m, of 1 to 60 m range, each point moved with the pose at its own time if it has a ``timestamp``."""
    for time_s, path in _stamped_files(folder):
        if not first_s <= time_s <= last_s:
            continue
        columns = read_columns(path)
        fields = Fields.of(list(columns), dict.fromkeys(("intensity", "doppler")), str(path))
        xyz = fields.points(columns).astype(np.float64)
        times_s = columns.get("timestamp", np.full(len(xyz), time_s)).astype(np.float64)
        ranges_m = np.linalg.norm(xyz, axis=1)
        used = (ranges_m >= _LIDAR_RANGE_M[0]) & (ranges_m <= _LIDAR_RANGE_M[1]) & np.isfinite(times_s)
        if (np.abs(times_s[used] - time_s) > _MAX_SWEEP_S).any():
            msg = f"{path}: the times of its points differ by more than {_MAX_SWEEP_S} s from the time in its name"
            raise ValueError(msg)
        used &= trajectory.covers(times_s)
        yield trajectory.move(xyz[used], times_s[used], MAX_GAP_S)


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


def _thin(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The first point (K, 3) in each cell of points (N, 3)."""
    _, first = np.unique(cell_keys(points, _LIDAR_CELL_M), return_index=True)
    kept: NDArray[np.float64] = points[np.sort(first)]
    return kept
