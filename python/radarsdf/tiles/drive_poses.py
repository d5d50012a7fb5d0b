# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses that were refined or found for a plan. They are kept in its folder, so that a call after a crash has the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from radarsdf.checks import check_poses
from radarsdf.config.fit_config import FitConfig, settings_of_results
from radarsdf.io.imu import Imu
from radarsdf.io.npz import arrays_of, write_arrays
from radarsdf.io.poses import write_poses
from radarsdf.io.scans import Scan
from radarsdf.map.storage import checked_report
from radarsdf.poses.posed import Posed
from radarsdf.poses.windows import find_in_windows, refine_in_windows
from radarsdf.tiles.planning import InputDigest

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


class _OncePassed:
    """The scans of a drive in one pass, after which they have a key."""

    def __init__(self, drive: DriveToPose) -> None:
        self._drive, self._digest = drive, InputDigest()
        self.times_s: list[float | None] = []

    def __iter__(self) -> Iterator[Scan]:
        for scan in self._drive.scans:
            self._digest.add(scan)
            self.times_s.append(scan.time_s)
            yield scan

    def key(self, config: FitConfig) -> str:
        """A digest of all that the poses follow from."""
        imu = None
        if self._drive.find and self._drive.imu is not None:
            arrays = vars(self._drive.imu)
            imu = {name: None if array is None else array.tolist() for name, array in arrays.items()}
        given = [self._digest.hex(), self.times_s, imu, settings_of_results(config), self._drive.find]
        text = json.dumps(given, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True)
class DrivePoses:
    """The poses of a plan, where they are not those of its scans."""

    posed: Posed
    key: str
    """Of the scans as given, the settings, and whether poses were refined or found."""

    @classmethod
    def of(cls, drive: DriveToPose, config: FitConfig, folder: Path, progress: bool | None) -> DrivePoses:
        """Those in the folder, if they are of the same scans and settings. Else they are made, and written there."""
        known = cls.load(folder)
        if known is not None and known.digest(drive, config):
            return known
        scans = _OncePassed(drive)
        if drive.find:
            posed = Posed.found(find_in_windows(scans, drive.imu, config, progress))
        else:
            posed = Posed.refined(*refine_in_windows(scans, config, progress))
        made = cls(posed, scans.key(config))
        made._save(folder, scans.times_s[posed.rows])
        return made

    def digest(self, drive: DriveToPose, config: FitConfig) -> str:
        """Of the scans with these poses, in one pass. Empty if the poses are of another drive or of other settings."""
        scans = _OncePassed(drive)
        digest = InputDigest.of(self.scans(scans))
        return digest if scans.key(config) == self.key else ""

    def scans(self, given: Iterable[Scan]) -> Iterator[Scan]:
        """The scans with these poses, without those that have none."""
        rows, poses = self.posed.rows, self.posed.poses
        for number, scan in enumerate(given):
            if rows.start <= number < rows.stop:
                yield replace(scan, T_world_sensor=poses[number - rows.start])

    def _save(self, folder: Path, times_s: list[float | None]) -> None:
        """Writes the poses, and a trajectory for other programs; without times, the numbers of the scans are times."""
        posed = self.posed
        known = [time_s for time_s in times_s if time_s is not None]
        stamps = known if len(known) == len(times_s) else list(range(posed.rows.start, posed.rows.stop))
        write_poses(folder / TRAJECTORY, posed.poses, stamps)
        described = {
            "format": _FORMAT,
            "format_version": _VERSION,
            "key": self.key,
            "rows": [posed.rows.start, posed.rows.stop],
            "pieces": posed.pieces,
            "sigmas": posed.sigmas,
            "way": posed.way,
            "notes": posed.notes,
        }
        text = np.frombuffer(json.dumps(described, allow_nan=False).encode(), np.uint8)
        write_arrays(folder / POSES, {"poses": posed.poses, "described": text})

    @classmethod
    def load(cls, folder: Path) -> DrivePoses | None:
        """Those in the folder of a plan. None: its poses are those of the scans. Raises a ValueError if the file is damaged."""
        path = folder / POSES
        if not path.exists():
            return None
        try:
            arrays = arrays_of(path, ("poses", "described"))
            poses, described = check_poses(arrays["poses"]), json.loads(arrays["described"].tobytes())
            if (described["format"], described["format_version"]) != (_FORMAT, _VERSION):
                msg = f"it is not of format {_FORMAT}, version {_VERSION}"
                raise ValueError(msg)
            posed = Posed(
                poses,
                slice(described["rows"][0], described["rows"][1]),
                pieces=described["pieces"],
                way=checked_report({"poses": described["way"]})["poses"],
                sigmas=None if described["sigmas"] is None else tuple(described["sigmas"]),
                notes=tuple(described["notes"]),
            )
            return cls(posed, described["key"])
        except Exception as error:  # damaged files raise exceptions of many kinds
            msg = f"{path} does not hold the poses of a plan: {error}"
            raise ValueError(msg) from error
