"""Files of a live map: scans and regions moved out of memory, and its saved state."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from radarsdf._core import GrowingSums
from radarsdf.arrays import Array, Bools, Floats, Floats32, Keys
from radarsdf.checks import MAX_POSITION_M, AnyPath, check, check_pose, check_values_of_scan, positions
from radarsdf.io.files import check_regular_file, reading, take_lock
from radarsdf.io.npz import arrays_of, check_archive, check_arrays, write_arrays
from radarsdf.live.regions import REGION_BITS
from radarsdf.returns.evidence import BLOCK_BITS
from radarsdf.rig import Label, Mounted, Rig, checked_mountings

ScanId = Hashable
# Arrays of a scan, and their types.
_KINDS = {"points": "f", "intensities": "f", "doppler_mps": "f", "is_static": "b"}

# A file in the locked folder is used only once it is complete, so it needs no temporary one, as the state does. Writing it takes
# 0.5 ms, a fifth of :func:`write_arrays`.
_save: Callable[..., None] = np.savez
_LOCK = "live.lock"  # also marks a folder as used by a map
_BYTES_OF_SCAN = 1000  # approximate overhead of a scan
_CELL_COLUMNS: dict[str, tuple[Any, ...]] = {
    "keys": (np.uint64, None),
    "sums": (np.int64, None, 14),
    "scans_of_cells": (np.uint32, None),
    "visibility_keys": (np.uint64, None),
    "visibility": (np.uint32, None),
}  # in the order of the core's arguments


def locked_folder(folder: Path) -> int:
    """Create the folder of one map, and lock it until the returned descriptor is closed."""
    folder.mkdir(exist_ok=True)
    ours = (_LOCK, "*scan-*.npz*", "*region-*.npz*") if (folder / _LOCK).is_file() else ()
    known = all(any(path.match(name) for name in ours) for path in folder.iterdir())
    check(known, f"{folder} holds other files: give an empty or new folder")
    return take_lock(folder / _LOCK, "used")


def compact(points: Floats) -> Array:
    """Convert to float32 if that is lossless, to halve the memory."""
    small = points.astype(np.float32)
    return small if (small == points).all() else points


@dataclass(frozen=True)
class LoggedScan:
    """Scan as passed to the map."""

    pose: Floats  # (4, 4) T_world_sensor, or T_world_body of a rig, m
    points: Array  # (N, 3) sensor frame, m: float32 if that is lossless, else float64
    intensities: Floats32 | None = None  # (N,) sensor units
    doppler_mps: Array | None = None  # (N,) radial speed
    is_static: Bools | None = None  # (N,) mask of the static returns, those in the map. None: all
    time_s: float | None = None
    radar: Mounted | None = None  # of several. `pose` is then T_world_body

    @property
    def T_world_sensor(self) -> Floats:
        return self.pose if self.radar is None else self.pose @ self.radar.T_body_sensor

    @property
    def label(self) -> Label | None:
        return None if self.radar is None else self.radar.label

    @property
    def arrays(self) -> dict[str, Array]:
        return {name: array for name in _KINDS if (array := getattr(self, name)) is not None}

    @property
    def static(self) -> LoggedScan:
        if self.is_static is None:
            return self
        kept: dict[str, Any] = {name: array[self.is_static] for name, array in self.arrays.items()}
        return replace(self, **kept | {"is_static": None})

    @property
    def num_bytes(self) -> int:
        return sum(array.nbytes for array in self.arrays.values()) + _BYTES_OF_SCAN

    def at(self, pose: Floats) -> LoggedScan:
        return replace(self, pose=pose)


def rig_of_scans(scans: Sequence[LoggedScan]) -> Rig | None:
    known = [scan.radar for scan in scans if scan.radar is not None]
    return Rig.of([radar.label for radar in known], dict(known)) if known else None


@dataclass(frozen=True)
class _OnDisk:
    pose: Floats
    path: Path
    time_s: float | None
    radar: Mounted | None
    num_bytes: int = _BYTES_OF_SCAN // 2

    def read(self) -> LoggedScan:
        return _scan_of(arrays_of(self.path, _KINDS), self.pose, self.time_s, self.radar)


def _scan_of(
    arrays: Mapping[str, Array], pose: Floats, time_s: float | None, radar: Mounted | None
) -> LoggedScan:
    """Build a scan from the arrays of its file. Raise a KeyError or a ValueError if it is damaged."""
    points = positions(arrays["points"], "points")
    for name, array in arrays.items():
        if name != "points":
            check_values_of_scan(array, points, name, 0)
        check(array.dtype.kind == _KINDS[name], f"{name} are {array.dtype}")
    return LoggedScan(pose, **arrays, time_s=time_s, radar=radar)


class ScanLog:
    """Scans by id, in order of insertion. Changes return a new log, and leave the files of this one.

    To limit memory, the oldest are written to `folder`. Without a folder they are sealed: they stay in the map, but can no
    longer be removed.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self._scans: dict[ScanId, LoggedScan | _OnDisk] = {}
        self.sealed: set[ScanId] = set()
        self._written = 0
        self.num_bytes = 0  # memory of the scans

    def __len__(self) -> int:
        return len(self._scans) + len(self.sealed)

    def __contains__(self, scan_id: ScanId) -> bool:
        return scan_id in self._scans or scan_id in self.sealed

    @property
    def ids(self) -> list[ScanId]:
        """Identifiers of the scans that can be removed."""
        return list(self._scans)

    def entry(self, scan_id: ScanId) -> LoggedScan | _OnDisk | None:
        """Return the entry with the pose and the time of a scan. None if it cannot be removed."""
        return self._scans.get(scan_id)

    def get(self, scan_id: ScanId) -> LoggedScan:
        """Return a scan. Raise a KeyError if there is none of this id, a ValueError if it was sealed."""
        sealed = f"scan {scan_id!r} cannot be moved or removed: it was sealed by max_bytes or clear_outside"
        check(scan_id not in self.sealed, f"{sealed}; give the map a folder to keep scans in")
        if scan_id not in self._scans:
            msg = f"the map has no scan {scan_id!r}"
            raise KeyError(msg)
        found = self._scans[scan_id]
        return found.read() if isinstance(found, _OnDisk) else found

    def scans(self, every: int = 1) -> Iterator[LoggedScan]:
        """Iterate over every n-th scan that can be removed, in order."""
        return (self.get(scan_id) for scan_id in self.ids[::every])

    def put(self, scan_id: ScanId, scan: LoggedScan | _OnDisk) -> None:
        """Add a scan, or replace it in place."""
        before = self._scans.get(scan_id)
        self._scans[scan_id] = scan
        self.num_bytes += scan.num_bytes - (0 if before is None else before.num_bytes)

    def exchanged(
        self, new: Mapping[ScanId, LoggedScan | _OnDisk], old: Iterable[ScanId], sealed: Sequence[ScanId] = ()
    ) -> ScanLog:
        """Return a log without the scans `old`, and with those of `new`. Ids in both keep their place."""
        log = copy(self)
        log._scans = self._scans.copy()
        if sealed:
            log.sealed = self.sealed.union(sealed)
        for scan_id in set(old).union(sealed) - new.keys():
            log.num_bytes -= log._scans.pop(scan_id).num_bytes
        for scan_id, scan in new.items():
            log._written += isinstance(scan, _OnDisk)
            log.put(scan_id, scan)
        return log

    def unlink(self, scan_ids: Iterable[ScanId]) -> None:
        """Delete the files of scans, which another log has replaced."""
        for scan_id in scan_ids:
            if isinstance(there := self._scans[scan_id], _OnDisk):
                with suppress(OSError):  # a leftover file is harmless
                    there.path.unlink()

    def shrunk(self, max_bytes: int) -> ScanLog:
        """Return a log with the oldest scans in memory written or sealed until they fit into `max_bytes`."""
        come: dict[ScanId, _OnDisk] = {}
        sealed, excess = [], self.num_bytes - max_bytes
        for scan_id, scan in self._scans.items():
            if excess <= 0:
                break
            if isinstance(scan, _OnDisk):
                continue
            excess -= scan.num_bytes
            if self.folder is None:
                sealed.append(scan_id)
                continue
            path = self.folder / f"scan-{self._written + len(come):09d}.npz"
            _save(path, **scan.arrays)
            come[scan_id] = on_disk = _OnDisk(scan.pose, path, scan.time_s, scan.radar)
            excess += on_disk.num_bytes
        return self.exchanged(come, (), sealed)

    def sealed_beyond(self, centre: Floats, radius_m: float) -> ScanLog:
        """Return a log with those scans sealed that have returns outside a ball around `centre` (3,), world, m."""
        sealed = []
        for scan_id in self.ids:
            scan = self.get(scan_id)
            reach_m = np.sqrt(np.square(scan.points, dtype=np.float64).sum(axis=1).max())
            if np.linalg.norm(scan.pose[:3, 3] - centre) + reach_m > radius_m:
                sealed.append(scan_id)
        return self.exchanged({}, (), sealed)


class RegionStore:
    """Region store: sums of regions on disk, one file each in `folder`, restored bit-identically."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def _path(self, region: int) -> Path:
        assert self.folder is not None
        return self.folder / f"region-{region:016x}.npz"

    def write(self, sums: GrowingSums, regions: Keys) -> tuple[Keys, Keys]:
        """Write those of `regions` that are in `sums`. Return the ascending keys of their blocks, and theirs."""
        blocks = sums.block_keys()
        region_of_block = (blocks << BLOCK_BITS) >> REGION_BITS
        written = np.intersect1d(regions, region_of_block)
        for region in written.tolist():
            own = blocks[region_of_block == region]
            _save(self._path(region), **arrays_of_sums(sums, own))
        return blocks[np.isin(region_of_block, written)], written

    def read(self, regions: Keys) -> tuple[Keys, list[Array]]:
        """Return the ascending keys of the blocks of `regions` on disk, and the columns of their sums."""
        read = []
        for path in map(self._path, regions.tolist()):
            with reading(path, "a whole region of a live map"):
                read.append(_sums_of(arrays_of(path, _CELL_COLUMNS)))
        columns = [np.concatenate(parts) for parts in zip(*read, strict=True)]
        keys, _, _, visibility_keys, _ = columns
        return np.union1d(visibility_keys, keys >> BLOCK_BITS), columns

    def unlink(self, regions: Keys) -> None:
        """Delete the files of regions that are in memory again."""
        for region in regions.tolist():
            with suppress(OSError):  # a leftover file is harmless
                self._path(region).unlink()


def arrays_of_sums(sums: GrowingSums, blocks: Keys) -> dict[str, Array]:
    """Return the columns of cells and of these blocks (B,), by name."""
    return dict(zip(_CELL_COLUMNS, (*sums.sums_of(blocks), *sums.visibility_of(blocks)), strict=True))


def _sums_of(arrays: dict[str, Array]) -> tuple[Array, ...]:
    """Return the columns of cells and blocks of a file. The core relies on ascending keys and non-empty cells."""
    check_arrays(arrays, _CELL_COLUMNS)
    descending = (arrays["keys"][1:] < arrays["keys"][:-1]).any()
    check(not descending and (arrays["sums"][:, 0] >= 1).all(), "keys or counts are wrong")
    return tuple(np.ascontiguousarray(arrays[name]) for name in _CELL_COLUMNS)


_Coordinate = Annotated[float, Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]
_Count = Annotated[int, Field(ge=0, le=2**62)]


class Described(BaseModel):
    """State of a map without its arrays."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    format: Literal[4] = 4
    config: dict[str, Any]
    origin: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)] | None
    noise: Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=3, max_length=3)]
    noise_of: _Count
    next_id: _Count
    with_intensities: bool | None
    max_bytes: Annotated[int, Field(ge=1, le=2**63 - 1)] | None
    sealed: list[int | str]
    ids: list[int | str]
    poses: list[list[list[float]]]  # T_world_sensor, m, of the scans in `ids`
    times_s: list[float | None]
    # T_body_sensor, m, of the radars of a rig by label, and the number of that of each scan in `ids`.
    mountings: list[tuple[int | str, list[list[float]]]] | None = None
    radars: list[int] = []

    @property
    def T_body_sensor(self) -> dict[Label, Floats] | None:
        return None if self.mountings is None else checked_mountings(dict(self.mountings))


def save_state(path: AnyPath, described: Described, scans: Iterable[LoggedScan], sums: GrowingSums) -> None:
    arrays = arrays_of_sums(sums, sums.block_keys())
    for i, scan in enumerate(scans):
        arrays |= {f"{name} {i}": array for name, array in scan.arrays.items()}
    arrays["described"] = np.frombuffer(described.model_dump_json().encode(), np.uint8)
    write_arrays(path, arrays)


def load_state(path: AnyPath) -> tuple[Described, list[LoggedScan], tuple[Array, ...]]:
    """Read a state written by :func:`save_state`, with the columns of its sums."""
    check_regular_file(path)
    with reading(path, "the state of a live map of this version, or it is damaged", KeyError, TypeError):
        check_archive(path)
        described = Described.model_validate_json(arrays_of(path, ["described"])["described"].tobytes())
        ids = [*described.ids, *described.sealed]
        check(len(set(ids)) == len(ids), "ids are duplicated")
        check(described.origin is not None or not ids, "the origin is missing")
        names = [{f"{name} {i}": name for name in _KINDS} for i in range(len(described.ids))]
        arrays = arrays_of(path, (*_CELL_COLUMNS, *itertools.chain(*names)))
        scans, radars = [], [Mounted(*of) for of in (described.T_body_sensor or {}).items()]
        numbers = described.radars if radars else [0] * len(names)
        for of_scan, pose, time_s, k in zip(names, described.poses, described.times_s, numbers, strict=True):
            held = {name: arrays[key] for key, name in of_scan.items() if key in arrays}
            scans.append(_scan_of(held, check_pose(pose, "pose"), time_s, radars[k] if radars else None))
        return described, scans, _sums_of(arrays)
