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
from radarsdf.io.poses.trajectory import MAX_GAP_S, ScanPoses, StampedPoses, Trajectory
from radarsdf.io.scans import Columns, Notes, Scan

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


@dataclass(frozen=True, eq=False)
class _Layout:
    """What the columns of a topic mean, by its first scan."""

    fields: Fields
    columns: list[str]
    scan: str


def posed(raw_scans: RawScans, find_poses: FindPoses, request: Request) -> Callable[[], Iterator[Scan]]:
    """The source of :meth:`Scans.of_source`: scans with poses and at least one return, in the order of the files."""
    notes = request.notes

    def source() -> Iterator[Scan]:
        layouts: dict[str, _Layout] = {}
        num_posed, unposed = 0, ""
        for number, raw in enumerate(raw_scans()):
            known = find_poses(raw.frame)
            if known is None:
                notes.count(f"scans left out: no poses lead to their frame, {raw.frame or '(unnamed)'}")
                continue
            T_world_sensor = known.of(number if raw.number is None else raw.number, raw.time_s)
            if T_world_sensor is not None:
                num_posed += 1
                scan = _scan(raw, T_world_sensor, layouts, raw_scans, request)
                if scan is not None:
                    yield scan
            elif not isinstance(known.poses, np.ndarray):  # else it was named when the poses were read
                notes.count(WITHOUT_POSES.format(gap_s=known.max_gap_s))
                if not unposed:
                    span = known.poses.span()
                    unposed = f"the first scan is at {raw.time_s:.3f} s, the poses are from {span}"
        if unposed and not num_posed:
            gap_s = request.max_gap_s
            msg = f"{notes.about}: no scan has a pose: {unposed}, and a gap between poses may be {gap_s} s: are both of one clock?"
            raise ValueError(msg)

    return source


def _scan(
    raw: RawScan,
    T_world_sensor: NDArray[np.float64],
    layouts: dict[str, _Layout],
    raw_scans: RawScans,
    request: Request,
) -> Scan | None:
    """The scan with its pose; None, and counted, if it is damaged or has no returns."""
    notes = request.notes
    try:
        columns = raw.read()
    except ValueError as error:
        notes.count(_UNREADABLE, example=str(error))
        return None
    scan = None
    if columns and len(next(iter(columns.values()))):
        if raw.topic not in layouts:
            try:
                layouts[raw.topic] = _layout(raw, columns, layouts, raw_scans, request)
            except ValueError as error:
                if request.fields:
                    raise
                notes.count(_UNREADABLE, example=str(error))
                return None
        layout = layouts[raw.topic]
        if not layout.fields.position_names <= set(columns):
            notes.count(_UNREADABLE, example=f"{raw.name} has no positions, but {', '.join(columns)}")
            return None
        if list(columns) != layout.columns:
            _check_same_roles(raw, columns, layout, request)
        scan = layout.fields.scan(columns, raw.name, T_world_sensor, raw.time_s, notes)
    if not scan:
        notes.count(_NO_RETURNS)
        return None
    return scan


def _layout(
    raw: RawScan, columns: Columns, others: Mapping[str, _Layout], raw_scans: RawScans, request: Request
) -> _Layout:
    """What the columns of the first scan of a topic mean, and what to know of that. Raises as :meth:`Fields.of`."""
    notes = request.notes

    def first_clouds() -> Iterator[Columns]:
        of_topic = (other for other in raw_scans() if other.topic == raw.topic)
        for scan in itertools.islice(of_topic, _JUDGED_SCANS):
            with contextlib.suppress(ValueError):
                yield scan.read()

    fields = Fields.of(list(columns), request.fields, raw.name).judged(first_clouds(), notes)
    fields.note_use(columns, notes, chosen=bool(request.fields))
    for other in others.values():
        for role in ("intensity", "doppler", "sigma_range"):
            if (role in fields.names) != (role in other.fields.names):
                notes.add(
                    f"some topics have {role}, others have none: it is not used where all scans must have it"
                )
        own, others_own = fields.names.get("intensity"), other.fields.names.get("intensity")
        if own and others_own and own != others_own:
            notes.add(
                f"intensities of {raw.topic} are {own}, of other topics {others_own}: they are taken as of one unit"
            )
    return _Layout(fields, list(columns), raw.name)


def _check_same_roles(raw: RawScan, columns: Columns, layout: _Layout, request: Request) -> None:
    """Raises a ValueError if a later scan has what the first one of its topic lacks: it would be lost silently."""
    own = Fields.of(list(columns), request.fields, raw.name)
    for role, name in own.names.items():
        if role.startswith(("intensity", "doppler", "sigma")) and role not in layout.fields.names:
            msg = (
                f"{raw.name} has the field {name} for {role}, which {layout.scan} lacks: leave it out of all scans by "
                f"fields={{{role!r}: None}}"
            )
            raise ValueError(msg)


def scan_poses(
    poses: StampedPoses | NDArray[np.float64],
    count: int,
    times_s: Sequence[float] | None,
    T_base_sensor: NDArray[np.float64] | None,
    request: Request,
) -> tuple[ScanPoses, Sequence[float] | None]:
    """Which pose each of `count` scans has, and the times of the scans as far as they are then known."""
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
        times_s = poses.times_s.tolist()
        poses = poses.poses(poses.times_s)
    T = np.eye(4) if T_base_sensor is None else T_base_sensor
    return ScanPoses(poses, T, request.max_gap_s), times_s
