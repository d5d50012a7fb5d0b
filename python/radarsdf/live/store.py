"""Files of a live map: scans and regions moved out of memory, and its saved state."""

import sqlite3
import weakref
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from radarsdf import checks
from radarsdf.arrays import Array, Bools, Floats, Floats32, Keys
from radarsdf.checks import AnyPath, check, restating
from radarsdf.io.files import check_regular_file, reading, take_lock
from radarsdf.io.npz import arrays_of, check_archive, check_arrays, write_arrays
from radarsdf.live.sums import RadarSums
from radarsdf.live.surface import REGION_BITS
from radarsdf.returns.evidence import BLOCK_BITS
from radarsdf.returns.noise import RigNoise, SensorNoise
from radarsdf.rig import Label, Mounted, checked_mountings

ScanId = Hashable
# Arrays of a scan, and their types.
_KINDS = {"points": "f", "intensities": "f", "doppler_mps": "f", "sigmas": "f", "is_static": "b"}

# A file in the locked folder is used only once it is complete, so it needs no temporary one, as the state does.
_save: Callable[..., None] = np.savez
_LOCK = "live.lock"  # also marks a folder as used by a map
_SCANS = "scans.sqlite"
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
    ours = (_LOCK, f"{_SCANS}*", "region-*.npz") if (folder / _LOCK).is_file() else ()
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
    sigmas: Array | None = None  # (N, 3) deviations that the sensor states, m, rad, rad
    is_static: Bools | None = None  # (N,) mask of the static returns, those in the map. None: all
    time_s: float | None = None
    radar: Mounted | None = None  # of several. `pose` is then T_world_body
    tracked: bool = False  # whether its pose is an estimate relative to those of other scans

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
    def static(self) -> "LoggedScan":
        if self.is_static is None:
            return self
        kept: dict[str, Any] = {name: array[self.is_static] for name, array in self.arrays.items()}
        return replace(self, **kept | {"is_static": None})

    @property
    def num_bytes(self) -> int:
        return sum(array.nbytes for array in self.arrays.values()) + _BYTES_OF_SCAN


class Placement(NamedTuple):
    """What a log knows of a scan without reading its returns."""

    scan_id: ScanId
    pose: Floats  # (4, 4), as of the scan
    time_s: float | None
    tracked: bool


class _Rows:
    """Rows of scans in a file, which never change: a change of the map adds others, so that it can be undone."""

    def __init__(self, folder: Path | None) -> None:
        self._path = (folder or Path()) / _SCANS  # without a folder, nothing is read or written

    @cached_property
    def _opened(self) -> sqlite3.Connection:
        self._path.unlink(missing_ok=True)  # of another map
        opened = sqlite3.connect(self._path, check_same_thread=False)  # a lock of the map guards it
        weakref.finalize(self, opened.close)
        # No process reads the file after this one: it need not survive a crash.
        opened.executescript(
            "PRAGMA journal_mode = MEMORY; PRAGMA synchronous = OFF;"
            f"CREATE TABLE scans(number INTEGER PRIMARY KEY, place, id, pose, time_s, tracked, radar, {', '.join(_KINDS)});"
            "CREATE INDEX of_id ON scans(id); CREATE INDEX in_order ON scans(place, id)"
        )
        return opened

    def read(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        with self._transaction() as rows:
            return rows.execute(f"SELECT {query}", values).fetchall()

    def write(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Write rows, in place of those of an undone change from the number of the first on."""
        with self._transaction() as known:
            known.execute("DELETE FROM scans WHERE number >= ?", rows[0][:1])
            known.executemany(f"INSERT INTO scans VALUES ({', '.join('?' * len(rows[0]))})", rows)

    def delete(self, numbers: Iterable[int]) -> None:
        with self._transaction() as rows:
            rows.executemany("DELETE FROM scans WHERE number = ?", [(number,) for number in numbers])

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with restating(str(self._path), sqlite3.Error, kind=OSError), self._opened:
            yield self._opened


class ScanLog:
    """Scans by id, in order of insertion. Changes return a new log, and leave what is stored of this one.

    To limit memory, the oldest are written to `folder`, which leaves nothing of them in memory. Without a folder they are
    sealed: they stay in the map, but can no longer be removed.
    """

    def __init__(self, folder: Path | None = None, mountings: Mapping[Label, Floats] | None = None) -> None:
        self.folder = folder
        self._scans: dict[ScanId, LoggedScan] = {}  # in memory: newer than all in the folder
        self.sealed: set[ScanId] = set()
        self.num_bytes = 0  # memory of the scans
        self.edits = 0  # changes other than the addition of scans
        self._radars = [Mounted(*of) for of in (mountings or {}).items()]
        self._rows = _Rows(folder)
        self._stored = 0  # scans in the folder: in rows before the end, apart from those
        self._end = 0
        self._gone: frozenset[int] = frozenset()

    def __len__(self) -> int:
        return len(self._scans) + len(self.sealed) + self._stored

    def __contains__(self, scan_id: ScanId) -> bool:
        return scan_id in self._scans or scan_id in self.sealed or self._row(scan_id) is not None

    def _row(self, scan_id: ScanId, *more: str) -> tuple[Any, ...] | None:
        """Return number, place in order, pose, time and `more` columns of a scan in the folder; None if it is not there."""
        if not self._stored or scan_id in self._scans:
            return None
        columns = ", ".join(["number, place, pose, time_s", *more])
        rows = self._rows.read(f"{columns} FROM scans WHERE id = ? AND number < ?", scan_id, self._end)
        return next((row for row in rows if row[0] not in self._gone), None)

    @property
    def ids(self) -> list[ScanId]:
        """Identifiers of the scans that can be removed."""
        return [placed.scan_id for placed in self.trajectory()]

    def trajectory(self) -> list[Placement]:
        """Return the placements of the scans that can be removed, in order."""
        columns = "number, id, pose, time_s, tracked FROM scans WHERE number < ? ORDER BY place"
        stored = self._rows.read(columns, self._end) if self._stored else []
        placed = [_placement(*row) for number, *row in stored if number not in self._gone]
        for scan_id, scan in self._scans.items():
            placed.append(Placement(scan_id, scan.pose, scan.time_s, scan.tracked))
        return placed

    def placed(self, scan_id: ScanId) -> Placement | None:
        """Return the placement of a scan. None if it cannot be removed."""
        if (row := self._row(scan_id, "tracked")) is not None:
            return _placement(scan_id, *row[2:])
        held = self._scans.get(scan_id)
        return None if held is None else Placement(scan_id, held.pose, held.time_s, held.tracked)

    def get(self, scan_id: ScanId) -> LoggedScan:
        """Return a scan. Raise a KeyError if there is none of this id, a ValueError if it was sealed."""
        sealed = f"scan {scan_id!r} cannot be moved or removed: it was sealed by max_bytes or clear_outside"
        check(scan_id not in self.sealed, f"{sealed}; give the map a folder to keep scans in")
        row = self._row(scan_id, "tracked", "radar", *_KINDS)
        if row is None:
            check(scan_id in self._scans, f"the map has no scan {scan_id!r}", KeyError)
            return self._scans[scan_id]
        _, _, pose, time_s, tracked, radar, *blobs = row
        stored = {name: blob for name, blob in zip(_KINDS, blobs, strict=True) if blob is not None}
        held: dict[str, Any] = {n: np.frombuffer(b, chr(b[0]), offset=1).copy() for n, b in stored.items()}
        held |= {name: held[name].reshape(-1, 3) for name in ("points", "sigmas") if name in held}
        mounted = None if radar is None else self._radars[radar]
        return LoggedScan(_pose_of(pose), **held, time_s=time_s, radar=mounted, tracked=bool(tracked))

    def scans(self, every: int = 1) -> Iterator[LoggedScan]:
        """Iterate over one of every n scans that can be removed, in order; at random, since radars may take turns."""
        ids = self.ids
        firsts = np.arange(0, len(ids), every)
        rows = firsts + np.random.default_rng(0).integers(every, size=len(firsts))
        return (self.get(ids[i]) for i in np.minimum(rows, len(ids) - 1))

    def exchanged(self, new: Mapping[ScanId, LoggedScan], old: Collection[ScanId]) -> "ScanLog":
        """Return a log without the scans `old`, and with those of `new`. Ids in both keep their place."""
        stored = {scan_id: row for scan_id in old if (row := self._row(scan_id)) is not None}
        log = self._without(set(old) - new.keys() - stored.keys())
        log.edits += bool(old)
        log._gone = self._gone.union(number for number, *_ in stored.values())
        log._stored -= len(stored)
        kept = {scan_id: place for scan_id, (_, place, *_) in stored.items() if scan_id in new}
        log._write([(place, scan_id, new[scan_id]) for scan_id, place in kept.items()])
        held = {scan_id: scan for scan_id, scan in new.items() if scan_id not in stored}
        log.num_bytes += sum(scan.num_bytes for scan in held.values())
        log.num_bytes -= sum(log._scans[scan_id].num_bytes for scan_id in held.keys() & log._scans.keys())
        log._scans |= held  # in place of those with the same ids
        return log

    def _without(self, held: Iterable[ScanId], *, sealed: bool = False) -> "ScanLog":
        """Return a log without the scans `held` in memory. `sealed`: these stay in the map."""
        log, emptied = copy(self), set(held)
        log._scans = self._scans.copy()
        for scan_id in emptied:
            log.num_bytes -= log._scans.pop(scan_id).num_bytes
        log.sealed = self.sealed | emptied if sealed else self.sealed
        return log

    def _write(self, scans: Sequence[tuple[int, ScanId, LoggedScan]]) -> None:
        if not scans:
            return
        labels, rows = [radar.label for radar in self._radars], []
        for number, (place, scan_id, scan) in enumerate(scans, self._end):
            held = [scan.arrays.get(name) for name in _KINDS]
            blobs = [None if array is None else array.dtype.char.encode() + array.tobytes() for array in held]
            radar = None if scan.radar is None else labels.index(scan.label)
            columns = place, scan_id, scan.pose.tobytes(), scan.time_s, scan.tracked, radar
            rows.append((number, *columns, *blobs))
        self._rows.write(rows)
        self._end += len(rows)
        self._stored += len(rows)

    def tidy(self) -> None:
        """Delete rows that no log uses any more, as this one is in the map."""
        if self._gone:
            with suppress(OSError):  # leftover rows are harmless
                self._rows.delete(self._gone)
                self._gone = frozenset()

    def shrunk(self, max_bytes: int) -> "ScanLog":
        """Return a log with the oldest scans in memory written or sealed until they fit into `max_bytes`."""
        oldest, excess = [], self.num_bytes - max_bytes
        for scan_id, scan in self._scans.items():
            if excess <= 0:
                break
            excess -= scan.num_bytes
            oldest.append(scan_id)
        log = self._without(oldest, sealed=self.folder is None)
        if self.folder is not None:
            log._write([(self._end + i, scan_id, self._scans[scan_id]) for i, scan_id in enumerate(oldest)])
        return log

    def sealed_beyond(self, centre: Floats, radius_m: float) -> "ScanLog":
        """Return a log with those scans sealed that have returns outside a ball around `centre` (3,), world, m."""
        sealed = []
        for scan_id, scan in self._scans.items():
            reach_m = np.sqrt(np.square(scan.points, dtype=np.float64).sum(axis=1).max())
            if np.linalg.norm(scan.T_world_sensor[:3, 3] - centre) + reach_m > radius_m:
                sealed.append(scan_id)
        return self._without(sealed, sealed=True)


def _placement(scan_id: ScanId, pose: bytes, time_s: float | None, tracked: int) -> Placement:
    return Placement(scan_id, _pose_of(pose), time_s, bool(tracked))


def _pose_of(blob: bytes) -> Floats:
    return np.frombuffer(blob).reshape(4, 4).copy()


def region_paths(folder: Path | None, regions: Keys) -> list[Path]:
    """Return the files of regions (R,), which hold their sums bit-identically."""
    return [(folder or Path()) / f"region-{region:016x}.npz" for region in regions.tolist()]


def write_regions(folder: Path | None, sums: RadarSums, regions: Keys) -> tuple[Keys, Keys]:
    """Write those of `regions` that are in `sums`. Return the ascending keys of their blocks, and theirs."""
    blocks = sums.block_keys()
    region_of_block = (blocks << BLOCK_BITS) >> REGION_BITS
    written = np.intersect1d(regions, region_of_block)
    for region, path in zip(written, region_paths(folder, written), strict=True):
        _save(path, **arrays_of_sums(sums, blocks[region_of_block == region]))
    return blocks[np.isin(region_of_block, written)], written


def read_regions(folder: Path | None, regions: Keys, num_radars: int) -> tuple[Keys, list[tuple[Array, ...]]]:
    """Return the ascending keys of the blocks of `regions` on disk, and the columns of their sums, of each radar."""
    read = []
    for path in region_paths(folder, regions):
        with reading(path, "a whole region of a live map"):
            read.append(_read_sums(path, num_radars))
    columns = [tuple(map(np.concatenate, zip(*parts, strict=True))) for parts in zip(*read, strict=True)]
    each = [np.union1d(visibility_keys, keys >> BLOCK_BITS) for keys, _, _, visibility_keys, _ in columns]
    return reduce(np.union1d, each), columns


def _columns_of(num_radars: int) -> dict[str, tuple[Any, ...]]:
    suffixes = ["", *(f" of radar {k}" for k in range(1, num_radars))]
    return {name + suffix: kind for suffix in suffixes for name, kind in _CELL_COLUMNS.items()}


def arrays_of_sums(sums: RadarSums, blocks: Keys) -> dict[str, Array]:
    """Return the columns of cells and of these blocks (B,), by name."""
    return dict(zip(_columns_of(len(sums)), chain(*sums.columns(blocks)), strict=True))


def _read_sums(path: AnyPath, num_radars: int) -> list[tuple[Array, ...]]:
    """Read the columns of cells and blocks of each radar. The core relies on ascending keys and non-empty cells."""
    wanted, width = _columns_of(num_radars), len(_CELL_COLUMNS)
    arrays = arrays_of(path, wanted)
    check_arrays(arrays, wanted)
    columns = [np.ascontiguousarray(arrays[name]) for name in wanted]
    found = [tuple(columns[first : first + width]) for first in range(0, len(columns), width)]
    for keys, sums, *_ in found:
        check(not (keys[1:] < keys[:-1]).any() and (sums[:, 0] >= 1).all(), "keys or counts are wrong")
    return found


_Coordinate = Annotated[float, Field(ge=-checks.MAX_POSITION_M, le=checks.MAX_POSITION_M)]
_Count = Annotated[int, Field(ge=0, le=2**62)]


class Described(BaseModel):
    """State of a map without its arrays."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    format: Literal[6] = 6
    config: dict[str, Any]
    origin: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)] | None
    noise: RigNoise | SensorNoise
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
    tracked: list[int | str] = []  # those of `ids` whose poses are estimates

    @property
    def T_body_sensor(self) -> dict[Label, Floats] | None:
        return None if self.mountings is None else checked_mountings(dict(self.mountings))


def save_state(path: AnyPath, described: Described, scans: Iterable[LoggedScan], sums: RadarSums) -> None:
    arrays = arrays_of_sums(sums, sums.block_keys())
    for i, scan in enumerate(scans):
        arrays |= {f"{name} {i}": array for name, array in scan.arrays.items()}
    arrays["described"] = np.frombuffer(described.model_dump_json().encode(), np.uint8)
    write_arrays(path, arrays)


def load_state(path: AnyPath) -> tuple[Described, list[LoggedScan], list[tuple[Array, ...]]]:
    """Read a state written by :func:`save_state`, with the columns of its sums."""
    check_regular_file(path)
    with reading(path, "the state of a live map of this version, or it is damaged", KeyError, TypeError):
        check_archive(path)
        described = Described.model_validate_json(arrays_of(path, ["described"])["described"].tobytes())
        ids, tracked = [*described.ids, *described.sealed], set(described.tracked)
        check(len(set(ids)) == len(ids), "ids are duplicated")
        check(described.origin is not None or not ids, "the origin is missing")
        names = [f"{name} {i}" for i in range(len(described.ids)) for name in _KINDS]
        scans, radars = [], [Mounted(*of) for of in (described.T_body_sensor or {}).items()]
        arrays = arrays_of(path, names)
        numbers = described.radars if radars else [0] * len(described.ids)
        each = zip(described.ids, described.poses, described.times_s, numbers, strict=True)
        for i, (scan_id, pose, time_s, k) in enumerate(each):
            held: dict[str, Any] = {name: arrays[key] for name in _KINDS if (key := f"{name} {i}") in arrays}
            points = checks.positions(held["points"], "points")
            for name, array in held.items():
                if name != "points":
                    checks.check_values_of_scan(array, points, name, 0, *[3] * (name == "sigmas"))
                check(array.dtype.kind == _KINDS[name], f"{name} are {array.dtype}")
            mounted = radars[k] if radars else None
            known: dict[str, Any] = {"time_s": time_s, "radar": mounted, "tracked": scan_id in tracked}
            scans.append(LoggedScan(checks.check_pose(pose, "pose"), **held, **known))
        return described, scans, _read_sums(path, max(len(radars), 1))
