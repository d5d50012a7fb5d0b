"""Sensor model: field of view, resolution, detection threshold and noise, estimated from scans; and the radars of a rig."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, replace
from typing import Any, TypeVar

import numpy as np

from radarsdf.arrays import Array, ArrayLike, Bools, Floats, Floats32, Ints
from radarsdf.checks import check, not_negative, number, usable_poses
from radarsdf.config.fit_config import FitConfig
from radarsdf.products import product
from radarsdf.returns.intensities import sample
from radarsdf.returns.noise import RigNoise, SensorNoise, rig_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays, prepare
from radarsdf.returns.reflectance import of_views, regression
from radarsdf.rig import Label, Rig

# Quantile of azimuth, elevation and range at either end, beyond which returns count as outliers.
_STRAY = 0.002
_MAX_RETURNS = 20_000  # sample size: angles within 0.2° and ranges within 1 % of those of all returns
_RANGE_BINS = 8
_WEAKEST = 0.01  # quantile of the intensities in a range bin that is the threshold there
_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))  # of a normal distribution, standard deviations
_MAX_RANGE_M = 1e6
_Intensities = TypeVar("_Intensities", Floats, Floats32)

Unit = tuple[float, float]
"""Gain and offset of a radar's intensities: gain · intensity of the map + offset."""
SAME_UNIT: Unit = (1.0, 0.0)


@dataclass(frozen=True)
class Sensor:
    """Model of a radar. Sensor frame: x forward, y left, z up.

    Azimuth is the angle from x towards y, elevation the angle above the xy plane. Estimate a sensor from scans by :meth:`of`,
    or construct it from numbers; ``dataclasses.replace`` changes one.

    Raises
    ------
    ValueError
        If a number is out of range, or limits are not ascending.
    """

    azimuth_rad: tuple[float, float]
    """Field of view in azimuth: from, to, within [-π, π], rad."""
    elevation_rad: tuple[float, float]
    """Field of view in elevation: from, to, within [-π/2, π/2], rad."""
    range_m: tuple[float, float]
    """Nearest and farthest return, m."""
    returns_per_scan: float
    """Median number of returns in a scan."""
    noise: SensorNoise
    """Standard deviations of the position of a return."""
    thresholds: tuple[tuple[float, float], ...] = ()
    """Pairs of a range, m, ascending, and the weakest intensity detected there, sensor units, interpolated
    linearly. Empty: the sensor measures no intensities."""
    unit: Unit = SAME_UNIT
    """Gain and offset: it measures gain · intensity + offset where the map, in the unit of its first radar, has an intensity."""

    def __post_init__(self) -> None:
        limits = {"azimuth_rad": math.pi, "elevation_rad": math.pi / 2, "range_m": _MAX_RANGE_M}
        for name, most in limits.items():
            low, high = found = _pair(getattr(self, name), name)
            fits = (0.0 if name == "range_m" else -most) <= low < high <= most
            wanted = f"two ascending numbers up to {most:.4g}"
            check(fits, f"{name} must be {wanted}, not {low:.6g} and {high:.6g}")
            object.__setattr__(self, name, found)
        fits = 0 < number(self.returns_per_scan, "returns_per_scan") <= 1e7
        check(fits, f"returns_per_scan must be in (0, 10^7], not {self.returns_per_scan}")
        for value in astuple(self.noise):
            not_negative(value, "noise")
        steps = tuple(_pair(step, "thresholds") for step in self.thresholds)
        fits = not any(a >= b for (a, _), (b, _) in itertools.pairwise(steps))
        check(fits, "thresholds must have ascending ranges")
        object.__setattr__(self, "thresholds", steps)
        check(_pair(self.unit, "unit")[0] > 0, f"the gain of unit must be positive, not {self.unit[0]}")
        object.__setattr__(self, "unit", _pair(self.unit, "unit"))

    @property
    def beam_rad(self) -> tuple[float, float]:
        """Width of a beam in azimuth and elevation, rad: the full width at half maximum of the noise."""
        return _FWHM * self.noise.azimuth_rad, _FWHM * self.noise.elevation_rad

    def threshold(self, ranges_m: Array) -> Floats:
        """Interpolate the weakest detected intensity (N,), float64, sensor units, at ranges (N,), m.

        Beyond the ends of `thresholds` it is constant; without them it is -inf.
        """
        if not self.thresholds:
            return np.full(len(ranges_m), -np.inf)
        at_m, weakest = np.transpose(self.thresholds)
        return np.interp(ranges_m, at_m, weakest)

    def measured(self, intensities: _Intensities) -> _Intensities:
        """Convert intensities (N,) of a map to the :attr:`unit` of this sensor."""
        gain, offset = self.unit
        return intensities if self.unit == SAME_UNIT else gain * intensities + offset

    @staticmethod
    def directions(azimuth_rad: Array, elevation_rad: Array) -> Floats:
        """Convert azimuths and elevations (N,), rad, to unit vectors (N, 3), float64, in the sensor frame."""
        x, y = np.cos(azimuth_rad), np.sin(azimuth_rad)
        cosine = np.cos(elevation_rad)
        return np.stack([cosine * x, cosine * y, np.sin(elevation_rad)], axis=1)

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict that JSON can store. :meth:`from_dict` is the inverse."""
        described = asdict(self) | {"thresholds": [list(step) for step in self.thresholds]}
        unit = described.pop("unit")
        return described if unit == SAME_UNIT else described | {"unit": list(unit)}

    @classmethod
    def from_dict(cls, described: dict[str, Any]) -> "Sensor":
        """Build a sensor from the dict of :meth:`to_dict`: values by attribute; `noise` is a dict, too.

        Raises a ValueError or TypeError if a number is out of range, or a name is missing or unknown.
        """
        return cls(**described | {"noise": SensorNoise(**described["noise"])})

    @classmethod
    def of(
        cls,
        points: Sequence[ArrayLike],
        intensities: Sequence[ArrayLike] | None = None,
        *,
        noise: SensorNoise | None = None,
        min_range_m: float = 0.0,
        max_range_m: float | None = None,
    ) -> "Sensor":
        """Estimate from scans (N_i, 3) in the sensor frame, m, and intensities (N_i,), sensor units, NaN where missing.

        Returns outside the ranges are ignored. Raises a ValueError if none is left, or all are in one direction.
        """
        poses = np.tile(np.eye(4), (len(points), 1, 1))
        limits: dict[str, Any] = {"min_range_m": min_range_m, "max_range_m": max_range_m}
        rays = prepare(points, poses, intensities, whole=False, **limits)
        check(len(rays), "no return lies within the ranges: a sensor cannot be estimated from its scans")
        noise = SensorNoise(0.0, 0.0, 0.0) if noise is None else noise
        return cls.of_rays(rays.without_outliers(), poses, noise)

    @classmethod
    def of_rays(cls, rays: Rays, poses: ArrayLike, noise: SensorNoise) -> "Sensor":
        """Estimate from `rays` of scans with poses (F, 4, 4) T_world_sensor, m."""
        T_world_sensor, _ = usable_poses(poses, len(rays.up_of_scan))
        rows = sample(rays.hashes(), _MAX_RETURNS)
        scans = rays.scans[rows]
        # By coordinate: a matrix for each return takes three times as long.
        from_sensor = rays.points[rows].T - (T_world_sensor[:, :3, 3] - rays.origin)[scans].T
        R = T_world_sensor[:, :3, :3]
        x, y, z = (sum(R[:, j, i][scans] * from_sensor[j] for j in range(3)) for i in range(3))
        range_m = np.sqrt(x * x + y * y + z * z)
        values = rays.intensities
        thresholds = () if values is None else _thresholds(range_m, values[rows].astype(np.float64))
        per_scan = np.bincount(rays.scans)
        return cls(
            azimuth_rad=_limits(np.arctan2(y, x)),
            elevation_rad=_limits(np.arcsin(np.clip(z / range_m, -1, 1))),
            range_m=_limits(range_m),
            returns_per_scan=float(np.median(per_scan[per_scan > 0])),
            noise=noise,
            thresholds=thresholds,
        )


def _pair(values: Any, name: str) -> tuple[float, float]:
    fits = isinstance(values, (tuple, list)) and len(values) == 2
    check(fits, f"{name} must be two numbers, not {values!r:.50}")
    return number(values[0], name), number(values[1], name)


def _limits(values: Floats) -> tuple[float, float]:
    low, high = np.quantile(values, [_STRAY, 1 - _STRAY])
    if low == high:  # very few returns
        low -= 1e-3 * max(abs(low), 1e-3)
    return float(low), float(high)


def _thresholds(range_m: Floats, values: Floats) -> tuple[tuple[float, float], ...]:
    """Return :attr:`Sensor.thresholds` of returns at ranges (N,), m, with intensities (N,), NaN where missing."""
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(range_m[known])]
    # Equal ranges share a bin: sorting them by intensity, for bins of equal size, would take fourteen times as long.
    nearest_m = [range_m[part[0]] for part in np.array_split(order, _RANGE_BINS) if len(part)]
    bins = [rows for rows in np.split(order, np.searchsorted(range_m[order], nearest_m)) if len(rows)]
    of_bins = ((np.median(range_m[rows]), np.quantile(values[rows], _WEAKEST)) for rows in bins)
    return tuple((float(at_m), float(weakest)) for at_m, weakest in of_bins)


_MOST_RETURNS = 60_000  # sample size
_FEWEST_SHARED = 30  # surfels that a radar shares with others, for its offset
# Measured on simulated rigs in dB: the spreads of two radars differ by a factor of 0.70 to 1.15.
_SAME_SPREAD = 1.6


def in_map_unit(intensities: _Intensities, unit: Unit) -> _Intensities:
    """Convert intensities (N,) of a radar to the unit of the map: the inverse of :meth:`Sensor.measured`."""
    gain, offset = unit
    return (intensities - offset) / gain


@dataclass(frozen=True)
class Radars:
    """K radars whose returns make one map."""

    labels: tuple[Label, ...]  # K
    noise: RigNoise
    units: tuple[Unit | None, ...]
    """(K,) of each, relative to the first that measures intensities. None: it shares no surface with others."""

    @classmethod
    def unify(
        cls, rays: Rays, rig: Rig | None, config: FitConfig, num_threads: int = 0
    ) -> "tuple[Rays, Radars | None]":
        """Estimate the radars of a rig. Return `rays` in the unit of the first, and them; of one radar as they are, and None."""
        if rig is None:
            return rays, None
        surfels = Surfels.of(rays, config.leaf_size_m, num_threads)
        noise = rig_noise(surfels, rays, config.returns, num_threads)
        units = intensity_units(surfels, rays, num_threads)
        if rays.intensities is not None:
            values = rays.intensities.copy()
            for unit, rows in zip(units, rays.rows_of_sensors(), strict=True):
                values[rows] = in_map_unit(values[rows], unit or SAME_UNIT)  # without a unit they stay
            rays = replace(rays, intensities=values)
        return rays, cls(rig.labels, noise, units)

    def sensors(self, rays: Rays, poses: ArrayLike) -> dict[Label, Sensor]:
        """Estimate each radar with returns from `rays` in one unit, of scans with poses (F, 4, 4) T_world_sensor, m."""
        found = {}
        each = zip(self.labels, self.noise.of_sensors, self.units, rays.rows_of_sensors(), strict=True)
        for label, noise, unit, rows in each:
            if len(own := rays.select(rows)):
                sensor, (gain, offset) = Sensor.of_rays(own, poses, noise), unit or SAME_UNIT
                thresholds = tuple((range_m, gain * low + offset) for range_m, low in sensor.thresholds)
                found[label] = replace(sensor, thresholds=thresholds, unit=(gain, offset))
        return found

    def report(self, rays: Rays) -> dict[str, Any]:
        """Return the number of returns, noise and unit of each radar by its label."""
        found: dict[str, Any] = {}
        each = zip(self.labels, self.noise.of_sensors, self.units, rays.rows_of_sensors(), strict=True)
        for label, noise, unit, rows in each:
            gain, offset = unit or (None, None)
            own = {"returns": len(rays.points[rows]), "noise": asdict(noise)}
            found[str(label)] = own | {"intensity_gain": gain, "intensity_offset": offset}
        return found


def intensity_units(surfels: Surfels, rays: Rays, num_threads: int = 0) -> tuple[Unit | None, ...]:
    """Estimate the intensity unit of each radar from flat surfels that several see.

    Radars see a surfel from other sides and ranges. So differences within surfels are regressed on the response to range,
    elevation and incidence, for each kind of surface, and on the radar (fixed effects of the surfels): materials cancel out.
    """
    units: list[Unit | None] = [None] * rays.num_sensors
    rays = rays.select(np.sort(sample(rays.hashes(), _MOST_RETURNS)))
    planes = surfels.flat_planes_at(rays.points, num_threads)
    usable = np.flatnonzero(rays.with_intensity & (planes >= 0))
    if len(usable) == 0:
        return tuple(units)
    rays, plane = rays.select(usable), planes[usable].astype(np.int64)
    assert rays.intensities is not None
    assert rays.sensor_of_scan is not None
    views = of_views(rays.directions, rays.ranges_m, surfels.normals, plane)
    sensors, values = rays.sensor_of_scan[rays.scans], rays.intensities.astype(np.float64)
    units[int(sensors.min())] = SAME_UNIT
    # Surfels with returns at the limits of a radar, which may be clipped: saturated ones have no differences.
    clipped = np.zeros(len(surfels.normals), np.bool_)
    for rows in rays.rows_of_sensors():
        ends = values[rows].min(initial=np.inf), values[rows].max(initial=-np.inf)
        clipped[plane[rows][np.isin(values[rows], ends)]] = True
    while True:
        known = np.array([unit is not None for unit in units])
        by_sensor = np.zeros((len(units), len(surfels.normals)), np.bool_)
        by_sensor[sensors, plane] = ~clipped[plane]
        shared = by_sensor & by_sensor[known].any(axis=0)
        counts = np.where(known, 0, shared.sum(axis=1))
        new = int(np.argmax(counts))
        if counts[new] < _FEWEST_SHARED:
            return tuple(units)
        own = sensors == new
        both = np.flatnonzero(shared[new][plane] & (own | known[sensors]))
        units[new] = unit = _unit(values[both], own[both], plane[both], views[both])
        values[own] = in_map_unit(values[own], unit)


def _unit(values: Floats, own: Bools, plane: Ints, views: Floats) -> Unit:
    """Estimate gain and offset of a radar's `own` `values` (N,) relative to the others, on the same surfels.

    Speckle is the same for all radars if in dB, so the gain is the ratio of the spreads within surfels; 1 unless clearly not.
    """
    spread, other_spread = (_effects(values[rows], views[rows], plane[rows])[1] for rows in (own, ~own))
    gain = spread / other_spread if min(spread, other_spread) > 0 else 1.0
    gain = gain if abs(np.log(gain)) > np.log(_SAME_SPREAD) else 1.0
    values = np.where(own, values / gain, values)
    return gain, gain * float(_effects(values, np.column_stack([views, own]), plane)[0][-1])


def _effects(values: Floats, design: Floats, plane: Ints) -> tuple[Floats, float]:
    """Regress differences of `values` (N,) within surfels on those of `design` (N, K): coefficients (K,), and median residual."""
    counts = np.maximum(np.bincount(plane), 1)
    columns = np.column_stack([design, values])
    within = columns - np.stack([np.bincount(plane, column) / counts for column in columns.T], axis=1)[plane]
    coefficients = regression(within[:, :-1], within[:, -1])
    left = np.abs(within[:, -1] - product(within[:, :-1], coefficients[:, None])[:, 0])
    count = counts[plane]
    left *= np.sqrt(count / np.maximum(count - 1, 1))  # a mean takes a degree of freedom
    return coefficients, float(np.median(left[count > 1])) if (count > 1).any() else 0.0
