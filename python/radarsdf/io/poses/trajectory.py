# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses by time: trajectories, interpolation between their poses, and the pose of each scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from radarsdf.io.scans import Notes

MAX_GAP_S = 0.5
"""Longest time between two poses over which poses are interpolated, by default."""

_MAX_NORM_ERROR = 1e-2  # of a quaternion. Three digits are enough; columns of another meaning are refused
_ROUNDED_S = 1e-3
_SMALL = 1e-4  # rad: interpolation is linear
_LISTED = 5  # poses that a note names


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

    def covers(self, times_s: NDArray[np.float64], max_gap_s: float = np.inf) -> NDArray[np.bool_]:
        """Mask (N,) of the times (N,), s, that lie between two poses at most `max_gap_s` apart."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        inside: NDArray[np.bool_] = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        return inside & (self.times_s[after] - self.times_s[after - 1] <= max_gap_s)

    def poses(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses T_world_base (N, 4, 4) at the times (N,), s, between the first and the last pose.

        The position is interpolated linearly and the rotation spherically (slerp).
        """
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        poses[:, :3, :3] = Slerp(self.times_s, self.rotations)(times_s).as_matrix()
        for axis in range(3):
            poses[:, axis, 3] = np.interp(times_s, self.times_s, self.positions[:, axis])
        return poses

    def pose_at(self, time_s: float, max_gap_s: float) -> NDArray[np.float64] | None:
        """Pose T_world_base (4, 4) at one time, s, as `poses`; None outside of them, and in longer gaps.

        A millisecond before the first pose or after the last one, or next to one in a longer gap, is at that pose: times
        in files are rounded.
        """
        after = int(np.clip(np.searchsorted(self.times_s, time_s), 1, len(self.times_s) - 1))
        both = slice(after - 1, after + 1)
        first_s, last_s = self.times_s[both]
        share = (time_s - first_s) / (last_s - first_s)
        if not 0 <= share <= 1 or last_s - first_s > max_gap_s:
            share = float(share > 0.5)
            if not abs(time_s - (last_s if share else first_s)) <= _ROUNDED_S:
                return None
        pose = np.eye(4)
        first, last = self.rotations[both].as_quat()
        pose[:3, :3] = Rotation.from_quat(_slerp(first, last, share)).as_matrix()
        pose[:3, 3] = (1 - share) * self.positions[after - 1] + share * self.positions[after]
        return pose


def _slerp(first: NDArray[np.float64], last: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """The quaternion (4,) between two unit ones, the shorter arc. SciPy's takes several times as long for one."""
    cosine = float(first @ last)
    angle = math.acos(min(abs(cosine), 1.0))
    if angle < _SMALL:
        return first + share * (math.copysign(1, cosine) * last - first)
    return math.sin((1 - share) * angle) * first + math.copysign(math.sin(share * angle), cosine) * last


def are_poses(table: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mask (P,) of the rows (P, 7) x y z qx qy qz qw that are finite and have a unit quaternion."""
    with np.errstate(over="ignore", invalid="ignore"):  # of damaged numbers
        unit = np.abs(np.linalg.norm(table[:, 3:], axis=1) - 1) <= _MAX_NORM_ERROR
    mask: NDArray[np.bool_] = unit & np.isfinite(table).all(axis=1)
    return mask


def pose_matrices_of(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 4, 4) of rows (P, 7) x y z qx qy qz qw; NaN where a row is no pose."""
    good = are_poses(table)
    poses = np.full((len(table), 4, 4), np.nan)
    poses[good] = np.eye(4)
    poses[good, :3, 3] = table[good, :3]
    if good.any():
        poses[good, :3, :3] = Rotation.from_quat(table[good, 3:]).as_matrix()
    return poses


def trajectory_of(
    table: NDArray[np.float64], name: str, notes: Notes | None = None, lines: Sequence[int] | None = None
) -> Trajectory:
    """The trajectory in rows (P, 8) of time, position and quaternion, in any order, from these lines of a file.

    Of several poses at one time, the first counts. `notes` take what was left out.
    """
    bad = ~(are_poses(table[:, 1:]) & np.isfinite(table[:, 0]))
    missing = ~np.isfinite(table).all(axis=1) | ~table[:, 4:].any(axis=1)
    rows = np.flatnonzero(~bad)
    times_s, first = np.unique(table[rows, 0], return_index=True)
    back, again = np.zeros_like(bad), ~bad
    back[rows[1:]] = np.diff(table[rows, 0]) < 0
    again[rows[first]] = False
    remarks = [
        f"{name}: {mask.sum()} of {len(table)} poses {what}: {listed(mask, lines)}"
        for mask, what in (
            (bad, "left out, which are not finite or not unit quaternions"),
            (back, "are not in the order of their times, and sorted"),
            (again, "left out, whose times repeat"),
        )
        if mask.any()
    ]
    if len(times_s) < 2 or 2 * (bad & ~missing).sum() >= (~missing).sum():
        msg = f"{name} holds {len(times_s)} poses at different times; at least two poses are needed"
        raise ValueError("; ".join([msg, *remarks]))
    if notes is not None:
        for remark in remarks:
            notes.add(remark)
    table = table[rows[first]]
    return Trajectory(times_s, table[:, 1:4], Rotation.from_quat(table[:, 4:]), name)


def listed(mask: NDArray[np.bool_], lines: Sequence[int] | None) -> str:
    """The first poses of a mask (P,), by the lines of their file or else by number."""
    rows = np.flatnonzero(mask)
    named = [str(row if lines is None else lines[row]) for row in rows[:_LISTED]]
    return f"{'pose' if lines is None else 'line'} {', '.join(named)}{', …' if len(rows) > _LISTED else ''}"


class StampedPoses(Protocol):
    """Poses by time."""

    def pose_at(self, time_s: float, max_gap_s: float) -> NDArray[np.float64] | None:
        """T_world_base (4, 4) at a time, s; None if there is none near enough."""

    def span(self) -> str:
        """First and last time, for messages."""


class NoPoses(ValueError):
    """Scans have no poses, and none are given."""


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


UNPOSED: StampedPoses = TransformChain(())
"""In place of poses, reads scans that have none, such as for :func:`radarsdf.odometry`: each pose is the identity."""


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
        else:
            T_world_base = None if time_s is None else self.poses.pose_at(time_s, self.max_gap_s)
        if T_world_base is None or np.isnan(T_world_base[0, 0]):
            return None
        T_world_sensor: NDArray[np.float64] = T_world_base @ self.T_base_sensor
        return T_world_sensor
