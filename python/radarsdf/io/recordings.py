# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From the raw scans of a recording, whatever its format, to scans with poses.

Each format gives an iterator of :class:`RawScan`: where a scan is, how its columns are read, and when it was taken.
:func:`posed` finds the pose of each, reads its columns, and decides by the first scan of a topic what they mean. What
cannot be used is counted in the notes, and never ends the reading.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.clouds.fields import Fields
from radarsdf.io.ply import Columns
from radarsdf.io.poses.trajectory import MAX_GAP_S, ScanPoses, StampedPoses, Trajectory
from radarsdf.io.scans import Notes, Scan

WITHOUT_POSES = "scans left out: no poses within {gap_s} s of each other around them"
_UNREADABLE = "scans left out: they cannot be read"
_NO_RETURNS = "scans left out: they hold no returns"
_JUDGED_SCANS = 30  # by whose numbers the unit of angles is known

Truth = Callable[[], NDArray[np.float64] | None]
"""Reads ground truth, (M, 3), world frame, m, when it is asked for; None if there is none."""

FindPoses = Callable[[str], ScanPoses | None]
"""The poses of the scans of a frame; None: none are known."""


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
    """None: what lies next to the scans."""
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
    """Of its pose, where poses are in the order of the scans. None: the number of scans before it."""


RawScans = Callable[[], Iterable[RawScan]]
"""Returns a new iterator over the scans of a recording."""


def posed(raw_scans: RawScans, find_poses: FindPoses, request: Request) -> Callable[[], Iterator[Scan]]:
    """The source of :meth:`Scans.of_source`: scans with poses and at least one return, in the order of the files."""

    def source() -> Iterator[Scan]:
        reader = _Reader(raw_scans, find_poses, request)
        for number, raw in enumerate(raw_scans()):
            T_world_sensor = reader.pose(number, raw)
            if T_world_sensor is None:
                continue
            scan = reader.scan(raw, T_world_sensor)
            if scan is not None:
                yield scan
        reader.check_poses()

    return source


class _Reader:
    """One pass through the scans of a recording."""

    def __init__(self, raw_scans: RawScans, find_poses: FindPoses, request: Request) -> None:
        self._raw_scans, self._find_poses, self._request = raw_scans, find_poses, request
        self._notes = request.notes
        self._first: dict[str, tuple[Fields, RawScan, list[str]]] = {}
        """Of each topic, what the fields of its first scan mean, that scan, and the names of its columns."""
        self._posed = 0
        self._unposed = ""
        """What is known of the first scan without a pose."""

    def pose(self, number: int, raw: RawScan) -> NDArray[np.float64] | None:
        """T_world_sensor (4, 4); None, and counted, if it is not known."""
        own = self._find_poses(raw.frame)
        if own is None:
            self._notes.count(f"scans left out: no poses lead to their frame, {raw.frame or '(unnamed)'}", 1)
            return None
        T_world_sensor = own.of(number if raw.number is None else raw.number, raw.time_s)
        if T_world_sensor is not None:
            self._posed += 1
        elif not isinstance(own.poses, np.ndarray):  # else it was named when the poses were read
            self._notes.count(WITHOUT_POSES.format(gap_s=own.max_gap_s), 1)
            span = own.poses.span()
            self._unposed = (
                self._unposed or f"the first scan is at {raw.time_s:.3f} s, the poses are from {span}"
            )
        return T_world_sensor

    def check_poses(self) -> None:
        """Raises a ValueError if there were scans and poses, but of different times."""
        if self._unposed and not self._posed:
            gap_s = self._request.max_gap_s
            msg = f"{self._notes.about}: no scan has a pose: {self._unposed}, and a gap between poses may be {gap_s} s: are both of one clock?"
            raise ValueError(msg)

    def scan(self, raw: RawScan, T_world_sensor: NDArray[np.float64]) -> Scan | None:
        """The scan with its pose; None, and counted, if it is damaged or has no returns."""
        try:
            columns = raw.read()
        except ValueError as error:
            self._notes.count(_UNREADABLE, 1, str(error))
            return None
        if not columns or len(next(iter(columns.values()))) == 0:
            self._notes.count(_NO_RETURNS, 1)
            return None
        fields = self._fields(raw, columns)
        if fields is None:
            return None
        scan = fields.scan(columns, raw.name, T_world_sensor, raw.time_s, self._notes)
        if len(scan) == 0:
            self._notes.count(_NO_RETURNS, 1)
            return None
        return scan

    def _fields(self, raw: RawScan, columns: Columns) -> Fields | None:
        """What the columns mean: as those of the first scan of the topic. None, and counted, without positions."""
        if raw.topic not in self._first:
            fields = self._first_fields(raw, columns)
            if fields is None:
                return None
            self._first[raw.topic] = fields, raw, list(columns)
        fields, first, names = self._first[raw.topic]
        if not fields.position_names <= set(columns):
            self._notes.count(_UNREADABLE, 1, f"{raw.name} has no positions, but {', '.join(columns)}")
            return None
        if list(columns) != names:
            own = Fields.of(list(columns), self._request.fields, raw.name)
            if (role := fields.missing_role(own)) is not None:
                msg = (
                    f"{raw.name} has the field {own.names[role]} for {role}, which {first.name} lacks: leave it out of all scans "
                    f"by fields={{{role!r}: None}}"
                )
                raise ValueError(msg)
        return fields

    def _first_fields(self, raw: RawScan, columns: Columns) -> Fields | None:
        """What the columns of the first scan of a topic mean, which raises an error only if a user has chosen some."""
        chosen = self._request.fields
        try:
            fields = Fields.of(list(columns), chosen, raw.name)
        except ValueError as error:
            if chosen:
                raise
            self._notes.count(_UNREADABLE, 1, str(error))
            return None
        fields = fields.judged(self._first_clouds(raw.topic), self._notes)
        fields.note_use(columns, self._notes, chosen=bool(chosen))
        for other, _, _ in self._first.values():
            _note_differences(fields, raw.topic, other, self._notes)
        return fields

    def _first_clouds(self, topic: str) -> Iterator[Columns]:
        """The first scans of a topic that can be read, to judge their numbers by."""
        of_topic = (raw for raw in self._raw_scans() if raw.topic == topic)
        for raw in itertools.islice(of_topic, _JUDGED_SCANS):
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


def scan_poses(
    poses: StampedPoses | NDArray[np.float64],
    count: int,
    times_s: Sequence[float] | None,
    T_base_sensor: NDArray[np.float64] | None,
    request: Request,
) -> tuple[ScanPoses, Sequence[float] | None]:
    """Which pose each of `count` scans has, and the times of the scans as far as they are then known."""
    T = np.eye(4) if T_base_sensor is None else T_base_sensor
    about = request.notes.about
    if isinstance(poses, np.ndarray):
        if len(poses) != count:
            msg = (
                f"{about}: there are {count} scans but {len(poses)} poses: give as many poses as scans, or poses with time "
                "stamps (TUM: time x y z qx qy qz qw) for scans with time stamps"
            )
            raise ValueError(msg)
    elif times_s is None:
        if not isinstance(poses, Trajectory) or len(poses.times_s) != count:
            msg = (
                f"{about}: the {count} scans have no time stamps in their names or in a file of times, and the poses "
                f"({poses.span()}) are not as many"
            )
            raise ValueError(msg)
        request.notes.add(
            f"the scans have no time stamps: they are matched to the {count} poses in their order"
        )
        times_s = [float(time_s) for time_s in poses.times_s]
        poses = poses.poses(poses.times_s, np.inf)
    return ScanPoses(poses, T, request.max_gap_s), times_s
