# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a live map keeps in files: scans and regions that memory has no room for, and its whole state."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from radarsdf._core import GrowingSums
from radarsdf.checks import MAX_POSITION_M, check_poses, check_values_of_scan, positions
from radarsdf.io.files import take_lock
from radarsdf.io.npz import arrays_of, check_arrays, write_arrays
from radarsdf.live.regions import NO_KEYS, REGION_BITS, Keys
from radarsdf.returns.evidence import BLOCK_BITS

ScanId = Hashable
FIELDS = ("points", "intensities", "doppler_mps", "standing")  # of a `LoggedScan`, besides its pose and time

_LOCK = "live.lock"  # also the mark of a folder that a map has used
_BYTES_OF_SCAN = 1000  # of the objects that hold a scan, about
_CELL_COLUMNS: dict[str, tuple[Any, ...]] = {
    "keys": (np.uint64, None),
    "sums": (np.int64, None, 14),
    "scans_of_cells": (np.uint32, None),
    "look_keys": (np.uint64, None),
    "looks": (np.uint32, None),
}  # in the order in which the core takes them


def locked_folder(folder: Path) -> int:
    """Makes a folder that one map uses, and locks it until the descriptor is closed. Files of an earlier map are overwritten."""
    folder.mkdir(exist_ok=True)
    ours = (_LOCK, "*scan-*.npz*", "*region-*.npz*") if (folder / _LOCK).is_file() else ()
    if not all(any(path.match(name) for name in ours) for path in folder.iterdir()):
        msg = f"{folder} holds other files: give an empty or new folder"
        raise ValueError(msg)
    return take_lock(folder / _LOCK, "used")


def compact(points: NDArray[np.float64]) -> NDArray[Any]:
    """The same numbers in half of the memory, if float32 holds all their bits."""
    small = points.astype(np.float32)
    return small if (small == points).all() else points


@dataclass(frozen=True)
class LoggedScan:
    """One scan as it was given."""

    pose: NDArray[np.float64]  # (4, 4) T_world_sensor, m
    points: NDArray[Any]  # (N, 3) sensor frame, m: float32 if that holds all bits, else float64
    intensities: NDArray[np.float32] | None  # (N,) sensor units
    doppler_mps: NDArray[Any] | None  # (N,) along the ray
    standing: NDArray[np.bool_] | None  # (N,) the static returns, which the map has. None: all
    time_s: float | None = None

    @property
    def num_bytes(self) -> int:
        """Memory that it takes."""
        held: int = sum(array.nbytes for name in FIELDS if (array := getattr(self, name)) is not None)
        return held + _BYTES_OF_SCAN

    @property
    def reach_m(self) -> float:
        """Range of the farthest return."""
        return float(np.sqrt(np.square(self.points, dtype=np.float64).sum(axis=1).max()))

    def at(self, pose: NDArray[np.float64]) -> LoggedScan:
        """The same from another pose (4, 4)."""
        return replace(self, pose=pose)


@dataclass(frozen=True)
class _OnDisk:
    pose: NDArray[np.float64]
    path: Path
    reach_m: float
    time_s: float | None
    num_bytes: int = _BYTES_OF_SCAN // 2

    def read(self) -> LoggedScan:
        arrays = arrays_of(self.path, FIELDS)
        if "points" not in arrays:
            msg = f"{self.path} is not a scan of this map"
            raise ValueError(msg)
        columns: dict[str, Any] = {name: arrays.get(name) for name in FIELDS}
        return LoggedScan(self.pose, **columns, time_s=self.time_s)


class ScanLog:
    """Scans by their ids, in the order in which they came.

    The oldest are written to `folder` where memory is short. Without a folder they are let go: they stay in the map, but
    nothing can take them out of it.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._scans: dict[ScanId, LoggedScan | _OnDisk] = {}
        self._in_memory: dict[ScanId, None] = {}  # ids, the oldest first
        self.sealed: set[ScanId] = set()  # ids of the scans that cannot be taken out
        self._written = 0
        self.num_bytes = 0  # memory of what is held

    def __len__(self) -> int:
        return len(self._scans) + len(self.sealed)

    def __contains__(self, scan_id: ScanId) -> bool:
        return scan_id in self._scans or scan_id in self.sealed

    @property
    def ids(self) -> list[ScanId]:
        """Of the scans that can be taken out again."""
        return list(self._scans)

    def entry(self, scan_id: ScanId) -> LoggedScan | _OnDisk | None:
        """What has the pose and the time of a scan. None: it cannot be taken out."""
        return self._scans.get(scan_id)

    def get(self, scan_id: ScanId) -> LoggedScan:
        """A scan. Raises a KeyError if there is none of this id, a ValueError if it was let go."""
        if scan_id in self.sealed:
            msg = f"scan {scan_id!r} cannot be moved or taken out: it was let go to keep to max_bytes; give the map a folder to keep scans in"
            raise ValueError(msg)
        if scan_id not in self._scans:
            msg = f"the map has no scan {scan_id!r}"
            raise KeyError(msg)
        found = self._scans[scan_id]
        return found.read() if isinstance(found, _OnDisk) else found

    def scans(self, every: int = 1) -> Iterator[LoggedScan]:
        """Every n-th of those that can be taken out, in their order."""
        return (self.get(scan_id) for scan_id in list(self._scans)[::every])

    def put(self, scan_id: ScanId, scan: LoggedScan | _OnDisk) -> None:
        """Adds a scan, or changes one in its place."""
        self._forget(scan_id)
        self._scans[scan_id] = scan
        if isinstance(scan, LoggedScan):
            self._in_memory[scan_id] = None
        self.num_bytes += scan.num_bytes

    def drop(self, scan_id: ScanId) -> None:
        """Takes a scan out."""
        self._forget(scan_id)
        self._scans.pop(scan_id)

    def _forget(self, scan_id: ScanId) -> None:
        """Frees what it takes of the memory and of the disk."""
        there = self._scans.get(scan_id)
        self._in_memory.pop(scan_id, None)
        self.num_bytes -= 0 if there is None else there.num_bytes
        if isinstance(there, _OnDisk):
            with suppress(OSError):  # a file that stays harms nothing
                there.path.unlink()

    def shrink(self, max_bytes: int) -> None:
        """Lets the oldest scans in memory go, to the disk if there is a folder, until all take at most so much."""
        while self.num_bytes > max_bytes and self._in_memory:
            scan_id = next(iter(self._in_memory))
            if self._folder is None:
                self._seal(scan_id)
                continue
            scan = self.get(scan_id)
            path = self._folder / f"scan-{self._written:09d}.npz"
            write_arrays(path, {name: a for name in FIELDS if (a := getattr(scan, name)) is not None})
            self._written += 1
            self.put(scan_id, _OnDisk(scan.pose, path, scan.reach_m, scan.time_s))

    def seal_beyond(self, centre: NDArray[np.float64], radius_m: float) -> None:
        """Lets those go for good that reach beyond a ball around `centre` (3,), world, m: a part of what they gave is forgotten."""
        for scan_id, scan in list(self._scans.items()):
            if float(np.linalg.norm(scan.pose[:3, 3] - centre)) + scan.reach_m > radius_m:
                self._seal(scan_id)

    def _seal(self, scan_id: ScanId) -> None:
        self.drop(scan_id)
        self.sealed.add(scan_id)


class RegionStore:
    """Sums of regions that were put away, in a file each in `folder`, which come back with the same bits."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._paths: dict[int, Path] = {}

    @property
    def regions(self) -> Keys:
        """(R,) keys of the regions that are put away, ascending."""
        return np.array(sorted(self._paths), np.uint64)

    def put_away(self, sums: GrowingSums, regions: Keys) -> Keys:
        """Moves all blocks of `regions` out of `sums`, once all are written. Returns the keys of the blocks, ascending."""
        blocks = sums.block_keys()
        region_of_block = (blocks << BLOCK_BITS) >> REGION_BITS
        written = {}
        for region in np.intersect1d(regions, region_of_block).tolist():
            own = blocks[region_of_block == region]
            written[region] = self._folder / f"region-{region:016x}.npz"
            columns = (*sums.sums_of(own), *sums.looks_of(own))
            write_arrays(written[region], dict(zip(_CELL_COLUMNS, columns, strict=True)))
        self._paths |= written
        gone: Keys = blocks[np.isin(region_of_block, np.array([*written], np.uint64))]
        sums.erase(gone)
        return gone

    def bring_back(self, sums: GrowingSums, regions: Keys) -> Keys:
        """Moves `regions` that are put away into `sums`, all or none. Returns the keys of their blocks, ascending."""
        if len(regions) == 0:
            return NO_KEYS
        paths = [self._paths[region] for region in regions.tolist()]
        read = [_checked_sums(path, arrays_of(path, tuple(_CELL_COLUMNS))) for path in paths]
        keys, counts, scans, look_keys, looks = (
            np.concatenate(columns) for columns in zip(*read, strict=True)
        )
        sums.insert(keys, counts, scans, look_keys, looks)
        for region in regions.tolist():
            with suppress(OSError):  # a file that stays harms nothing
                self._paths.pop(region).unlink()
        return np.union1d(look_keys, keys >> BLOCK_BITS)


def _checked_sums(path: Path, arrays: dict[str, NDArray[Any]]) -> tuple[NDArray[Any], ...]:
    """The columns of cells and blocks in a file. The core trusts that keys ascend and that no cell is empty."""
    try:
        check_arrays(arrays, _CELL_COLUMNS)
        if (arrays["keys"][1:] < arrays["keys"][:-1]).any() or (arrays["sums"][:, 0] < 1).any():
            msg = "keys or counts are wrong"
            raise ValueError(msg)
    except ValueError as error:
        msg = f"{path} does not hold the sums of a live map, or it is damaged: {error}"
        raise ValueError(msg) from error
    return tuple(np.ascontiguousarray(arrays[name]) for name in _CELL_COLUMNS)


_Coordinate = Annotated[float, Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]
_Deviation = Annotated[float, Field(ge=0)]
_Count = Annotated[int, Field(ge=0, le=2**62)]


class Described(BaseModel):
    """What the state of a map has besides scans and sums."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    format: Literal[2] = 2
    config: dict[str, Any]
    origin: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)] | None
    noise: Annotated[list[_Deviation], Field(min_length=3, max_length=3)]
    noise_of: _Count
    next_id: _Count
    with_intensities: bool | None
    max_bytes: Annotated[int, Field(ge=1, le=2**63 - 1)] | None
    sealed: list[int | str]
    ids: list[int | str]


def save_state(
    path: str | PathLike[str],
    described: Described,
    scans: Sequence[LoggedScan],
    sums: Sequence[NDArray[Any]],
) -> None:
    """Writes a state whole or not at all. `sums`: columns of cells and of blocks, as the core gives and takes them."""
    arrays: dict[str, NDArray[Any]] = dict(zip(_CELL_COLUMNS, sums, strict=True))
    arrays["poses"] = np.array([scan.pose for scan in scans]).reshape(-1, 4, 4)
    arrays["times_s"] = np.array([np.nan if scan.time_s is None else scan.time_s for scan in scans], float)
    columns = [[getattr(scan, name) for scan in scans] for name in FIELDS]
    counts = [[-1 if array is None else len(array) for array in column] for column in columns]
    arrays["counts"] = np.array(counts, np.int64)  # -1: the scan has none
    for name, column in zip(FIELDS, columns, strict=True):
        if held := [array for array in column if array is not None]:
            arrays[name] = np.concatenate(held)
    arrays["described"] = np.frombuffer(described.model_dump_json().encode(), np.uint8)
    write_arrays(path, arrays)


def load_state(
    path: str | PathLike[str],
) -> tuple[Described, list[LoggedScan], tuple[NDArray[Any], ...]]:
    """The state that :func:`save_state` wrote. Raises a ValueError if the file is none, or damaged."""
    arrays = arrays_of(Path(path), ("described", "poses", "times_s", "counts", *_CELL_COLUMNS, *FIELDS))
    try:
        described = Described.model_validate_json(arrays["described"].tobytes())
        scans = _scans_of(described, arrays)
    except (KeyError, TypeError, ValueError) as error:
        msg = f"{path} is not the state of a live map of this version, or it is damaged: {error}"
        raise ValueError(msg) from error
    return described, scans, _checked_sums(Path(path), arrays)


def _scans_of(described: Described, arrays: dict[str, NDArray[Any]]) -> list[LoggedScan]:
    ids = described.ids
    if len({*ids, *described.sealed}) < len(ids) + len(described.sealed) or described.next_id in ids:
        msg = "ids are there twice"
        raise ValueError(msg)
    if ids and described.origin is None:
        msg = "the origin is missing"
        raise ValueError(msg)
    check_arrays(arrays, {"counts": (np.int64, len(FIELDS), len(ids)), "times_s": (np.float64, len(ids))})
    poses = check_poses(arrays["poses"], len(ids)) if ids else np.zeros((0, 4, 4))
    columns = [_by_scan(name, arrays, counts) for name, counts in zip(FIELDS, arrays["counts"], strict=True)]
    scans = []
    for i, own in enumerate(zip(*columns, strict=True)):
        points = positions(own[0], f"points of scan {i}")
        for name, column in zip(FIELDS[1:], own[1:], strict=True):
            if column is not None:
                check_values_of_scan(column, points, name, i)
        time_s = float(arrays["times_s"][i])
        known_s = time_s if np.isfinite(time_s) else None
        scans.append(LoggedScan(poses[i].copy(), **dict(zip(FIELDS, own, strict=True)), time_s=known_s))
    return scans


def _by_scan(name: str, arrays: dict[str, NDArray[Any]], counts: NDArray[np.int64]) -> list[Any]:
    """A column of each scan. None: the scan has none."""
    if (counts < 0).all():
        return [None] * len(counts)
    column, ends = arrays[name], np.cumsum(np.maximum(counts, 0))
    if ends[-1] != len(column) or column.dtype.kind != ("b" if name == "standing" else "f"):
        msg = f"{name} are of another number or type"
        raise ValueError(msg)
    # Some scans may have float32, others not.
    parts = [part if name == "standing" else compact(part) for part in np.split(column, ends[:-1])]
    return [part.copy() if count >= 0 else None for part, count in zip(parts, counts, strict=True)]
