# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Trajectories: poses with times, interpolation between them, and their files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from radarsdf.io.scans import Notes
from radarsdf.io.text import number_rows

MAX_GAP_S = 0.5
"""Longest time between two poses over which poses are interpolated, by default."""

_UNITS = ((1e17, "ns", 1e-9), (1e14, "µs", 1e-6), (1e11, "ms", 1e-3))  # from so much on, since 1970
TIME_UNITS = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
"""Units of times in names of columns, s."""

MAX_NORM_ERROR = 1e-2  # of a quaternion. Three digits are enough; columns of another meaning are refused
_ROUNDED_S = 1e-3
_NEARLY_SAME = 1 - 1e-9  # cosine of half an angle so small that its sine and itself are equal to rounding


@dataclass(frozen=True, eq=False)
class Trajectory:
    """P poses T_world_base of a moving frame `base`."""

    times_s: NDArray[np.float64]
    """(P,) ascending, s."""
    positions: NDArray[np.float64]
    """(P, 3) world frame, m."""
    rotations: Rotation
    """P rotations R_world_base."""
    name: str = "the trajectory"
    """Its file, for error messages."""

    def span(self) -> str:
        """First and last time, for error messages."""
        return f"{self.times_s[0]} to {self.times_s[-1]} s"

    def covers(self, times_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mask (N,) of the times (N,), s, that lie between the first and the last pose."""
        inside: NDArray[np.bool_] = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        return inside

    def poses(self, times_s: NDArray[np.float64], max_gap_s: float) -> NDArray[np.float64]:
        """Poses T_world_base (N, 4, 4) at the times (N,), s.

        Between two poses, the position is interpolated linearly and the rotation spherically (slerp).

        Raises
        ------
        ValueError
            If a time is not covered, or the poses before and after it are more than `max_gap_s` apart.
        """
        rotations, positions = self._at(times_s, max_gap_s)
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        poses[:, :3, :3] = rotations.as_matrix()
        poses[:, :3, 3] = positions
        return poses

    def pose_at(self, time_s: float, max_gap_s: float) -> NDArray[np.float64] | None:
        """Pose T_world_base (4, 4) at one time, s. None where `poses` would raise. Fast for one time of many poses.

        A millisecond before the first pose or after the last one, or beside one in a longer gap, is at that pose: times in
        files are rounded.
        """
        nearest_s = min(max(time_s, self.times_s[0]), self.times_s[-1])
        time_s = nearest_s if abs(nearest_s - time_s) <= _ROUNDED_S else time_s
        if not self.times_s[0] <= time_s <= self.times_s[-1]:
            return None
        after = int(np.searchsorted(self.times_s, time_s))
        before = after if self.times_s[after] == time_s else after - 1
        gap_s = self.times_s[after] - self.times_s[before]
        if gap_s > max_gap_s:
            nearest = before if time_s - self.times_s[before] < self.times_s[after] - time_s else after
            if abs(self.times_s[nearest] - time_s) > _ROUNDED_S:
                return None
            before = after = nearest
        share = 0.0 if before == after else (time_s - self.times_s[before]) / gap_s
        pose = np.eye(4)
        pose[:3, :3] = _matrix(_slerp(self._quaternions[before], self._quaternions[after], share))
        pose[:3, 3] = (1 - share) * self.positions[before] + share * self.positions[after]
        return pose

    @cached_property
    def _quaternions(self) -> NDArray[np.float64]:
        """(P, 4) qx, qy, qz, qw of `rotations`."""
        quaternions: NDArray[np.float64] = self.rotations.as_quat()
        return quaternions

    def move(
        self, points: NDArray[np.float64], times_s: NDArray[np.float64], max_gap_s: float
    ) -> NDArray[np.float64]:
        """Points (N, 3) in the world frame, m, of points (N, 3) in the moving frame, each with its own time (N,), s.

        Raises
        ------
        ValueError
            As `poses`.
        """
        if len(points) == 0:
            return points
        rotations, positions = self._at(times_s, max_gap_s)
        moved: NDArray[np.float64] = rotations.apply(points) + positions
        return moved

    def _at(self, times_s: NDArray[np.float64], max_gap_s: float) -> tuple[Rotation, NDArray[np.float64]]:
        if not self.covers(times_s).all():
            first = times_s[~self.covers(times_s)][0]
            msg = f"{self.name} has no pose at {first} s: its poses are from {self.span()}"
            raise ValueError(msg)
        after = np.searchsorted(self.times_s, times_s)  # the first pose that is not earlier
        before = np.where(self.times_s[after] == times_s, after, after - 1)
        gaps_s = self.times_s[after] - self.times_s[before]
        if (gaps_s > max_gap_s).any():
            worst = int(np.argmax(gaps_s))
            msg = (
                f"{self.name} has no pose near {times_s[worst]} s: the poses before and after it are "
                f"{gaps_s[worst]:.3f} s apart, more than {max_gap_s} s"
            )
            raise ValueError(msg)
        positions = [np.interp(times_s, self.times_s, self.positions[:, axis]) for axis in range(3)]
        return Slerp(self.times_s, self.rotations)(times_s), np.stack(positions, axis=1)


def _slerp(first: NDArray[np.float64], last: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """The unit quaternion (4,) between two, on the shorter way. SciPy's takes ten times as long for one."""
    cosine = float(first @ last)
    if cosine < 0:
        last, cosine = -last, -cosine
    if cosine > _NEARLY_SAME:
        mixed = (1 - share) * first + share * last
    else:
        angle = math.acos(cosine)
        mixed = (math.sin((1 - share) * angle) * first + math.sin(share * angle) * last) / math.sin(angle)
    unit: NDArray[np.float64] = mixed / math.sqrt(mixed @ mixed)
    return unit


def _matrix(quaternion: NDArray[np.float64]) -> list[list[float]]:
    """The rotation matrix (3, 3) of a unit quaternion."""
    x, y, z, w = quaternion.tolist()
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def in_seconds(times: NDArray[np.float64], path: Path, notes: Notes) -> NDArray[np.float64]:
    """Times (N,) of a file, s. They may be in ms, µs or ns since 1970, which is noted.

    Raises
    ------
    ValueError
        If a time is not finite, or times are of different units.
    """
    if not np.isfinite(times).all():
        msg = f"{path} holds a time that is not finite"
        raise ValueError(msg)
    units = {
        next((unit for unit in _UNITS if abs(time) >= unit[0]), None) for time in times[times != 0].tolist()
    }
    if len(units) > 1:
        msg = f"{path} holds times of different units, such as s and ns"
        raise ValueError(msg)
    (unit,) = units or {None}
    if unit is None:
        return times
    notes.add(f"times of {path.name} are taken as {unit[1]} since 1970")
    return times * unit[2]


def read_trajectory(path: Path) -> Trajectory:
    """Reads a trajectory in the TUM format: lines of ``time x y z qx qy qz qw``, s and m, and comments after ``#``.

    Raises
    ------
    ValueError
        If the file has another format or fewer than two poses, or if times do not ascend or quaternions do not have
        unit length.
    OSError
        If the file cannot be read.
    """
    return trajectory_of_table(read_table(path, 8), path)


def trajectory_of_table(table: NDArray[np.float64], path: Path) -> Trajectory:
    """The trajectory in the rows (P, 8) of a TUM file; see :func:`read_trajectory`."""
    if len(table) < 2 or not (np.diff(table[:, 0]) > 0).all():
        msg = f"{path} must hold at least two poses, in the order of their times"
        raise ValueError(msg)
    if (np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1) > MAX_NORM_ERROR).any():
        msg = f"{path}: the last four columns are not unit quaternions qx qy qz qw"
        raise ValueError(msg)
    return Trajectory(table[:, 0], table[:, 1:4], Rotation.from_quat(table[:, 4:]), str(path))


def read_table(path: Path, columns: int | None = None) -> NDArray[np.float64]:
    """Reads a text file of finite numbers, (R, columns) float64, with comments after ``#``; None: of any poses.

    Raises
    ------
    ValueError
        If the file holds anything else.
    OSError
        If the file cannot be read.
    """
    wanted = "poses" if columns is None else f"{columns} columns of numbers"
    try:
        table = np.array(number_rows(path), np.float64)
    except ValueError as error:
        msg = f"{path} is not a table of {wanted}: {error}"
        raise ValueError(msg) from error
    if table.ndim != 2 or columns not in (None, table.shape[1]) or not np.isfinite(table).all():
        msg = f"{path} is not a table of {wanted}, all finite and in rows of one length"
        raise ValueError(msg)
    return table
