# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Sequences of SNAIL-Radar, snail-radar.github.io: its two radars, the poses of its lidar, and the lidar as ground truth.

The points of each sensor are in its own frame, in m. `T_a_b` transforms points of frame b to frame a, and so does the
matrix in a file `a_T_b.txt`. There is no other transformation: the poses are in UTM, and so is the world frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf._core import cell_keys
from radarsdf.io.clouds.reading import read_columns
from radarsdf.io.datasets.folders import lidar_map, read_transform
from radarsdf.io.poses.trajectory import MAX_GAP_S, Trajectory, read_table, trajectory_of
from radarsdf.io.scans import Notes

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
    """The sequence and the radar, of `RADARS`, that a folder means: a sequence, or a part of it."""
    here = folder.resolve()
    for sequence in (here, *here.parents[:2]):
        for radar in RADARS:
            if (sequence / radar).is_dir() and (sequence / radar).is_relative_to(here):
                return sequence, radar
    return None


@dataclass(frozen=True, eq=False)
class SnailRadar:
    """A sequence of SNAIL-Radar and one of its radars.

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

    folder: Path
    radar: str
    """Of `RADARS`."""

    @classmethod
    def of(cls, folder: Path) -> SnailRadar:
        """The sequence and the radar that a folder means; see :func:`is_snail_radar`."""
        parts = _parts(folder)
        if parts is None:
            msg = f"{folder} is no sequence of SNAIL-Radar: it has none of {', '.join(RADARS)}"
            raise ValueError(msg)
        return cls(*parts)

    @property
    def clouds(self) -> Path:
        """The folder of the clouds of the radar."""
        return self.folder / self.radar

    def others(self) -> list[str]:
        """The other radars of the sequence."""
        return [radar for radar in RADARS if radar != self.radar and (self.folder / radar).is_dir()]

    def files(self) -> list[tuple[float, Path]]:
        """Times, s, and files of the clouds of the radar."""
        return _stamped_files(self.clouds)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Of the lidar, in UTM zone 50R. Raises a ValueError or an OSError if it cannot be read."""
        if not (self.folder / _TRAJECTORY).is_file():
            msg = f"{self.folder} lacks {_TRAJECTORY}: copy it from full_trajs/<date>/<sequence> of the data set"
            raise ValueError(msg)
        path = self.folder / _TRAJECTORY
        return trajectory_of(read_table(path, 8), str(path), Notes())

    @cached_property
    def T_base_radar(self) -> NDArray[np.float64]:
        """The radar in the frame of the lidar. Raises a ValueError if it is not known."""
        T_body_xt32 = read_transform(self.folder / "body_T_xt32.txt", _BODY_T_XT32)
        if self.radar.startswith("ars548"):
            file = self.folder / "body_T_ars548.txt"
            T_body_radar = read_transform(file, np.eye(4)) if file.is_file() else self._body_T_ars548(file)
        else:
            T_body_radar = read_transform(self.folder / "body_T_oculii.txt", _BODY_T_OCULII)
        T_xt32_radar: NDArray[np.float64] = np.linalg.inv(T_body_xt32) @ T_body_radar
        return T_xt32_radar

    def _body_T_ars548(self, file: Path) -> NDArray[np.float64]:
        """The published calibration of the day."""
        name = self.folder.parent.name
        found = _DAY.match(name)
        day = float(found[1]) + 0.5 * (found[2] is not None) if found else 0.0
        known = [orientation for first, orientation in _ARS548_ORIENTATIONS if first <= day]
        if not known:
            msg = (
                f"{self.folder}: the calibration of the ARS548 depends on the day, which is the name of the folder above, such "
                f"as 20231105_aft, but that is {name}: give extrinsic, or the radar in the body (4 x 4) in {file.name}"
            )
            raise ValueError(msg)
        T_body_ars548 = np.eye(4)
        T_body_ars548[:3, :3] = Rotation.from_quat(known[-1]).as_matrix()
        T_body_ars548[:3, 3] = _ARS548_POSITION_M
        return T_body_ars548

    def ground_truth(self) -> NDArray[np.float64] | None:
        """Lidar points (M, 3), UTM zone 50R, m, from the first to the last scan; None if there are none.

        Of scans of the lidar, they have a range of 1 to 60 m, and there is at most one in each cell of 5 cm. Each is moved
        with the pose at its own time, or at the time of its scan if the file has no field ``timestamp``.
        """
        points = lidar_map(self.folder)
        if points is None and (self.folder / "xt32").is_dir() and (self.folder / _TRAJECTORY).is_file():
            times_s = np.array([time_s for time_s, _ in self.files()])
            times_s = times_s[self.trajectory.covers(times_s)]
            if len(times_s):
                points = _read_lidar_scans(self.folder / "xt32", self.trajectory, times_s[0], times_s[-1])
        return points


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
        columns = read_columns(path)
        xyz = _xyz_of(columns, path)
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


def _xyz_of(columns: dict[str, NDArray[Any]], path: Path) -> NDArray[np.float64]:
    if missing := [name for name in "xyz" if name not in columns]:
        msg = f"{path} lacks the fields {', '.join(missing)}: it has {', '.join(columns)}"
        raise ValueError(msg)
    return np.stack([columns[name].astype(np.float64) for name in "xyz"], axis=1)


def _thin(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The first point (K, 3) in each cell of points (N, 3)."""
    _, first = np.unique(cell_keys(points, _LIDAR_CELL_M), return_index=True)
    kept: NDArray[np.float64] = points[np.sort(first)]
    return kept
