# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From clouds of files, one after another, to scans with poses."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.clouds.fields import Fields, names_of, plain_name
from radarsdf.io.clouds.pcd import read_viewpoint
from radarsdf.io.clouds.raw_binary import KITTI, bin_layout
from radarsdf.io.clouds.reading import CLOUD_SUFFIXES, TEXT_SUFFIXES, Columns, read_columns
from radarsdf.io.poses.reading import POSE_FILES, ScanPoses, StampedPoses
from radarsdf.io.poses.trajectory import MAX_GAP_S, Trajectory
from radarsdf.io.scans import Notes, Scan, Scans
from radarsdf.io.text import number_rows
from radarsdf.io.units import SCALES, in_seconds, unit_since_1970, without_unit

TIME_FILES = ("times.txt", "timestamps.txt", "timestamp.txt")
"""Names of files with a time, s, for each scan, one a line."""

SCAN_FOLDERS = ("radar", "scans", "points", "pointclouds", "clouds", "pcd", "PCD", "velodyne", "data")
"""Names of folders of scans that are found within the folder that is read."""

NOT_FINITE = "returns left out: a coordinate or the intensity is not a finite number"
"""What a note says of such returns, after their number."""

WITHOUT_POSES = "scans left out: no poses within {gap_s} s of each other around them"
"""What it says of such scans."""

_JUDGED_SCANS = 30  # by whose numbers the unit of angles is known
_SCAN_FIELDS = ("frame", "scan", "scan_id", "frame_id", "scan_index", "frame_index", "scan_number", "frame_number",
                "sweep", "sweep_id", "cycle", "cycle_id")  # fmt: skip
_TIME_FIELDS = ("time", "timestamp", "stamp", "t")
_UNREADABLE = "scans left out: they cannot be read"
_NO_RETURNS = "scans left out: they hold no returns"
_NOT_SCANS = {
    *POSE_FILES,
    *TIME_FILES,
    "calib.txt",
    "calibration.txt",
    "base_t_radar.txt",
    "readme.txt",
    "license.txt",
}
_TRUTH_STEM = "lidar"  # lidar.pcd or lidar.ply beside the scans is their ground truth
_SECONDS_AND_NANOSECONDS = re.compile(r"(\d{9,10})[_-](\d{9})$")
_TIME = re.compile(r"(\d+\.\d+|\d{10,})$")

Truth = Callable[[], NDArray[np.float64] | None]
"""Reads ground truth, (M, 3), world frame, m, when it is asked for; None if there is none."""


@dataclass(frozen=True, eq=False)
class Request:
    """How a user wants scans to be read; see :func:`radarsdf.io.read`."""

    poses: Any = None
    extrinsic: NDArray[np.float64] | None = None
    topic: tuple[str, ...] = ()
    """Topics; none: the only one that can be meant."""
    pose_topic: str | None = None
    imu_topic: str | None = None
    R_sensor_imu: NDArray[np.float64] | None = None
    fields: Mapping[str, Any] | None = None
    columns: int | Sequence[str] | None = None
    max_gap_s: float = MAX_GAP_S
    stamps: str | None = None
    world_frame: str | None = None
    truth: Truth | None = None
    """None: what lies beside the scans."""
    notes: Notes = field(default_factory=Notes)


@dataclass(frozen=True, eq=False)
class RawScan:
    """A scan of a file, whose points are not yet read."""

    read: Callable[[], Columns]
    time_s: float | None
    name: str
    """For errors."""
    frame: str = ""
    """Its frame, of a bag."""
    topic: str = ""
    """Its topic, of a bag: scans of one topic have the same fields."""
    number: int | None = None
    """Of its pose, where poses are in the order of the scans. None: the number of those before it."""


def posed(
    raw_scans: Callable[[], Iterable[RawScan]],
    poses: ScanPoses | Callable[[str], ScanPoses | None],
    request: Request,
) -> Callable[[], Iterator[Scan]]:
    """What :meth:`Scans.of_source` takes: scans with poses and at least one return, in the order of the files.

    `poses` are those of all scans, or give those of a frame, or None for one of which nothing is known.
    """
    notes = request.notes

    def source() -> Iterator[Scan]:
        fields_of: dict[str, tuple[Fields, RawScan, list[str]]] = {}
        taken, missed = 0, None
        for before, raw in enumerate(raw_scans()):
            own = poses(raw.frame) if callable(poses) else poses
            if own is None:
                notes.count(f"scans left out: no poses lead to their frame, {raw.frame or '(unnamed)'}", 1)
                continue
            T_world_sensor = own.of(before if raw.number is None else raw.number, raw.time_s)
            if T_world_sensor is None:
                if not isinstance(own.poses, np.ndarray):  # else it was named when the poses were read
                    notes.count(WITHOUT_POSES.format(gap_s=own.max_gap_s), 1)
                    missed = (
                        missed
                        or f"the first scan is at {raw.time_s:.3f} s, the poses are from {own.poses.span()}"
                    )
                continue
            taken += 1
            columns = _read(raw, notes)
            if columns is None:
                continue
            if raw.topic not in fields_of:
                fields = _fields_of(columns, raw, raw_scans, request)
                if fields is None:
                    continue
                for other, _, _ in fields_of.values():
                    _note_differences(fields, raw.topic, other, notes)
                fields_of[raw.topic] = fields, raw, list(columns)
            fields, first, names = fields_of[raw.topic]
            if not fields.place(columns):
                notes.count(_UNREADABLE, 1, f"{raw.name} has no positions, but {', '.join(columns)}")
                continue
            cloud = fields.read(columns, raw.name)
            if list(columns) != names:
                fields.check_no_more(Fields.of(list(columns), request.fields, raw.name), raw.name, first.name)
            notes.count(NOT_FINITE, cloud.dropped)
            if len(cloud.points) == 0:
                notes.count(_NO_RETURNS, 1)
                continue
            yield cloud.scan(T_world_sensor, raw.time_s)
        if missed and not taken:
            msg = f"{notes.about}: no scan has a pose: {missed}, and a gap between poses may be {request.max_gap_s} s: are both of one clock?"
            raise ValueError(msg)

    return source


def _read(raw: RawScan, notes: Notes) -> Columns | None:
    """The columns of a scan; None, and counted, if it is damaged or empty."""
    try:
        columns = raw.read()
    except ValueError as error:
        notes.count(_UNREADABLE, 1, str(error))
        return None
    if not columns or len(next(iter(columns.values()))) == 0:
        notes.count(_NO_RETURNS, 1)
        return None
    return columns


def _fields_of(
    columns: Columns, raw: RawScan, raw_scans: Callable[[], Iterable[RawScan]], request: Request
) -> Fields | None:
    """What the columns of the first scan mean; None, and counted, if it has no positions, unless a user chose them."""
    try:
        fields = Fields.of(list(columns), request.fields, raw.name)
    except ValueError as error:
        if request.fields:
            raise
        request.notes.count(_UNREADABLE, 1, str(error))
        return None
    fields = fields.judged(_first_clouds(raw_scans, raw.topic), request.notes)
    fields.note_use(columns, request.notes, chosen=bool(request.fields))
    return fields


def _first_clouds(raw_scans: Callable[[], Iterable[RawScan]], topic: str) -> Iterator[Columns]:
    """The first scans of a topic, or of files, that can be read, to judge their numbers by."""
    for raw in itertools.islice((raw for raw in raw_scans() if raw.topic == topic), _JUDGED_SCANS):
        with contextlib.suppress(ValueError):
            yield raw.read()


def _note_differences(fields: Fields, topic: str, other: Fields, notes: Notes) -> None:
    """Scans of several sensors: what some of them lack, and intensities that may have other units."""
    for role in ("intensity", "doppler", "sigma_range"):
        if (role in fields.names) != (role in other.names):
            notes.add(
                f"some topics have {role}, others have none: it is not used where all scans must have it"
            )
    own, others = fields.names.get("intensity"), other.names.get("intensity")
    if own and others and own != others:
        notes.add(
            f"intensities of {topic} are {own}, of other topics {others}: they are taken as of one unit"
        )


def cloud_files(folder: Path) -> list[Path]:
    """The scans of a folder, or of a folder of `SCAN_FOLDERS` in it, in natural order: of the kind with most files."""
    for inner in (folder, *(folder / name for name in SCAN_FOLDERS)):
        if not inner.is_dir():
            continue
        kinds: dict[str, list[Path]] = {}
        for path in inner.iterdir():
            suffix = path.suffix.lower()
            if suffix not in CLOUD_SUFFIXES or path.name.startswith(".") or not path.is_file():
                continue
            if path.name.lower() in _NOT_SCANS or path.name in POSE_FILES or path.stem == _TRUTH_STEM:
                continue
            kinds.setdefault("text" if suffix in TEXT_SUFFIXES else suffix, []).append(path)
        if kinds:
            most = max(kinds.values(), key=len)
            return sorted(most, key=natural)
    return []


def natural(path: Path) -> tuple[Any, ...]:
    """To sort names as people do: scan_9 before scan_10."""
    parts = re.split(r"(\d+)", path.name)
    return tuple((int(part), part) if i % 2 else (0, part) for i, part in enumerate(parts))


def in_order_of_time(
    files: list[Path], poses: StampedPoses | NDArray[np.float64], notes: Notes
) -> tuple[list[Path], list[float] | None, StampedPoses | NDArray[np.float64]]:
    """Scans in the order of their times, these times, s, None if there are none, and the poses.

    Poses without times belong to the files by number: in the order of the times in their names, or, where a file has the
    times line by line, in the order of these lines.
    """
    times, listed = times_of(files, notes)
    if times is None:
        return files, None, poses
    order = np.argsort(times, kind="stable")
    if (np.diff(order) < 0).any():
        if listed is not None:
            notes.add(f"{listed.name} is not ascending: scans are read in the order of their times")
            if isinstance(poses, np.ndarray) and len(poses) == len(files):
                poses = poses[order]
        elif isinstance(poses, np.ndarray):
            notes.add(
                "the times in the names of the scans are in another order than the names: poses are in that of times"
            )
    return [files[i] for i in order], [times[i] for i in order], poses


def times_of(files: list[Path], notes: Notes) -> tuple[list[float] | None, Path | None]:
    """Times of scans, s, by their names, or by a file of times beside them, and this file; None if there are none.

    A name that ends in a number with a point is a time in s; in 12, 15 or 18 digits or more, in ms, µs or ns. Shorter
    ones are numbers of scans.
    """
    named = [_time_of(path.stem) for path in files]
    times = [time for time in named if time is not None]
    if len(times) == len(files) and len(set(times)) == len(files):
        return times, None
    if len(times) == len(files) > 1:
        notes.add("several scans have the same time in their names: these times are not used")
    for folder in (files[0].parent, files[0].parent.parent):
        for name in TIME_FILES:
            if (path := folder / name).is_file():
                return _listed_times(path, len(files), notes), path
    return None, None


def _time_of(stem: str) -> float | None:
    if parts := _SECONDS_AND_NANOSECONDS.search(stem):
        return int(parts[1]) + 1e-9 * int(parts[2])
    found = _TIME.search(stem)
    if found is None:
        return None
    if "." in found[1]:
        return float(found[1])
    return int(found[1]) * unit_since_1970(int(found[1]))[1]


def _listed_times(path: Path, count: int, notes: Notes) -> list[float]:
    try:
        times = np.array([float(row[-1]) for row in number_rows(path)])
    except ValueError as error:
        msg = f"{path} does not hold a time in seconds in each line: {error}"
        raise ValueError(msg) from error
    if len(times) != count:
        msg = f"{path} has {len(times)} times for {count} scans"
        raise ValueError(msg)
    seconds: list[float] = in_seconds(times, path.name, notes).tolist()
    if len(set(seconds)) < count:
        notes.add(f"{path.name} has the same time for several scans")
    return seconds


def scan_poses(
    poses: StampedPoses | NDArray[np.float64],
    count: int,
    times_s: Sequence[float] | None,
    T_base_sensor: NDArray[np.float64] | None,
    request: Request,
) -> tuple[ScanPoses, Sequence[float] | None]:
    """Which pose each of `count` scans has, and the times of the scans as far as they are then known."""
    T = np.eye(4) if T_base_sensor is None else T_base_sensor
    if isinstance(poses, np.ndarray):
        if len(poses) != count:
            msg = (
                f"{request.notes.about}: there are {count} scans but {len(poses)} poses: give as many poses as scans, or poses with time "
                "stamps (TUM: time x y z qx qy qz qw) for scans with time stamps"
            )
            raise ValueError(msg)
        return ScanPoses(poses, T, request.max_gap_s), times_s
    if times_s is not None:
        return ScanPoses(poses, T, request.max_gap_s), times_s
    if isinstance(poses, Trajectory) and len(poses.times_s) == count:
        request.notes.add(
            f"the scans have no time stamps: they are matched to the {count} poses in their order"
        )
        matrices = poses.poses(poses.times_s, np.inf)
        return ScanPoses(matrices, T, request.max_gap_s), [float(time_s) for time_s in poses.times_s]
    msg = (
        f"{request.notes.about}: the {count} scans have no time stamps in their names or in {' or '.join(TIME_FILES)}, and the poses "
        f"({poses.span()}) are not as many"
    )
    raise ValueError(msg)


def scans_of_files(
    files: list[Path],
    times_s: Sequence[float] | None,
    poses: StampedPoses | NDArray[np.float64],
    T_base_sensor: NDArray[np.float64] | None,
    request: Request,
    truth: Truth = lambda: None,
) -> Scans:
    """Scans of one file each, with poses; `truth` is that of the folder, if the request has none."""
    tables: list[Columns] | None = None
    columns: Any = request.columns
    if any(path.suffix.lower() == ".bin" for path in files):
        columns = bin_columns(files, columns, request.notes)
    if len(files) == 1:
        tables, times_s, poses = _split(files[0], columns, times_s, poses, request.notes)
    count = len(files) if tables is None else len(tables)
    matched, known_s = scan_poses(poses, count, times_s, T_base_sensor, request)

    def raw_scans() -> Iterator[RawScan]:
        for i in range(count):
            path = files[i] if tables is None else files[0]
            yield RawScan(
                lambda i=i, path=path: read_columns(path, columns) if tables is None else tables[i],  # type: ignore[misc]
                None if known_s is None else known_s[i],
                str(path) if tables is None else f"{path}: scan {i}",
            )

    return Scans.of_source(posed(raw_scans, matched, request), request.notes, request.truth or truth)


def _split(
    path: Path,
    columns: Any,
    times_s: Sequence[float] | None,
    poses: StampedPoses | NDArray[np.float64],
    notes: Notes,
) -> tuple[list[Columns] | None, Sequence[float] | None, StampedPoses | NDArray[np.float64]]:
    """The scans in the one table of a recording, by a column with their numbers or times; None if it is one scan."""
    try:
        table = read_columns(path, columns)
    except ValueError:  # which is said when the scan is read
        return None, times_s, poses
    plain = {plain_name(name)[0]: name for name in reversed(table)}
    number = next((plain[name] for name in _SCAN_FIELDS if name in plain), None)
    time = next((plain[name] for name in _TIME_FIELDS if name in plain), None)
    one_pose = isinstance(poses, np.ndarray) and len(poses) == 1
    key = number if number is not None or one_pose else time
    if key is None or table[key].dtype.kind not in "biuf":
        return None, times_s, poses
    rows = np.flatnonzero(np.isfinite(table[key]))
    values, first, part = np.unique(table[key][rows], return_index=True, return_inverse=True)
    if len(values) < 2 or (key != number and 2 * len(values) > len(rows)):
        return None, times_s, poses
    notes.add(f"{path.name} is read as {len(values)} scans, by its field {key}")
    if len(rows) < len(table[key]):
        notes.add(f"{path.name}: {len(table[key]) - len(rows)} rows left out: their {key} is not a number")
    order = np.split(rows[np.argsort(part, kind="stable")], np.cumsum(np.bincount(part))[:-1])
    if time is not None and table[time].dtype.kind in "iuf":
        scale = SCALES.get(without_unit(time)[1], 1.0)
        times_s = in_seconds(table[time][rows][first].astype(np.float64) * scale, path.name, notes).tolist()
    if (
        isinstance(poses, np.ndarray)
        and len(poses) > len(values)
        and 0 <= values[0] <= values[-1] < len(poses)
    ):
        poses = poses[values.astype(np.int64)]  # numbers of scans, of which some are empty
    return [{name: table[name][r] for name in table if name != key} for r in order], times_s, poses


def bin_columns(files: list[Path], columns: Any, notes: Notes) -> Any:
    """What :func:`read_columns` needs to know of files ``.bin``, by the content of several of them."""
    if columns is not None and not isinstance(columns, int):
        return columns
    try:
        layout = bin_layout([path for path in files if path.suffix.lower() == ".bin"], columns)
    except ValueError as error:
        msg = f"{notes.about}: {error}"
        raise ValueError(msg) from error
    if layout != KITTI:
        names = ", ".join(names_of(layout.width, None))
        notes.add(
            f"the .bin files have {layout.width} numbers a return, {np.dtype(layout.dtype).name}, taken as {names}"
        )
    return layout


def viewpoint_poses(files: list[Path], notes: Notes) -> NDArray[np.float64] | None:
    """T_world_sensor (F, 4, 4) of the ``VIEWPOINT`` of PCD files, if it is where each scan was taken."""
    if {path.suffix.lower() for path in files} != {".pcd"}:
        return None
    poses = np.full((len(files), 4, 4), np.nan)
    for pose, path in zip(poses, files, strict=True):
        with contextlib.suppress(ValueError):
            pose[:] = read_viewpoint(path)
    known = poses[np.isfinite(poses).all(axis=(1, 2))]
    if not len(known) or (known == (np.eye(4) if len(files) == 1 else known[0])).all():
        return None
    notes.add("poses: VIEWPOINT of the PCD files")
    return poses


def note_viewpoint(path: Path, notes: Notes) -> None:
    """Notes that the ``VIEWPOINT`` of a scan is not applied where poses are given: it would place the scan twice."""
    with contextlib.suppress(ValueError):
        if path.suffix.lower() == ".pcd" and (read_viewpoint(path) != np.eye(4)).any():
            notes.add("VIEWPOINT of the PCD files is not applied: the given poses place the scans")
