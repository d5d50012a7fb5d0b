# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From the raw scans of a recording, whatever its format, to scans with poses.

Each format gives an iterator of :class:`RawScan`; :func:`posed` finds the pose of each, reads its columns, and decides what
they mean. What cannot be used is counted in the notes, and never ends the reading.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.fields import Fields
from radarsdf.io.files import check
from radarsdf.io.poses import MAX_GAP_S, Poses, Trajectory, TransformChain
from radarsdf.io.scans import Columns, Notes, Scan

Truth = Callable[[], NDArray[np.float64] | None]
"""Reads ground truth, (M, 3), world frame, m, when it is asked for; None if there is none."""

FindPoses = Callable[[str], Poses | None]
"""The poses of the scans of a frame; None: none are known."""


@dataclass(frozen=True, eq=False)
class Request:
    """How a user wants scans to be read; see :func:`radarsdf.io.read`."""

    poses: Any = None
    extrinsic: NDArray[np.float64] | None = None
    topic: tuple[str, ...] = ()  # none: the only one that can be meant
    pose_topic: str | None = None
    imu_topic: str | None = None
    R_sensor_imu: NDArray[np.float64] | None = None
    fields: Mapping[str, Any] | None = None
    columns: int | Sequence[str] | None = None
    max_gap_s: float = MAX_GAP_S
    stamps: str | None = None
    world_frame: str | None = None
    truth: Truth | None = None  # None: what lies next to the scans
    notes: Notes = field(default_factory=Notes)


@dataclass(frozen=True, eq=False)
class RawScan:
    """A scan of a file, whose points are not yet read."""

    read: Callable[[], Columns]
    time_s: float | None
    name: str  # for messages
    frame: str = ""  # of a bag
    topic: str = ""  # of a bag
    number: int | None = None  # of its pose, in the order of the scans. None: the number of scans before it


def posed(
    raw_scans: Callable[[], Iterable[RawScan]], find_poses: FindPoses, request: Request
) -> Callable[[], Iterator[Scan]]:
    """The source of :meth:`Scans.of_source`: scans with poses and at least one return, in the order of the files."""
    notes = request.notes

    def source() -> Iterator[Scan]:
        layouts: dict[tuple[str, ...], Fields] = {}
        num_posed, unposed = 0, ""
        for number, raw in enumerate(raw_scans()):
            known = find_poses(raw.frame)
            if known is None:
                notes.count(f"scans left out: no poses lead to their frame, {raw.frame or '(unnamed)'}")
                continue
            if isinstance(known, np.ndarray):
                T_world_sensor = known[number if raw.number is None else raw.number]
                if np.isnan(T_world_sensor[0, 0]):  # it was named when the poses were read
                    continue
            else:
                found = known.pose_at(np.nan if raw.time_s is None else raw.time_s, request.max_gap_s)
                if found is None:
                    notes.count(
                        f"scans left out: no poses within {request.max_gap_s} s of each other around them"
                    )
                    unposed = (
                        unposed or f"the first scan is at {raw.time_s} s, the poses are from {known.span()}"
                    )
                    continue
                T_world_sensor = found
            num_posed += 1
            if scan := _scan(raw, T_world_sensor, layouts, request):
                yield scan
        what = (
            f"no scan has a pose: {unposed}, with gaps of up to {request.max_gap_s} s: are both of one clock?"
        )
        check(num_posed or not unposed, f"{notes.about}: {what}")

    return source


def _scan(
    raw: RawScan,
    T_world_sensor: NDArray[np.float64],
    layouts: dict[tuple[str, ...], Fields],
    request: Request,
) -> Scan | None:
    """The scan with its pose; None, and counted, if it is damaged or has no returns. Adds to what `layouts` mean."""
    notes = request.notes
    try:
        columns = raw.read()
        empty = not columns or not len(next(iter(columns.values())))
        fields = None if empty else _fields(raw.topic, columns, layouts, request)
        scan = fields.scan(columns, T_world_sensor, raw.time_s, notes) if fields else None
    except ValueError as error:
        known = "" if raw.name in str(error) else f"{raw.name}: "
        notes.count("scans left out: they cannot be read", example=f"{known}{error}")
        return None
    if not scan:
        notes.count("scans left out: they hold no returns")
        return None
    return scan


def _fields(topic: str, columns: Columns, layouts: dict[tuple[str, ...], Fields], request: Request) -> Fields:
    """What the columns mean: as in an earlier scan of the topic with the same ones, or else by their names."""
    layout, notes = (topic, *columns), request.notes
    if layout not in layouts:
        fields = Fields.of(list(columns), request.fields).judged(columns, notes)
        if not request.fields and topic not in {known for known, *_ in layouts}:
            fields.note_use(columns, notes)
        for others in layouts.values():
            _note_differences(fields.names, others.names, notes)
        layouts[layout] = fields
    return layouts[layout]


def _note_differences(names: Mapping[str, str], others: Mapping[str, str], notes: Notes) -> None:
    for role in ("intensity", "doppler", "sigma_range"):
        if (role in names) != (role in others):
            notes.add(
                f"some scans have {role}, others have none: it is not used where all scans must have it"
            )
    own, other = names.get("intensity"), others.get("intensity")
    if own and other and own != other:
        notes.add(f"intensities of some scans are {other}, of others {own}: they are taken as of one unit")


def scan_poses(
    poses: Poses,
    count: int,
    times_s: Sequence[float] | None,
    T_base_sensor: NDArray[np.float64] | None,
    request: Request,
) -> tuple[Poses, Sequence[float] | None]:
    """T_world_sensor of each of `count` scans has, and the times of the scans as far as they are then known."""
    about = request.notes.about
    if isinstance(poses, np.ndarray):
        what = "give as many, or poses with time stamps for scans with time stamps"
        check(len(poses) == count, f"{about}: there are {count} scans but {len(poses)} poses: {what}")
    elif times_s is None:
        if not isinstance(poses, Trajectory) or len(poses.times_s) != count:
            msg = f"{about}: the {count} scans have no time stamps, and the poses ({poses.span()}) are not as many"
            raise ValueError(msg)
        request.notes.add(
            f"the scans have no time stamps: they are matched to the {count} poses in their order"
        )
        times_s = poses.times_s.tolist()
        poses = poses.poses(poses.times_s)
    if T_base_sensor is not None:
        poses = (
            poses @ T_base_sensor if isinstance(poses, np.ndarray) else TransformChain((poses, T_base_sensor))
        )
    return poses, times_s
