"""Poses by time and in files: tables with named columns, TUM, KITTI, and 4 x 4 matrices; matching to scans."""

import io
import re
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from radarsdf import checks
from radarsdf.arrays import Array, ArrayLike, Bools, Floats
from radarsdf.checks import AnyPath, check, check_pose, check_poses, path_of, real_array
from radarsdf.io.columns import in_seconds, read_numbers, read_table, read_text, scaled, without_unit
from radarsdf.io.files import check_regular_file, checked_suffix, reading, write_whole
from radarsdf.io.npz import array_in
from radarsdf.scans import Columns, Notes

MAX_GAP_S = 0.5  # longest gap to interpolate across, by default

# Files of poses that are looked for next to scans.
POSE_FILES = ("poses.txt", "poses.tum", "poses.csv", "poses.npy", "trajectory.txt", "traj.txt", "gt_odom.txt")
POSE_SUFFIXES = (".tum", ".kitti", ".npy")  # formats of write_poses
FIND_POSES = "radarsdf poses estimates them from the radar alone"  # ends messages on scans without poses

_MAX_NORM_ERROR = 1e-2  # tolerance for unit quaternions: three digits suffice, other columns are refused
_ROUNDING_S = 1e-3
_MAX_NUMBER = 1e9  # limit of numbers of scans; larger integers are times since 1970

_POSITION = "(?:t|p|pos|position|trans|translation|loc|location|pose)"
_QUATERNION = "(?:q|quat|quaternion|orientation|rot|rotation)"
_TUM = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
_MATRIX = [f"m{row}{column}" for row in range(4) for column in range(4)]
# Roles of the columns of a table whose head does not name them, by their number.
_LAYOUTS = {8: _TUM, 12: _MATRIX[:12], 13: ["t", *_MATRIX[:12]], 16: _MATRIX, 17: ["t", *_MATRIX]}
_LENGTHS = ("x", "y", "z", "m03", "m13", "m23")
_TIMES = ("header stamp", "stamp", "timestamp", "time", "t")
# Patterns of whole column names, and the role of a match.
_ROLES = (
    (rf"(?:{_QUATERNION} .* |(?:.* )?{_QUATERNION} ?)([xyzw])", "q{}"),
    (rf"(?:{_POSITION} .* |(?:.* )?{_POSITION} ?|)([xyz])", "{}"),
    (r"(?:.* )?(?:sec|secs|seconds)", "sec"),
    (r"(?:.* )?(?:nsec|nsecs|nanosec|nanosecs|nanoseconds)", "nsec"),
    (r"(?:.*? )?(header stamp|stamp|timestamp|time|t)", "{}"),
)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """P poses T_world_base of a frame `base` that moves, or keeps each pose until the next one."""

    times_s: Floats  # (P,) ascending
    positions: Floats  # (P, 3) world frame, m
    rotations: Rotation  # P rotations R_world_base
    held: bool = False  # each pose holds until the next one

    def span(self) -> str:
        return f"{self.times_s[0]} to {self.times_s[-1]} s"

    @cached_property
    def _slerp(self) -> Slerp:
        return Slerp(self.times_s, self.rotations)

    def poses(self, times_s: Floats) -> Floats:
        """Interpolate poses T_world_base (N, 4, 4) at times (N,), s, within the trajectory: linearly, and by slerp."""
        return checks.interpolated_poses(times_s, self._slerp, self.positions)

    def pose_at(self, time_s: float, max_gap_s: float) -> Floats | None:
        """Interpolate the pose T_world_base (4, 4) at one time, s; None outside the trajectory and in longer gaps.

        A time up to a millisecond beyond an end, or the edge of a gap, gets the pose there: times in files are rounded.
        """
        if self.held:
            last = int(np.searchsorted(self.times_s, time_s, "right")) - 1
            row = np.hstack([self.positions[last], self.rotations[last].as_quat()])
            return None if last < 0 else np.asarray(pose_matrices_of(row[None])[0])
        after = int(np.clip(np.searchsorted(self.times_s, time_s), 1, len(self.times_s) - 1))
        first_s, last_s = self.times_s[after - 1 : after + 1]
        if not first_s <= time_s <= last_s or last_s - first_s > max_gap_s:
            nearest_s = min(first_s, last_s, key=lambda known_s: abs(known_s - time_s))
            if not abs(time_s - nearest_s) <= _ROUNDING_S:
                return None
            time_s = nearest_s
        return np.asarray(self.poses(np.array([time_s]))[0])


@dataclass(frozen=True, eq=False)
class TransformChain:
    """A product T_world_a · T_a_b · … of transforms in a tree of frames, each constant or moving."""

    links: tuple[Any, ...]  # matrices (4, 4), or poses by time

    def pose_at(self, time_s: float, max_gap_s: float) -> Floats | None:
        """T_world_base (4, 4) at a time, s; None if a moving link has no pose near enough."""
        pose = np.eye(4)
        for link in self.links:
            part = link if isinstance(link, np.ndarray) else link.pose_at(time_s, max_gap_s)
            if part is None:
                return None
            pose = pose @ part
        return pose

    def span(self) -> str:
        return ", ".join(link.span() for link in self.links if not isinstance(link, np.ndarray))


class NumberedPoses(NamedTuple):
    """P poses T_world_sensor with the numbers of their scans, which may have gaps."""

    numbers: list[int]
    matrices: Floats  # (P, 4, 4)


StampedPoses: TypeAlias = Trajectory | TransformChain

Poses: TypeAlias = StampedPoses | NumberedPoses | Floats
"""Poses by time, by number of the scan, or (F, 4, 4) in the order of the scans."""

UNPOSED: StampedPoses = TransformChain(())
"""Passed as `poses`, reads scans without poses, such as for :func:`radarsdf.odometry`: each pose is the identity."""


class NoPoses(ValueError):
    """Scans have no poses, and none were passed."""


def are_poses(table: Floats) -> Bools:
    """Mask (P,) of the rows (P, 7) x y z qx qy qz qw that are finite and have a unit quaternion."""
    with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers may overflow
        unit = np.abs(np.linalg.norm(table[:, 3:], axis=1) - 1) <= _MAX_NORM_ERROR
    return np.asarray(unit & np.isfinite(table).all(axis=1))


def pose_matrices_of(table: Floats) -> Floats:
    """Convert rows (P, 7) x y z qx qy qz qw to matrices (P, 4, 4); NaN for rows that are not poses."""
    good = are_poses(table)
    poses = np.full((len(table), 4, 4), np.nan)
    poses[good] = np.eye(4)
    poses[good, :3, 3] = table[good, :3]
    if good.any():
        poses[good, :3, :3] = Rotation.from_quat(table[good, 3:]).as_matrix()
    return poses


def trajectory_of(table: Floats, name: str, notes: Notes | None = None) -> Trajectory:
    """Build a trajectory from rows (P, 8) of time, position and quaternion, in any order; repeated and damaged ones are noted."""
    good = are_poses(table[:, 1:]) & np.isfinite(table[:, 0])
    missing = ~np.isfinite(table).all(axis=1) | ~table[:, 4:].any(axis=1)
    times_s, first = np.unique(table[good, 0], return_index=True)
    rows = np.flatnonzero(good)[first]
    kept = np.zeros_like(good)
    kept[rows] = True
    why = "are left out: not finite, no unit quaternion, or a repeated time"
    count = f"{(~kept).sum()} of {len(table)} poses"
    left_out = "" if kept.all() else f"{count} {why}; the first: pose {np.argmin(kept)}"
    enough = len(times_s) >= 2 and 2 * (~good & ~missing).sum() < (~missing).sum()
    check(enough, f"{name} holds {len(times_s)} poses at different times, of at least two; {left_out}")
    if notes is not None and left_out:
        notes.add(f"{name}: {left_out}")
    return Trajectory(times_s, table[rows, 1:4], Rotation.from_quat(table[rows, 4:]))


def poses_of(poses: Any, notes: Notes) -> Poses:
    """Convert the user's argument to poses: an array (F, 4, 4), poses by time, or a file for :func:`read_poses`."""
    if isinstance(poses, (str, PathLike)):
        return read_poses(Path(poses), notes)
    if isinstance(poses, (Trajectory, TransformChain)):
        return poses
    matrices = real_array(poses, "poses")
    check(matrices.ndim == 3, f"poses must be (F, 4, 4) T_world_sensor, or a file, not {matrices.shape}")
    return rigid_or_nan(matrices, "the given array", notes)


def read_poses(path: Path, notes: Notes) -> Poses:
    """Read poses by time, or (F, 4, 4) in the order of the scans, from a file of one of these kinds.

    - A table whose first line, or a comment above it, names its columns in any order: time, x, y, z, qx, qy, qz and
      qw, as in files of EuRoC, evo and ``rostopic echo -p``. Without times, rows are in the order of the scans.
    - TUM: ``time x y z qx qy qz qw``, s and m.
    - KITTI: lines of twelve numbers, the first three rows of a matrix. If ``calib.txt`` next to it has a ``Tr``,
      T_world_sensor = inv(Tr) P Tr, so that the world is the first scan's sensor frame.
    - 4 x 4 matrices, as lines of sixteen numbers or blocks of four lines, or an array (F, 4, 4) in an ``.npy`` file.
    - Lines of a number of a scan, or a time, and one of these matrices.

    Times may be in ms, µs or ns since 1970, times and positions in the units that their columns are named with.
    """
    check_regular_file(path)
    if path.suffix.lower() == ".npy":
        return rigid_or_nan(np.array(array_in(path)), str(path), notes)
    with reading(path, "a table of poses"):
        columns = _pose_columns(*read_table(path))
    times = columns.get("time")
    if "qw" in columns:
        rows = np.column_stack([columns[role] for role in _TUM[1:]])
        if times is None:
            return rigid_or_nan(pose_matrices_of(rows), str(path), notes)
    else:
        entries = np.column_stack([columns[role] for role in _MATRIX if role in columns])
        P = np.tile(np.eye(4), (len(entries), 1, 1))
        P.reshape(-1, 16)[:, : entries.shape[1]] = entries
        P = rigid_or_nan(P, str(path), notes)
        if entries.shape[1] == 12:
            calibration = path.with_name("calib.txt")
            Tr = read_calibration(calibration) if calibration.is_file() else None
            how = "are taken as T_world_sensor: no" if Tr is None else "are camera poses, by Tr of"
            notes.add(f"{path.name}: KITTI poses {how} calib.txt")
            P = P if Tr is None else np.linalg.inv(Tr) @ P @ Tr
        if times is None:
            return P
        known = np.isfinite(times) & np.isfinite(P).all(axis=(1, 2))
        times, P = times[known], P[known]
        if (times == times.round()).all() and (np.abs(times) < _MAX_NUMBER).all():
            notes.add(f"the first column of {path.name} is taken as the number of the scan")
            return NumberedPoses(times.astype(int).tolist(), P)
        rows = np.column_stack([P[:, :3, 3], Rotation.from_matrix(P[:, :3, :3]).as_quat()])
    finite = np.isfinite(times)
    times[finite] = in_seconds(times[finite], path.name, notes)
    return trajectory_of(np.column_stack([times, rows]), str(path), notes)


def _pose_columns(table_heads: list[list[str]], values: Floats) -> Columns:
    """Columns by role, in s and m: of a quaternion or of a matrix, and ``time`` or the number of the scan, if there is one."""
    check(len(values), "it has no rows of numbers")
    if values.shape[1] == 4 and len(values) % 4 == 0:  # blocks of four lines
        values = values.reshape(-1, 16)
    width = values.shape[1]
    heads = [head for head in reversed(table_heads) if len(head) == width]
    for names in heads:
        roles = [_role_of(name) for name in names]
        if set(_TUM[1:]) <= set(roles):
            break
    else:
        roles = _LAYOUTS.get(width, [])
        kinds = "8 (TUM: time x y z qx qy qz qw), 12 (KITTI), 16, or 4, or names of columns"
        check(roles, f"it has {width} columns: poses have {kinds}")
        names = heads[0] if heads else roles
    found: dict[str, tuple[Floats, str]] = {}
    for role, name, column in zip(roles, names, values.T, strict=True):
        found.setdefault(role, (column, name))
    columns = {role: column for role, (column, _) in found.items()}
    columns |= {role: scaled(*found[role], "length") for role in _LENGTHS if role in found}
    if {"sec", "nsec"} <= set(found):
        columns["time"] = columns["sec"] + 1e-9 * columns["nsec"]
    elif times := [name for name in (*_TIMES, "sec") if name in found]:
        columns["time"] = scaled(*found[times[0]], "time")
    return columns


def _role_of(name: str) -> str:
    words = re.sub(r"[\W_]+", " ", without_unit(name)[0]).strip()
    matches = ((re.fullmatch(pattern, words), role) for pattern, role in _ROLES)
    return next((role.format(*match.groups()) for match, role in matches if match), "")


def rigid_or_nan(poses: Array, name: str, notes: Notes) -> Floats:
    """Check poses (F, 4, 4) in the order of the scans. Damaged ones become NaN and are noted: their scans have none."""
    with reading(name, "poses (F, 4, 4)", TypeError):
        matrices = checks.pose_matrices(poses)
        bad = ~checks.are_rigid(matrices)
        if 2 * bad.sum() > len(bad):  # the numbers are not poses at all
            check_poses(matrices)
    if bad.any():
        what = f"{bad.sum()} of {len(bad)} poses of {name} are not finite and rigid"
        notes.add(f"scans left out: {what}; the first: pose {np.argmax(bad)}")
    return np.where(bad[:, None, None], np.nan, matrices)


def read_transform(path: Path) -> Floats | None:
    """Read a rigid transform (4, 4) from a text file; None if there is no file."""
    if not path.is_file():
        return None
    with reading(path, "a rigid transform"):
        return check_pose(read_numbers(path, 4), "the matrix")


def read_calibration(path: Path) -> Floats | None:
    """Read ``Tr`` or ``Tr_velo_to_cam`` of a KITTI calibration as T_camera_sensor (4, 4); None if it has neither."""
    check_regular_file(path)
    lines = [line.partition(":") for line in read_text(path).splitlines()]
    found = {key.strip(): values.split() for key, _, values in lines}
    numbers = found.get("Tr", found.get("Tr_velo_to_cam"))
    if numbers is None:
        return None
    with reading(path, "a KITTI calibration"):
        return check_pose(np.array([*numbers, 0, 0, 0, 1], np.float64).reshape(4, 4), "Tr")


def check_pose_times(path: AnyPath | None, times_s: ArrayLike | None) -> None:
    """Raise a ValueError if the format of the file, if any, needs times and there are none."""
    possible = times_s is not None or path is None or path_of(path, "path").suffix.lower() != ".tum"
    check(possible, f"{path} needs times, s, and there are none: .kitti and .npy do without")


def write_poses(path: AnyPath, poses: ArrayLike, times_s: ArrayLike | None = None) -> None:
    """Write a trajectory atomically.

    Raises a ValueError for another suffix, if poses are not rigid transforms, or times are missing, not finite or not one per
    pose; an OSError if the file cannot be written.

    Parameters
    ----------
    path : path-like
        The suffix selects the format: ``.tum``, lines of ``time x y z qx qy qz qw``; ``.kitti``, lines of twelve numbers, the
        first three rows of each matrix; ``.npy``, the array (F, 4, 4). evo reads the first two.
    poses : (F, 4, 4) array_like
        T_world_sensor, m.
    times_s : (F,) array_like, optional
        Times, s. ``.tum`` needs them; the other formats do not store them.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from radarsdf.io import write_poses
    >>> write_poses("poses.tum", [np.eye(4)], [12.5])
    >>> print(Path("poses.tum").read_text().strip())
    12.500000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000
    """
    suffix = checked_suffix(path, POSE_SUFFIXES, "poses to write")
    check_pose_times(path, times_s)
    matrices = check_poses(poses)
    text = io.BytesIO()
    if suffix == ".npy":
        np.save(text, matrices)
    elif suffix == ".kitti":
        np.savetxt(text, matrices[:, :3].reshape(-1, 12), "%.12g")
    else:
        times_s = real_array(times_s, "times_s")
        fits = times_s.shape == (len(matrices),) and np.isfinite(times_s).all()
        check(fits, f"times_s must be {len(matrices)} finite numbers, one per pose, not {times_s.shape}")
        quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
        np.savetxt(text, np.column_stack([times_s, matrices[:, :3, 3], quaternions]), "%.9f")
    write_whole(path, text.getvalue())
