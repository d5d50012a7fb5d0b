"""Validation of radar scans and their conversion to rays in one local frame."""

import functools
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from radarsdf import checks
from radarsdf.arrays import Array, ArrayLike, Bools, Floats, Floats32, Ints, Ints32, Keys, NDArray
from radarsdf.core import hash_rays, scan_rays
from radarsdf.lattice import WorldLattice
from radarsdf.returns.intensities import Plausible
from radarsdf.rig import Rig

_LOG = logging.getLogger("radarsdf.returns")
_COLUMNS = ("points", "directions", "ranges_m", "intensities", "scans", "stated")
_PADDING = 8  # minimum number of repeated rows. Sensors with coarse cells repeat some

# At equal received power the radar cross section grows with the fourth power of the range: a return at 100 times the median
# range needs 80 dB more than the median one. Birds have about -30 dBsm, ships and buildings at most about 50 dBsm.
_MOST_RATIO = 100.0
_MOST_STATED = 8.0  # times the median, or the median times this: weights are multiples of 1 / 64
_IN_FLOAT32 = functools.partial(checks.real_array, dtype=np.float32)
_SAME_SQUARE = 1e-6  # relative difference of squares of ranges that are equal but for float32


@dataclass(frozen=True)
class Rays:
    """All returns of a fit, in the local frame: world axes, with `origin` subtracted.

    float32 resolves 0.06 mm at 500 m, but only 0.5 m at UTM coordinates, hence the local frame. Arrays are in C order.
    """

    origin: Floats
    """(3,) origin of the local frame in world coordinates, m: by default the mean sensor position."""
    points: Floats32  # (N, 3) returns, m
    directions: Floats32  # (N, 3) unit vectors from the sensor to the return
    ranges_m: Floats32  # (N,) distance of the return from the sensor
    intensities: Floats32 | None
    """(N,) sensor units; NaN where missing or an outlier. None without intensities."""
    scans: Ints32  # (N,) scan of each return
    up_of_scan: Floats  # (F, 3) z axis of the sensor in each scan, local frame
    num_given: int  # number of returns in the scans, including those out of range
    # (F,) row of the radar of each scan in its :class:`Rig`. None: there is one
    sensor_of_scan: Ints32 | None = None
    num_sensors: int = 1
    # (N, 3) deviations of range, azimuth and elevation that the sensor states, divided by their medians; m, rad, rad before
    # :meth:`with_relative_deviations`. None: it states none
    stated: Floats32 | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def with_intensity(self) -> Bools:
        """Mask (N,) of the returns with an intensity that is not an outlier."""
        return np.zeros(len(self), np.bool_) if self.intensities is None else ~np.isnan(self.intensities)

    def rows_of_sensors(self) -> list[slice | Ints]:
        if self.sensor_of_scan is None:
            return [slice(None)]
        sensors = self.sensor_of_scan.take(self.scans)
        return [np.flatnonzero(sensors == i) for i in range(self.num_sensors)]

    def hashes(self) -> Keys:
        """Return keys (N,) for samples that do not depend on the order of scans, nor on the origin."""
        return hash_rays(self.directions, self.ranges_m, self.intensities)

    def without_outliers(self) -> "Rays":
        if self.intensities is None:
            return self
        kept, keys = self.intensities.copy(), self.hashes()
        for own in self.rows_of_sensors():  # each radar has its own unit
            kept[own] = Plausible.of(kept[own], keys[own]).kept(kept[own])
        return replace(self, intensities=kept)

    def with_relative_deviations(self, medians: Sequence[Array] | None = None) -> "Rays":
        """Divide stated deviations by the `medians` (3,) of each radar; None: of its rays. Where one is unknown, the ratio is 1."""
        if self.stated is None:
            return self
        stated = self.stated.copy()
        for i, rows in enumerate(self.rows_of_sensors()):
            stated[rows] /= median_deviations(stated[rows]) if medians is None else medians[i]
        stated = np.where((stated > 0) & np.isfinite(stated), stated, np.float32(1))
        return replace(self, stated=stated.clip(1 / _MOST_STATED, _MOST_STATED))

    def select(self, part: slice | Bools | NDArray[np.integer[Any]]) -> "Rays":
        """Select rays by a slice of step 1, a mask (N,) or row indices (M,), in this order."""
        rows = part if isinstance(part, slice) or part.dtype != np.bool_ else np.flatnonzero(part)
        columns: dict[str, Any] = {n: getattr(self, n) for n in _COLUMNS if getattr(self, n) is not None}
        for name, column in columns.items():
            # `take` with row indices needs a third of the time of indexing with them or a mask.
            columns[name] = column[rows] if isinstance(rows, slice) else column.take(rows, axis=0)
        return replace(self, **columns)

    def in_world(self) -> tuple[Floats, Floats]:
        """Return the returns and their sensor positions, (N, 3) each, float64, world, m."""
        points = self.points.astype(np.float64) + self.origin
        return points, points - self.directions.astype(np.float64) * self.ranges_m[:, None]


def median_deviations(sigmas: Array) -> Floats:
    """Return the medians (3,) of the positive ones of stated deviations (N, 3); NaN if there are none."""
    known = [column[(column > 0) & np.isfinite(column)] for column in sigmas.T]
    return np.array([np.median(column) if len(column) else np.nan for column in known])


def measured(scan: Array) -> Bools:
    """Return a mask (N,) of the rows of a scan (N, 3) that are returns: finite, not at the sensor, not padding."""
    returns = np.ones(len(scan), np.bool_)
    if not (scan.all() and np.abs(scan).max(initial=0.0) <= checks.MAX_POSITION_M):
        # By column: NumPy takes ten times as long along rows of three.
        finite, other = np.abs(scan) <= checks.MAX_POSITION_M, scan != 0
        returns = finite[:, 0] & finite[:, 1] & finite[:, 2]
        returns &= other[:, 0] | other[:, 1] | other[:, 2]
    # Drivers pad a cloud of fixed size with one point: a long run of equal rows among other rows.
    again = scan[1:, 0] == scan[:-1, 0]
    if np.count_nonzero(again) >= _PADDING:
        again &= (scan[1:] == scan[:-1]).all(axis=1)
        points, counts = np.unique(scan[1:][again], axis=0, return_counts=True)
        if np.count_nonzero(counts >= _PADDING) == 1:
            others = returns & (scan != points[np.argmax(counts)]).any(axis=1)
            returns = others if others.any() else returns
    return returns


def too_far(scan: Array, returns: Bools) -> Bools:
    """Return a mask (N,) of those `returns` (N,) of a scan (N, 3) that no radar measures with the others, such as 65,535 m.

    Their range is more than 100 times the median of the others. Equal ranges count once in it: a sentinel has one.
    """
    bounded = np.clip(np.asarray(scan, np.float64), -1e150, 1e150)  # against overflow
    squares = np.einsum("ni,ni->n", bounded, bounded)
    ordered = squares[returns]
    if len(ordered) and ordered.max() > _MOST_RATIO**2 * ordered.min():
        ordered.sort()
        ordered = ordered[np.diff(ordered, prepend=0.0) > _SAME_SQUARE * ordered]
        while ordered[-1] > (most := _MOST_RATIO**2 * ordered[len(ordered) // 2]):
            ordered = ordered[ordered <= most]
        return returns & (squares > ordered[-1] * (1 + _SAME_SQUARE))
    return np.zeros(len(scan), np.bool_)


@dataclass
class LeftOut:
    """Rows and scans that cannot be used."""

    given: int = 0  # number of rows
    rows: int = 0  # number of rows that are not returns: see :func:`measured`
    far: int = 0  # number of returns without others nearly as far: see :func:`too_far`
    empty: list[int] = field(default_factory=list)  # scans without returns
    poses: list[int] = field(default_factory=list)  # scans whose pose is not a rigid transform

    @property
    def notes(self) -> list[str]:
        parts = []
        if self.rows:
            parts.append(f"{self.rows} of {self.given} returns (not finite, at the sensor, or padding)")
        if self.far:
            ratio = f"{_MOST_RATIO:g} times the median range of their scan"
            parts.append(f"{self.far} of {self.given} returns (beyond {ratio})")
        kinds = ((self.empty, "without returns"), (self.poses, "whose pose is not a rigid transform"))
        parts += [f"{len(of)} scans {what} (the first is scan {of[0]})" for of, what in kinds if of]
        return [f"Left out: {', '.join(parts)}."] if parts else []


def check_scans(
    points: Iterable[ArrayLike], intensities: Iterable[ArrayLike] | None = None
) -> tuple[list[Floats], list[Floats32] | None, LeftOut]:
    """Convert scans (N_i, 3) and intensities (N_i,) to arrays. Raise the ValueError of :func:`prepare` if they are invalid.

    Rows that are not returns, or too far, become 0 0 0 and non-finite intensities NaN, so that the arrays keep their length.
    """
    scans, left_out = [], LeftOut()
    for i, given in enumerate(checks.one_for_each_scan(points, "points")):
        scan = checks.real_array(given, f"scan {i}")
        checks.check_scan_shape(scan, i)
        returns = measured(scan)
        far = too_far(scan, returns)
        left_out.given += len(scan)
        left_out.far += int(np.count_nonzero(far))
        left_out.rows += int(np.count_nonzero(~returns))
        returns &= ~far
        left_out.empty += [] if returns.any() else [i]
        scans.append(scan if returns.all() else np.where(returns[:, None], scan, 0.0))
    checks.check(scans, "points holds no scans")
    if intensities is None:
        return scans, None, left_out
    values = checks.values_of_scans(intensities, scans, "intensities", _IN_FLOAT32)
    return scans, [np.where(np.isfinite(v), v, np.float32(np.nan)) for v in values], left_out


def _lengths(vectors: Floats) -> Floats:
    """Return the lengths (N,) of vectors (N, 3), bit-identical to np.linalg.norm in a fifth of the time."""
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)


def middle_scan(scan: int, scans: int, accumulate_scans: int) -> int:
    """Return the index of the scan whose position serves as that of `scan` in a group of accumulated scans."""
    first = scan - scan % accumulate_scans
    return (first + min(first + accumulate_scans, scans) - 1) // 2


def within_ranges(scan: Floats, min_range_m: float, max_range_m: float | None) -> Bools:
    ranges = _lengths(scan)
    keep = (ranges > 0) & (ranges >= min_range_m)  # a return at the sensor itself has no direction
    return keep if max_range_m is None else keep & (ranges <= max_range_m)


def prepare(
    points: Iterable[ArrayLike],
    poses: ArrayLike,
    intensities: Iterable[ArrayLike] | None = None,
    *,
    min_range_m: float = 0.0,
    max_range_m: float | None = None,
    accumulate_scans: int = 1,
    origin: ArrayLike | None = None,
    lattice: WorldLattice | None = None,
    whole: bool = True,
    rig: Rig | None = None,
    sigmas: Iterable[ArrayLike] | None = None,
    num_threads: int = 1,
) -> Rays:
    """Check scans and convert them to rays in the local frame.

    `points`, `intensities`: F arrays (N_i, 3), sensor frame, m, and (N_i,), sensor units; `poses` (F, 4, 4) T_world_sensor, m.
    `rig`: the radars of the scans, if there are several. `sigmas` (N_i, 3): deviations that the sensor states, m, rad, rad.
    The default `origin` is the mean sensor position, rounded to the nearest block corner of the `lattice`, so that maps of
    different scans share their cells. `whole` False: the scans are a part of a set, which need not have returns within the
    ranges, intensity outliers are not replaced by NaN, and stated deviations not divided by their medians.

    Rows that are not returns (not finite, 0 0 0, padding), returns at 100 times the median range of their scan and scans with a pose that is not rigid are dropped, with a warning
    of the logger ``radarsdf.returns``. Raises a ValueError if lengths or shapes do not match, half of the poses or more are
    not rigid, intensities are all equal or too far apart for float32, or no return is within the ranges.
    """
    mixed = rig is not None and len(rig.labels) > 1 and accumulate_scans > 1
    checks.check(not mixed, f"accumulate_scans must be 1 for several radars, not {accumulate_scans}")
    scans, values, left_out = check_scans(points, intensities)
    num_scans = len(scans)
    T_world_sensor, rigid = checks.usable_poses(poses, num_scans)
    left_out.poses = np.flatnonzero(~rigid).tolist()
    positions = T_world_sensor[:, :3, 3]
    if origin is not None:
        local_origin = checks.positions(checks.real_array(origin, "origin")[None], "origin")[0]
    else:
        local_origin = positions.mean(axis=0)
        if lattice is not None:
            local_origin = lattice.position(lattice.nearest_block(local_origin))
    seen_from = positions[[middle_scan(i, num_scans, accumulate_scans) for i in range(num_scans)]]
    most_m = np.inf if max_range_m is None else max_range_m
    scan_of = np.repeat(np.arange(num_scans, dtype=np.int32), [len(scan) for scan in scans])
    R, most_of_scan = T_world_sensor[:, :3, :3].reshape(-1, 9), np.where(rigid, most_m, -1.0)
    given = np.concatenate(scans), scan_of, R, positions - local_origin, seen_from - local_origin
    kept, points_m, directions, ranges_m = scan_rays(*given, min_range_m, most_of_scan, num_threads)
    none = f"none of {left_out.given} returns lies between {min_range_m} m and {most_m} m"
    checks.check(len(ranges_m) or not whole, "; ".join([none, *left_out.notes]))
    for note in left_out.notes if whole else ():
        _LOG.warning(note)
    intensity = None if values is None else np.concatenate(values)[kept]
    columns = local_origin, points_m, directions, ranges_m, intensity, scan_of[kept]
    of_rig = () if rig is None else (rig.of_scan, len(rig.labels))
    rays = Rays(*columns, T_world_sensor[:, :3, 2].copy(), left_out.given, *of_rig)
    rays = rays.without_outliers() if whole else rays
    if sigmas is not None:
        of_scans = checks.values_of_scans(sigmas, scans, "sigmas", _IN_FLOAT32, 3)
        rays = replace(rays, stated=np.concatenate(of_scans)[kept])
        rays = rays.with_relative_deviations() if whole else rays
    if rays.intensities is not None and whole:
        fits = rays.with_intensity.any()
        checks.check(fits, "no intensity is finite: omit intensities if the sensor does not measure them")
        check_range(float(np.nanmin(rays.intensities)), float(np.nanmax(rays.intensities)))
    return rays


def check_range(low: float, high: float) -> None:
    """Raise a ValueError if intensities from `low` to `high`, sensor units, are all equal or too far apart for float32."""
    checks.check(low != high, f"all intensities are {low}: omit them if the sensor does not measure them")
    fits = high - low <= float(np.finfo(np.float32).max)
    checks.check(fits, f"intensities from {low} to {high} are too far apart for float32")


def rays_from(points: Array, sensors: Floats, origin: Floats, scans: Ints32, up_of_scan: Floats) -> Rays:
    """Build rays without intensities from `sensors` to `points`, (N, 3) each, local frame, m. The rest as in :class:`Rays`."""
    away = points - sensors
    ranges_m = np.maximum(_lengths(away), 1e-6)
    directions = (away / ranges_m[:, None]).astype(np.float32)
    columns = points.astype(np.float32, copy=False), directions, ranges_m.astype(np.float32)
    return Rays(origin, *columns, None, scans, up_of_scan, len(points))
