# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses that were refined or found for a plan. They are kept in its folder, so that a call after a crash has the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import check_poses
from radarsdf.config.fit_config import FitConfig, settings_of_results
from radarsdf.io.imu import Imu
from radarsdf.io.npz import arrays_of, write_arrays
from radarsdf.io.poses.files import write_poses
from radarsdf.io.scans import Scan
from radarsdf.map.storage import checked_report
from radarsdf.poses.posed import Posed
from radarsdf.poses.windows import find_in_windows, refine_in_windows
from radarsdf.tiles.input_digest import InputDigest
from radarsdf.tiles.plan import within

POSES = "poses.npz"
TRAJECTORY = "poses.tum"
_FORMAT, _VERSION = "radarsdf.tiles.poses", 1


@dataclass(frozen=True)
class DriveToPose:
    """Scans whose poses are refined or found. They are read more than once."""

    scans: Iterable[Scan]
    imu: Imu | None
    find: bool
    """Whether their own poses are not used."""


class _Seen:
    """The scans of a drive, once. What has been seen is known by its key."""

    def __init__(self, drive: DriveToPose) -> None:
        self._drive, self._digest = drive, InputDigest()
        self.times_s: list[float | None] = []

    def __iter__(self) -> Iterator[Scan]:
        for scan in self._drive.scans:
            self._digest.add(scan)
            self.times_s.append(scan.time_s)
            yield scan

    def key(self, config: FitConfig) -> str:
        """Of all that the poses follow from."""
        imu = None
        if self._drive.find and self._drive.imu is not None:
            imu = {
                name: None if array is None else array.tolist()
                for name, array in vars(self._drive.imu).items()
            }
        text = json.dumps(
            [self._digest.hex(), self.times_s, imu, settings_of_results(config), self._drive.find],
            sort_keys=True,
        )
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True)
class DrivePoses:
    """The poses of a plan, where they are not those of its scans."""

    posed: Posed
    key: str
    """Of the scans as given, the settings, and whether poses were refined or found."""

    @classmethod
    def of(cls, drive: DriveToPose, config: FitConfig, folder: Path, progress: bool | None) -> DrivePoses:
        """Those in the folder, if they are of the same scans and settings. Else they are made, and written there.

        Raises
        ------
        ValueError
            If a scan is invalid, or poses cannot be found.
        OSError
            If the folder cannot be written.
        """
        known = cls.load(folder)
        if known is not None and known.digest(drive, config):
            return known
        seen = _Seen(drive)
        if drive.find:
            posed = Posed.found(find_in_windows(seen, drive.imu, config, progress))
        else:
            posed = Posed.refined(*refine_in_windows(seen, config, progress))
        made = cls(posed, seen.key(config))
        made.save(folder, seen.times_s[posed.rows])
        return made

    def digest(self, drive: DriveToPose, config: FitConfig) -> str:
        """Of the scans with these poses. Empty if they are not those of this drive with these settings; it is read once."""
        seen = _Seen(drive)
        digest = InputDigest.of(self.scans(seen))
        return digest if seen.key(config) == self.key else ""

    def scans(self, given: Iterable[Scan]) -> Iterator[Scan]:
        """The scans with these poses, without those that have none."""
        rows, poses = self.posed.rows, self.posed.poses
        for number, scan in enumerate(given):
            if rows.start <= number < rows.stop:
                yield replace(scan, T_world_sensor=poses[number - rows.start])

    def save(self, folder: Path, times_s: list[float | None]) -> None:
        """Writes the poses, and a trajectory for people and other programs; without times, the numbers of the scans are times."""
        rows = self.posed.rows
        known = [time_s for time_s in times_s if time_s is not None]
        stamps = known if len(known) == len(times_s) else list(range(rows.start, rows.stop))
        write_poses(within(folder, folder / TRAJECTORY), self.posed.poses, stamps)
        described = {
            "format": _FORMAT,
            "format_version": _VERSION,
            "key": self.key,
            "rows": [rows.start, rows.stop],
            "pieces": self.posed.pieces,
            "sigmas": self.posed.sigmas,
            "way": self.posed.way,
            "notes": self.posed.notes,
        }
        text = np.frombuffer(json.dumps(described, allow_nan=False).encode(), np.uint8)
        write_arrays(within(folder, folder / POSES), {"poses": self.posed.poses, "described": text})

    @classmethod
    def load(cls, folder: Path) -> DrivePoses | None:
        """Those in the folder of a plan. None: its poses are those of the scans.

        Raises
        ------
        ValueError
            If the file is damaged.
        OSError
            If it cannot be read.
        """
        path = within(folder, folder / POSES)
        if not path.exists():
            return None
        try:
            arrays = arrays_of(path, ("poses", "described"))
            poses, described = arrays["poses"], json.loads(arrays["described"].tobytes())
            return cls(_posed(check_poses(poses), described), str(described["key"]))
        except Exception as error:  # damaged files raise exceptions of many kinds
            msg = f"{path} does not hold the poses of a plan: {error}"
            raise ValueError(msg) from error


def _posed(poses: NDArray[np.float64], described: dict[str, Any]) -> Posed:
    if (described["format"], described["format_version"]) != (_FORMAT, _VERSION):
        msg = f"it is not of format {_FORMAT}, version {_VERSION}"
        raise ValueError(msg)
    first, stop = (int(number) for number in described["rows"])
    if not 0 <= first < stop or stop - first != len(poses):
        msg = "its parts do not fit together"
        raise ValueError(msg)
    sigmas = described["sigmas"]
    known = None if sigmas is None else (float(sigmas[0]), float(sigmas[1]))
    way = checked_report({"poses": described["way"]})["poses"]
    notes = tuple(str(note) for note in described["notes"])
    return Posed(poses, slice(first, stop), None, int(described["pieces"]), way, known, notes)
