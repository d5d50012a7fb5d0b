# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The scans of a map that grows, as they are needed to take one out again or to fit all of them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import instance
from radarsdf.io.npz import arrays_of, write_arrays

ScanId = Hashable
FIELDS = ("points", "intensities", "doppler_mps", "standing")
"""What a `LoggedScan` holds beside its pose, in this order."""


@dataclass(frozen=True)
class LoggedScan:
    """One scan as it was given."""

    pose: NDArray[np.float64]
    """(4, 4) T_world_sensor, m."""
    points: NDArray[Any]
    """(N, 3) sensor frame, m: float32 if that holds all bits, else float64."""
    intensities: NDArray[np.float32] | None
    """(N,) sensor units."""
    doppler_mps: NDArray[Any] | None
    """(N,) along the ray."""
    standing: NDArray[np.bool_] | None
    """(N,) the returns that the map has. None: all."""
    time_s: float | None = None
    """When it was taken."""

    @property
    def num_bytes(self) -> int:
        """Memory that it takes, bytes."""
        arrays = [self.pose, *(getattr(self, name) for name in FIELDS)]
        held: int = sum(array.nbytes for array in arrays if array is not None)
        return held + _BYTES_OF_SCAN

    @property
    def reach_m(self) -> float:
        """Range of the farthest return, m."""
        return float(np.sqrt(np.square(self.points, dtype=np.float64).sum(axis=1).max()))

    def at(self, pose: NDArray[np.float64]) -> LoggedScan:
        """The same from another pose (4, 4)."""
        return replace(self, pose=pose)


_BYTES_OF_SCAN = 1000  # of the objects that hold a scan, about
_BYTES_ON_DISK = 500  # likewise, of one that lies on the disk


class SealedScan(ValueError):
    """A scan is in the map, but can be neither moved nor taken out: it was let go to bound the memory."""


@dataclass(frozen=True)
class _OnDisk:
    pose: NDArray[np.float64]
    path: Path
    reach_m: float
    time_s: float | None


class ScanLog:
    """Scans by their ids, in the order in which they came.

    The oldest are written to `folder` where memory is short. Without a folder they are let go: they stay in the map, but
    nothing can take them out of it.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._scans: dict[ScanId, LoggedScan | _OnDisk] = {}
        self._sealed: set[ScanId] = set()
        # Ids of those in memory, the oldest first. A list of all for each scan would wake Python's collector of garbage.
        self._in_memory: OrderedDict[ScanId, None] = OrderedDict()
        self._written = 0
        self.num_bytes = 0
        """Memory of what is held, bytes."""

    def __len__(self) -> int:
        return len(self._scans) + len(self._sealed)

    def __contains__(self, scan_id: ScanId) -> bool:
        return scan_id in self._scans or scan_id in self._sealed

    @property
    def ids(self) -> list[ScanId]:
        """Of the scans that can be taken out again."""
        return list(self._scans)

    @property
    def sealed(self) -> int:
        """Number of scans that cannot."""
        return len(self._sealed)

    def pose(self, scan_id: ScanId) -> NDArray[np.float64]:
        """(4, 4) of a scan that can be taken out."""
        return self._scans[scan_id].pose

    def entry(self, scan_id: ScanId) -> LoggedScan | _OnDisk | None:
        """What has the pose and the time of a scan. None: it cannot be taken out."""
        return self._scans.get(scan_id)

    def get(self, scan_id: ScanId) -> LoggedScan:
        """A scan. Raises a KeyError if there is none of this id, SealedScan if it was let go."""
        instance(scan_id, Hashable, "scan_id")  # type: ignore[type-abstract]
        if scan_id in self._sealed:
            msg = f"scan {scan_id!r} cannot be moved or taken out: it was let go to keep to max_bytes; give the map a folder to keep scans in"
            raise SealedScan(msg)
        if scan_id not in self._scans:
            msg = f"the map has no scan {scan_id!r}"
            raise KeyError(msg)
        found = self._scans[scan_id]
        return _read(found) if isinstance(found, _OnDisk) else found

    def scans(self, every: int = 1) -> Iterator[LoggedScan]:
        """All that can be taken out, in their order; or each so many-th."""
        return (self.get(scan_id) for scan_id in list(self._scans)[::every])

    def put(self, scan_id: ScanId, scan: LoggedScan) -> None:
        """Adds a scan, or changes one in its place."""
        self._forget(scan_id)
        self._scans[scan_id] = scan
        self._in_memory[scan_id] = None
        self.num_bytes += scan.num_bytes

    def drop(self, scan_id: ScanId) -> None:
        """Takes a scan out."""
        self._forget(scan_id)
        self._scans.pop(scan_id)

    def _forget(self, scan_id: ScanId) -> None:
        """What it takes of the memory and of the disk."""
        there = self._scans.get(scan_id)
        if isinstance(there, _OnDisk):
            with suppress(OSError):  # a file that stays harms nothing
                there.path.unlink()
            self.num_bytes -= _BYTES_ON_DISK
        elif there is not None:
            del self._in_memory[scan_id]
            self.num_bytes -= there.num_bytes

    def shrink(self, max_bytes: int) -> None:
        """Lets the oldest scans in memory go, to the disk if there is a folder, until all take at most so much."""
        while self.num_bytes > max_bytes and self._in_memory:
            scan_id = next(iter(self._in_memory))
            scan = self._scans[scan_id]
            assert isinstance(scan, LoggedScan)
            self._let_go(scan_id, scan)

    def _let_go(self, scan_id: ScanId, scan: LoggedScan) -> None:
        if self._folder is None:
            self.drop(scan_id)
            self._sealed.add(scan_id)
            return
        path = self._folder / f"scan-{self._written:09d}.npz"
        write_arrays(path, _arrays(scan))
        self._written += 1
        self._forget(scan_id)
        self._scans[scan_id] = _OnDisk(scan.pose, path, scan.reach_m, scan.time_s)
        self.num_bytes += _BYTES_ON_DISK

    def seal_beyond(self, centre: NDArray[np.float64], radius_m: float) -> None:
        """Lets those go for good that reach beyond a ball round `centre` (3,), world, m: a part of what they gave is forgotten."""
        for scan_id, scan in list(self._scans.items()):
            if float(np.linalg.norm(scan.pose[:3, 3] - centre)) + scan.reach_m > radius_m:
                self.drop(scan_id)
                self._sealed.add(scan_id)

    @property
    def sealed_ids(self) -> list[ScanId]:
        """Of the scans that cannot be taken out."""
        return list(self._sealed)

    def restore_sealed(self, scan_ids: list[ScanId]) -> None:
        """Of a map that is read again."""
        self._sealed |= set(scan_ids)


def _arrays(scan: LoggedScan) -> dict[str, NDArray[Any]]:
    given = {name: getattr(scan, name) for name in ("pose", *FIELDS)}
    return {name: array for name, array in given.items() if array is not None}


def _read(found: _OnDisk) -> LoggedScan:
    arrays = arrays_of(found.path, ("pose", *FIELDS))
    if not {"pose", "points"} <= set(arrays):
        msg = f"{found.path} is not a scan of this map"
        raise ValueError(msg)
    columns: list[Any] = [arrays.get(name) for name in FIELDS[1:]]
    return replace(LoggedScan(found.pose, arrays["points"], *columns), time_s=found.time_s)


def compact(points: NDArray[np.float64]) -> NDArray[Any]:
    """The same numbers in half of the memory, if float32 holds all their bits."""
    small = points.astype(np.float32)
    return small if (small == points).all() else points
