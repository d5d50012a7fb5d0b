"""Scans with poses, streamed from files of any size or held in memory."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache
from itertools import repeat
from typing import Any, TypeAlias, TypeVar

import numpy as np

from radarsdf.arrays import Array, ArrayLike, Bools, Floats, Ints
from radarsdf.checks import MISSING_POSES, check, one_for_each_scan, pose_matrices
from radarsdf.rig import Imu, Label, Rig

_LOG = logging.getLogger("radarsdf.io")
_Value = TypeVar("_Value")

# Arrays of each scan: names in `Scans`, and in `Scan`.
_ARRAYS = {"points": "points", "intensities": "intensities", "doppler_mps": "doppler_mps", "sigmas": "sigma"}

Columns: TypeAlias = dict[str, Array]  # (N,) each, by name


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan of N returns, with its pose."""

    points: Array
    """(N, 3) sensor frame, m."""
    T_world_sensor: Floats
    """(4, 4) m."""
    intensities: Array | None = None
    """(N,) sensor units. None if the sensor does not measure them."""
    doppler_mps: Array | None = None
    """(N,) radial velocity as output by the sensor, m/s, by most negative for approaching returns; NaN where not measured."""
    time_s: float | None = None
    """Time of the scan, s, by the clock of the file."""
    sigma: Array | None = None
    """(N, 3) the sensor's own standard deviations of range, azimuth and elevation of each return: m, rad, rad."""
    sensor: Label | None = None
    """Label of its radar, if there are several."""

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.points)

    @property
    def world_points(self) -> Floats:
        """(N, 3) float64, world frame, m."""
        R, t = self.T_world_sensor[:3, :3], self.T_world_sensor[:3, 3]
        return np.asarray(self.points, np.float64) @ R.T + t


def with_returns(scan: Scan, kept: Bools) -> Scan:
    """Keep the returns in a mask (N,)."""
    arrays: dict[str, Any] = {name: getattr(scan, name) for name in _ARRAYS.values()}
    return replace(scan, **{name: array[kept] for name, array in arrays.items() if array is not None})


class Notes:
    """Sentences on assumptions and omissions, each logged once as a warning of the logger ``radarsdf.io``."""

    def __init__(self, about: str = "the scans", *, logged: bool = True) -> None:
        self.about, self._logged = about, logged  # `about`: what is read, for messages
        self.lines: list[str] = []
        self._counts: dict[str, tuple[int, str]] = {}

    def add(self, line: str) -> None:
        if line not in self.lines:
            self.lines.append(line)
            if self._logged:
                _LOG.warning(line)

    def ending(self) -> str:
        """All sentences, to append to an error."""
        return "".join(f"; {line}" for line in self.lines)

    def count(self, what: str, number: int = 1, example: str = "") -> None:
        """Count omissions in this pass through the files, and keep the first example."""
        if number:
            known, first = self._counts.get(what, (0, f"; the first: {example}" if example else ""))
            self._counts[what] = known + number, first

    def start_pass(self) -> None:
        self._counts = {}

    def end_pass(self) -> None:
        """Turn the counts into sentences."""
        for what, (number, first) in self._counts.items():
            self.add(f"{number} {what}{first}")


class Scans:
    """F scans with poses, and optionally lidar points as ground truth.

    Iteration yields one :class:`Scan` after another. Scans of :func:`radarsdf.io.read` are read from their files while they
    are iterated, so memory is bounded by one scan; `points`, `intensities`, `doppler_mps` and `sigmas` read and cache all.
    `poses`, `times_s` and ``len()`` read the files once, and keep no points. Arguments of the constructor match the properties.

    Scans of several radars have `sensors`, a label each. With their mountings, `T_body_sensor`, poses are those of the body.
    """

    def __init__(
        self,
        points: Sequence[Array],
        poses: Floats,
        intensities: Sequence[Array] | None = None,
        ground_truth: Array | None = None,
        *,
        doppler_mps: Sequence[Array] | None = None,
        times_s: Floats | None = None,
        sigmas: Sequence[Array] | None = None,
        imu: Imu | None = None,
        sensors: Sequence[Label] | None = None,
        T_body_sensor: Mapping[Any, ArrayLike] | None = None,
    ) -> None:
        self._rig = Rig.of(sensors, T_body_sensor)
        self._arrays: dict[str, list[Array] | None] | None = {
            name: None if arrays is None else list(one_for_each_scan(arrays, name))
            for name, arrays in zip(_ARRAYS, (points, intensities, doppler_mps, sigmas), strict=True)
        }
        self._poses: Floats | None = poses
        self._times_s = times_s
        self._source: Callable[[], Iterator[Scan]] | None = None
        self._notes = Notes()
        self._ground_truth: Callable[[], Array | None] = lambda: ground_truth
        self._imu: Callable[[], Imu | None] = lambda: imu
        self._mountings: Callable[[], Mapping[Any, ArrayLike] | None] = lambda: T_body_sensor

    @classmethod
    def of_source(
        cls,
        source: Callable[[], Iterator[Scan]],
        notes: Notes,
        ground_truth: Callable[[], Array | None] = lambda: None,
        imu: Callable[[], Imu | None] = lambda: None,
        mountings: Callable[[], Mapping[Any, ArrayLike] | None] = lambda: None,
    ) -> "Scans":
        """Build scans that are read lazily during iteration.

        `source` returns a new iterator over them, each with at least one return, and `notes` receive its assumptions. The
        ground truth, the IMU and the `mountings` T_body_sensor of radars by label are read once, on first access.
        """
        scans = cls([], np.zeros((0, 4, 4)))
        scans._source, scans._notes = source, notes
        scans._arrays = scans._poses = None
        scans._ground_truth, scans._imu, scans._mountings = cache(ground_truth), cache(imu), mountings
        return scans

    def __iter__(self) -> Iterator[Scan]:
        if self._arrays is None:
            return self._read()
        points, intensities, doppler_mps, sigmas = self._arrays.values()
        times_s = None if self._times_s is None else map(float, self._times_s)
        of_radars = intensities, doppler_mps, times_s, sigmas, self.sensors
        columns = map(np.asarray, points or ()), self.sensor_poses, *of_radars
        return map(Scan, *(repeat(None) if column is None else column for column in columns))

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.poses)

    @property
    def points(self) -> list[Array]:
        """F arrays (N_i, 3), sensor frame, m."""
        return self._loaded()["points"] or []

    @property
    def poses(self) -> Floats:
        """(F, 4, 4) T_world_sensor, m; T_world_body if mountings are known."""
        self._read_once()
        if self._poses is None:
            raise ValueError(MISSING_POSES)
        return self._poses

    @property
    def sensor_poses(self) -> Floats:
        """(F, 4, 4) T_world_sensor, m, of the radar of each scan."""
        return self.poses if self.rig is None else self.rig.sensor_poses(pose_matrices(self.poses))

    @property
    def rig(self) -> Rig | None:
        """Radars of the scans; None if there is one."""
        self._read_once()
        return self._rig

    @property
    def sensors(self) -> list[Label] | None:
        """F labels of the radars of the scans; None if there is one radar."""
        return None if self.rig is None else [self.rig.labels[i] for i in self.rig.of_scan]

    @property
    def T_body_sensor(self) -> dict[Label, Floats] | None:
        """Mounting (4, 4) of each radar by its label, m; None if unknown."""
        known = None if self.rig is None else self.rig.T_body_sensor
        return None if self.rig is None or known is None else dict(zip(self.rig.labels, known, strict=True))

    @property
    def intensities(self) -> list[Array] | None:
        """F arrays (N_i,), sensor units. None if the sensor does not measure them."""
        return self._loaded()["intensities"]

    @property
    def doppler_mps(self) -> list[Array] | None:
        """F arrays (N_i,), m/s, see `Scan.doppler_mps`; None if not measured."""
        return self._loaded()["doppler_mps"]

    @property
    def sigmas(self) -> list[Array] | None:
        """F arrays (N_i, 3), m, rad, rad, see `Scan.sigma`, NaN where unknown; None if not available."""
        return self._loaded()["sigmas"]

    @property
    def times_s(self) -> Floats | None:
        """(F,) times of the scans, s; None if unknown."""
        self._read_once()
        return self._times_s

    @property
    def ground_truth(self) -> Array | None:
        """(M, 3) lidar points, world frame, m; None if there are none."""
        return self._ground_truth()

    @property
    def imu(self) -> Imu | None:
        """IMU data of the recording; None if there are none."""
        return self._imu()

    @property
    def notes(self) -> list[str]:
        """Sentences on assumptions and, after a complete pass, on omissions."""
        return list(self._notes.lines)

    def select(self, frames: Ints | Sequence[int]) -> "Scans":
        """Select K scans by their indices `frames` (K,), in this order. All scans are read.

        Negative indices count from the end. Ground truth and IMU stay the same. Raises an IndexError if one is out of range.
        """
        arrays = {name: chosen(values, frames) for name, values in self._loaded().items()}
        scans = self.with_poses(None if self._poses is None else self._poses[frames])
        scans._arrays = arrays
        scans._times_s = None if self._times_s is None else self._times_s[frames]
        scans._rig = None if self._rig is None else self._rig.select(frames)
        return scans

    def with_poses(self, poses: Floats | None, *, other_world: bool = False) -> "Scans":
        """Return the same scans with other `poses` (F, 4, 4) float64, m. All scans are read.

        `other_world`: whether these are in another world frame than the ground truth, which is then dropped.
        """
        self._loaded()
        scans = copy(self)
        scans._poses, scans._notes = poses, Notes()
        if other_world:
            scans._ground_truth = lambda: None
        return scans

    def with_ground_truth(self, points: Callable[[], Array | None]) -> "Scans":
        """Replace the lidar points (M, 3), world frame, m, by those that `points` returns on first access."""
        scans = copy(self)
        scans._ground_truth = cache(points)
        return scans

    def _read(self) -> Iterator[Scan]:
        """Read the files, and keep poses and times of a complete pass."""
        assert self._source is not None
        found: list[tuple[Floats, float | None, Label | None]] = []
        self._notes.start_pass()
        for scan in self._source():
            found.append((scan.T_world_sensor, scan.time_s, scan.sensor))
            yield scan
        self._notes.end_pass()
        check(found, f"{self._notes.about}: there is no scan with a return and a pose{self._notes.ending()}")
        poses, times_s, sensors = zip(*found, strict=True)
        self._rig = None if None in sensors else Rig.of(sensors, self._mountings())
        self._poses = np.stack(poses)
        if self._rig is not None:  # of the body
            self._poses = np.einsum("fij,fjk->fik", self._poses, np.linalg.inv(self._rig.mountings))
        self._times_s = None if None in times_s else np.array(times_s, np.float64)

    def _read_once(self) -> None:
        if self._poses is None and self._source is not None:
            for _ in self._read():
                pass

    def _loaded(self) -> dict[str, list[Array] | None]:
        if self._arrays is None:
            self._arrays = _arrays_of(list(self._read()))
        return self._arrays


def scans_in_memory(scans: Sequence[Scan]) -> Scans:
    """Collect scans, with the arrays that all of them have. Their poses are T_world_sensor."""
    times_s = all_or_none([scan.time_s for scan in scans])
    return Scans(
        poses=np.stack([np.asarray(scan.T_world_sensor, np.float64) for scan in scans]),
        times_s=None if times_s is None else np.array(times_s, np.float64),
        sensors=all_or_none([scan.sensor for scan in scans]),
        **_arrays_of(scans),
    )


def filled(points: Any, **given: Any) -> tuple[Any, ...]:
    """Return the rig, the scans and the values `given` by names of :class:`Scans`, if `points` are those; else no rig.

    Missing values are those of the `Scans`. Raises a ValueError if poses are missing.
    """
    rig = None
    if isinstance(points, Scans):
        scans, points = points, points.points  # reads everything in one pass
        rig = scans.rig
        given = {name: getattr(scans, name) if values is None else values for name, values in given.items()}
    check(given.get("poses", points) is not None, MISSING_POSES)
    return rig, points, *given.values()


def chosen(arrays: Sequence[Any] | None, numbers: Ints | Sequence[int]) -> list[Any] | None:
    """Arrays at these `numbers`, (K,), in this order; None for no arrays."""
    return None if arrays is None else [arrays[i] for i in numbers]


def _arrays_of(scans: Sequence[Scan]) -> dict[str, Any]:
    """Collect arrays by their names in :class:`Scans`: one per scan, or None where a scan has none."""
    arrays = {name: all_or_none([getattr(scan, own) for scan in scans]) for name, own in _ARRAYS.items()}
    return arrays | {"sigmas": all_or_nan([scan.sigma for scan in scans], [scan.points for scan in scans])}


def all_or_nan(sigmas: Sequence[Array | None], points: Sequence[Array]) -> list[Array] | None:
    """Return stated deviations (N_i, 3) of scans `points` (N_i, 3), NaN where unknown: not all radars state them. None if none does."""
    if all(own is None for own in sigmas):
        return None
    each = zip(sigmas, points, strict=True)
    return [np.full((len(scan), 3), np.float32(np.nan)) if own is None else own for own, scan in each]


def all_or_none(values: list[_Value | None]) -> list[_Value] | None:
    given = [value for value in values if value is not None]
    return given if given and len(given) == len(values) else None
