# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans with poses: one after another from files of any size, or all in memory."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import MISSING_POSES, one_for_each_scan
from radarsdf.io.imu import Imu

_LOG = logging.getLogger("radarsdf.io")
_Value = TypeVar("_Value")

TruthKind: TypeAlias = Literal["lidar", "simulated", "given"]
"""Where ground truth comes from: the lidar of a recording, a simulator, or the user."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan of N returns, with its pose."""

    points: NDArray[Any]
    """(N, 3) sensor frame, m."""
    T_world_sensor: NDArray[np.float64]
    """(4, 4) m."""
    intensities: NDArray[Any] | None = None
    """(N,) sensor units. None if the sensor does not measure them."""
    doppler_mps: NDArray[Any] | None = None
    """(N,) radial velocity as the sensor gives it, m/s; most give negative values for what comes nearer. NaN where it
    was not measured."""
    time_s: float | None = None
    """When the scan was taken, s, by the clock of the file."""
    sigma: NDArray[Any] | None = None
    """(N, 3) the sensor's own standard deviations of range, azimuth and elevation of each return: m, rad, rad."""

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.points)

    @property
    def world_points(self) -> NDArray[np.float64]:
        """(N, 3) float64, world frame, m."""
        R, t = self.T_world_sensor[:3, :3], self.T_world_sensor[:3, 3]
        world: NDArray[np.float64] = np.asarray(self.points, np.float64) @ R.T + t
        return world


class Notes:
    """Sentences on what was assumed or left out. Each is logged once, as a warning of the logger ``radarsdf.io``.

    Parameters
    ----------
    about : str
        What is read, for errors.
    """

    def __init__(self, about: str = "the scans") -> None:
        self.about = about
        self.lines: list[str] = []
        self._counts: dict[str, int] = {}
        self._first: dict[str, str] = {}

    def add(self, line: str) -> None:
        """Keep a sentence, and log it if it is new."""
        if line not in self.lines:
            self.lines.append(line)
            _LOG.warning(line)

    def ending(self) -> str:
        """All sentences, to end an error with."""
        return "".join(f"; {line}" for line in self.lines)

    def start_counts(self) -> None:
        """Forget the counts: the files are read again."""
        self._counts = {}

    def count(self, what: str, number: int, example: str = "") -> None:
        """Add to the count of what was left out, of which the first example is said."""
        if number:
            self._first.setdefault(what, f"; the first: {example}" if example else "")
            self._counts[what] = self._counts.get(what, 0) + number

    def counted(self) -> None:
        """Turn the counts into sentences, in the end of a pass through the files."""
        for what, number in self._counts.items():
            self.add(f"{number} {what}{self._first[what]}")


class Scans:
    """F scans with poses, and lidar points as ground truth where there are any.

    Iterating gives one :class:`Scan` after another, as often as wanted. Scans of :func:`radarsdf.io.read` are read from
    their files while they are iterated, so that memory is bounded by a scan; `points`, `intensities`, `doppler_mps` and
    `sigmas` read all of them and keep them. `poses`, `times_s` and ``len()`` read the files once, if nobody did so
    before, and keep no points.

    Parameters
    ----------
    points : sequence of F arrays
        (N_i, 3) each, sensor frame, m.
    poses : (F, 4, 4) ndarray
        T_world_sensor, m.
    intensities : sequence of F arrays, optional
        (N_i,) each, sensor units. None if the sensor does not measure them.
    ground_truth : (M, 3) ndarray, optional
        Lidar points, world frame, m.
    doppler_mps, sigmas : sequence of F arrays, optional
        As `Scan.doppler_mps` and `Scan.sigma`.
    times_s : (F,) ndarray, optional
        When the scans were taken, s.
    truth_kind : {"lidar", "simulated", "given"}
        Where the ground truth comes from.
    imu : Imu, optional
        What an IMU measured meanwhile.
    """

    def __init__(
        self,
        points: Sequence[NDArray[Any]],
        poses: NDArray[np.float64],
        intensities: Sequence[NDArray[Any]] | None = None,
        ground_truth: NDArray[Any] | None = None,
        *,
        doppler_mps: Sequence[NDArray[Any]] | None = None,
        times_s: NDArray[np.float64] | None = None,
        sigmas: Sequence[NDArray[Any]] | None = None,
        truth_kind: TruthKind = "lidar",
        imu: Imu | None = None,
    ) -> None:
        self._source: Callable[[], Iterator[Scan]] | None = None
        self._notes = Notes()
        self._points: list[NDArray[Any]] | None = list(one_for_each_scan(points, "points"))
        self._poses: NDArray[np.float64] | None = poses
        self._intensities = _listed(intensities, "intensities")
        self._doppler_mps = _listed(doppler_mps, "doppler_mps")
        self._sigmas = _listed(sigmas, "sigmas")
        self._times_s = times_s
        self._ground_truth: Callable[[], NDArray[Any] | None] = lambda: ground_truth
        self._truth_known = False
        self.truth_kind: TruthKind = truth_kind
        """Where the ground truth comes from."""
        self._truth: NDArray[Any] | None = None
        self._read_imu: Callable[[], Imu | None] | None = None
        self._imu = imu

    @classmethod
    def of_source(
        cls,
        source: Callable[[], Iterator[Scan]],
        notes: Notes,
        ground_truth: Callable[[], NDArray[Any] | None] = lambda: None,
        imu: Callable[[], Imu | None] | None = None,
    ) -> Scans:
        """Scans that are read while they are iterated.

        Parameters
        ----------
        source : callable
            Gives a new iterator over the scans, which have at least one return each.
        notes : Notes
            What the source says of its files.
        ground_truth : callable
            Reads the ground truth, when it is asked for.
        imu : callable, optional
            Likewise, what the IMU measured.
        """
        scans = cls([], np.zeros((0, 4, 4)))
        scans._source = source
        scans._notes = notes
        scans._points = scans._poses = None
        scans._ground_truth = ground_truth
        scans._read_imu = imu
        return scans

    def __iter__(self) -> Iterator[Scan]:
        """One scan after another."""
        if self._points is None:
            return self._read()
        return (self._scan(i) for i in range(len(self._points)))

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.poses)

    def __repr__(self) -> str:
        """What is known without reading files."""
        known = f"{len(self._poses)} scans" if self._poses is not None else "scans that are not yet read"
        return f"<Scans: {known}>"

    @property
    def points(self) -> list[NDArray[Any]]:
        """F arrays (N_i, 3), sensor frame, m."""
        self._load()
        assert self._points is not None
        return self._points

    @property
    def poses(self) -> NDArray[np.float64]:
        """(F, 4, 4) T_world_sensor, m."""
        self._read_once()
        if self._poses is None:
            raise ValueError(MISSING_POSES)
        return self._poses

    @property
    def intensities(self) -> list[NDArray[Any]] | None:
        """F arrays (N_i,), sensor units. None if the sensor does not measure them."""
        self._load()
        return self._intensities

    @property
    def doppler_mps(self) -> list[NDArray[Any]] | None:
        """F arrays (N_i,), m/s: see `Scan.doppler_mps`. None if there is none."""
        self._load()
        return self._doppler_mps

    @property
    def sigmas(self) -> list[NDArray[Any]] | None:
        """F arrays (N_i, 3), m, rad, rad: see `Scan.sigma`. None if there are none."""
        self._load()
        return self._sigmas

    @property
    def times_s(self) -> NDArray[np.float64] | None:
        """(F,) when the scans were taken, s. None if that is not known."""
        self._read_once()
        return self._times_s

    @property
    def ground_truth(self) -> NDArray[Any] | None:
        """(M, 3) lidar points, world frame, m. None if there are none."""
        if not self._truth_known:
            self._truth, self._truth_known = self._ground_truth(), True
        return self._truth

    @property
    def imu(self) -> Imu | None:
        """What an inertial measurement unit measured meanwhile. None if there is none."""
        if self._read_imu is not None:
            self._imu, self._read_imu = self._read_imu(), None
        return self._imu

    @property
    def notes(self) -> list[str]:
        """Sentences on what was assumed, and after the files were read, on what was left out."""
        return list(self._notes.lines)

    def select(self, frames: NDArray[np.int64]) -> Scans:
        """The scans with the numbers `frames`, (K,), in this order. All scans are read."""
        return Scans(
            [self.points[i] for i in frames],
            self.poses[frames],
            chosen(self.intensities, frames),
            self.ground_truth,
            doppler_mps=chosen(self.doppler_mps, frames),
            times_s=None if self.times_s is None else self.times_s[frames],
            sigmas=chosen(self.sigmas, frames),
            truth_kind=self.truth_kind,
            imu=self.imu,
        )

    def select_range(self, rows: slice) -> Scans:
        """The scans of a range of numbers. All scans are read."""
        return self.select(np.arange(len(self.points))[rows])

    def with_poses(self, poses: NDArray[np.float64], *, other_world: bool = False) -> Scans:
        """The same scans with other poses (F, 4, 4) T_world_sensor, m. All scans are read.

        `other_world`: the poses are not in the world of the ground truth, which is then left out.
        """
        return Scans(
            self.points,
            poses,
            self.intensities,
            None if other_world else self.ground_truth,
            doppler_mps=self.doppler_mps,
            times_s=self.times_s,
            sigmas=self.sigmas,
            truth_kind=self.truth_kind,
            imu=self.imu,
        )

    def _scan(self, i: int) -> Scan:
        assert self._points is not None
        return Scan(
            self._points[i],
            self.poses[i],
            None if self._intensities is None else self._intensities[i],
            None if self._doppler_mps is None else self._doppler_mps[i],
            None if self._times_s is None else float(self._times_s[i]),
            None if self._sigmas is None else self._sigmas[i],
        )

    def _read(self) -> Iterator[Scan]:
        """Reads the files, and keeps what is small once they are read to the end."""
        assert self._source is not None
        poses: list[NDArray[np.float64]] = []
        times_s: list[float | None] = []
        self._notes.start_counts()
        for scan in self._source():
            poses.append(scan.T_world_sensor)
            times_s.append(scan.time_s)
            yield scan
        self._notes.counted()
        if not poses:
            msg = f"{self._notes.about}: there is no scan with a return and a pose{self._notes.ending()}"
            raise ValueError(msg)
        self._poses = np.stack(poses)
        self._times_s = None if None in times_s else np.array(times_s, np.float64)

    def _read_once(self) -> None:
        """Reads the files, if there are any and nobody did: poses and times are kept."""
        if self._poses is None and self._source is not None:
            for _ in self._read():
                pass

    def _load(self) -> None:
        """Reads all scans, and keeps them."""
        if self._points is not None:
            return
        scans = list(self._read())
        self._intensities = _all_or_none([scan.intensities for scan in scans])
        self._doppler_mps = _all_or_none([scan.doppler_mps for scan in scans])
        self._sigmas = _all_or_none([scan.sigma for scan in scans])
        self._points = [scan.points for scan in scans]


def scans_in_memory(scans: Sequence[Scan], imu: Imu | None = None) -> Scans:
    """Scans one after another as one, with what all of them have."""
    times_s = _all_or_none([scan.time_s for scan in scans])
    return Scans(
        [scan.points for scan in scans],
        np.stack([np.asarray(scan.T_world_sensor, np.float64) for scan in scans]),
        _all_or_none([scan.intensities for scan in scans]),
        doppler_mps=_all_or_none([scan.doppler_mps for scan in scans]),
        times_s=None if times_s is None else np.array(times_s, np.float64),
        sigmas=_all_or_none([scan.sigma for scan in scans]),
        imu=imu,
    )


def filled(points: Any, **given: Any) -> tuple[Any, ...]:
    """The points, and the `given` arrays, named as in :class:`Scans`. If points are `Scans`, what is None is theirs."""
    if not isinstance(points, Scans):
        return points, *given.values()
    arrays = points.points  # first: it reads all there is, in one pass
    return arrays, *(getattr(points, name) if values is None else values for name, values in given.items())


def chosen(arrays: list[NDArray[Any]] | None, numbers: NDArray[np.int64]) -> list[NDArray[Any]] | None:
    """Those of these `numbers`, (K,), in this order, if there are arrays."""
    return None if arrays is None else [arrays[i] for i in numbers]


def _listed(arrays: Sequence[NDArray[Any]] | None, name: str) -> list[NDArray[Any]] | None:
    return None if arrays is None else list(one_for_each_scan(arrays, name))


def _all_or_none(values: list[_Value | None]) -> list[_Value] | None:
    given = [value for value in values if value is not None]
    return given if given and len(given) == len(values) else None
