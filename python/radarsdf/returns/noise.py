"""Noise of the sensor, estimated from its returns, and noise reduction by moving returns onto planes."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from radarsdf.arrays import Bools, Floats, Floats32, Ints, Ints32
from radarsdf.config.groups import ReturnsConfig
from radarsdf.core import move_onto_planes
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import WEIGHT_UNIT

_LOG = logging.getLogger("radarsdf.returns")
_Ranges = TypeVar("_Ranges", Floats32, Floats)

NOISE_SETTINGS = ("range_noise_m", "azimuth_noise_rad", "elevation_noise_rad")
"""Settings of ``config.returns`` that fix the fields of :class:`SensorNoise`, in their order."""

# Sample size. Measured: each deviation is within 1 to 3 % of that of all returns, with twice as many within 1 to 1.5 %.
_RETURNS = 20_000
_MIN_RETURNS = 100  # with fewer, the result is the initial guess
_SIGMAS2 = 6.0  # gate on squared residuals, variances
# Ratio of the variance of a normal distribution to its variance within this gate.
_TRUNCATION = 1.05
_ROUNDS = 10
_SETTLED = 0.01  # relative change of the variances at convergence. The sampling error is larger
_FIRST_ANGLE_RAD = 0.01
_LEAST_VARIANCE = 1e-30  # m² or rad², against division by zero
_MIN_SINE = 1e-6  # of the angle between a ray and the z axis of its sensor, against division by zero


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the position of a return. The three errors are independent."""

    range_m: float  # along the beam, m
    azimuth_rad: float  # in azimuth, rad
    elevation_rad: float  # in elevation, rad

    @classmethod
    def median(cls, noises: "Sequence[SensorNoise]") -> "SensorNoise":
        return cls(*np.median([noise.deviations for noise in noises], axis=0).tolist())

    @property
    def deviations(self) -> list[float]:
        """Standard deviations along the beam, m, in azimuth and in elevation, rad."""
        return [self.range_m, self.azimuth_rad, self.elevation_rad]

    @property
    def variances(self) -> list[float]:
        """Variances along the beam, m², in azimuth and in elevation, rad²."""
        return np.square(self.deviations).tolist()

    @property
    def mean(self) -> "SensorNoise":
        """The same as the noise of one radar."""
        return SensorNoise(*self.deviations)

    @property
    def angle_rad(self) -> float:
        """Standard deviation across the beam: root mean square of azimuth and elevation, rad."""
        return float(np.hypot(self.azimuth_rad, self.elevation_rad) / np.sqrt(2))

    def variances_m2(self, ranges_m: _Ranges, axes_across: int = 1) -> _Ranges:
        """Return the sum (N,) of the variances along the beam and on one or both axes across it, at ranges (N,), m²."""
        return self.range_m**2 + axes_across * np.square(self.angle_rad * ranges_m)

    def mean_variances_m2(self, ranges_m: Floats32) -> Floats:
        """Return the mean (N,) of the variances along the three axes at ranges (N,), m²."""
        return self.variances_m2(ranges_m.astype(np.float64), axes_across=2) / 3

    def by_radar(self, rays: Rays) -> list[tuple[slice | Ints, "SensorNoise"]]:  # noqa: ARG002 - of one radar
        """Return the rows of the rays of each radar, with its noise."""
        return [(slice(None), self)]

    def weights(self, rays: Rays) -> Ints32 | None:
        """Return the weight (N,) of each return in parts of 1 / `WEIGHT_UNIT`, relative to the mean of all. None: all equal."""
        return None if rays.stated is None else _in_parts(_stated_weights(self, rays))

    def of_scans(self, rays: Rays) -> Floats:
        """Return :attr:`variances` (F, 3) of the returns of each scan."""
        return np.tile(self.variances, (len(rays.up_of_scan), 1))


@dataclass(frozen=True)
class RigNoise(SensorNoise):
    """Noise of several radars. Its own variances are harmonic means over all returns: their information is the mean."""

    of_sensors: tuple[SensorNoise, ...]  # of each of K radars
    parts: tuple[int, ...]
    """Weight of a return of each radar, in parts of 1 / `WEIGHT_UNIT`. The mean over all returns is 1."""

    @classmethod
    def of(cls, of_sensors: Sequence[SensorNoise], rays: Rays) -> "RigNoise":
        """Build from the noise of each radar. A return's weight is the mean information of the returns of its radar."""
        ranges_m = [rays.ranges_m[rows].astype(np.float64) for rows in rays.rows_of_sensors()]
        counts = np.array([len(own) for own in ranges_m])
        variances = np.maximum([own.variances for own in of_sensors], _LEAST_VARIANCE)
        mean = SensorNoise(*np.sqrt(counts.sum() / (counts / variances.T).sum(axis=1)).tolist())
        of_each = zip(of_sensors, ranges_m, strict=True)
        weights = np.array([np.sum(mean.variances_m2(r) / own.variances_m2(r)) for own, r in of_each])
        weights *= counts.sum() / weights.sum() / np.maximum(counts, 1)
        weights[counts == 0] = 1.0  # a radar of a live map that has not measured yet
        parts = tuple(_in_parts(weights).tolist())
        return cls(mean.range_m, mean.azimuth_rad, mean.elevation_rad, tuple(of_sensors), parts)

    def by_radar(self, rays: Rays) -> list[tuple[slice | Ints, SensorNoise]]:
        return [*zip(rays.rows_of_sensors(), self.of_sensors, strict=True)]

    def weights(self, rays: Rays) -> Ints32 | None:
        parts = np.array(self.parts, np.int32)[rays.sensor_of_scan][rays.scans]
        return parts if rays.stated is None else _in_parts(parts / WEIGHT_UNIT * _stated_weights(self, rays))

    def of_scans(self, rays: Rays) -> Floats:
        return np.array([own.variances for own in self.of_sensors])[rays.sensor_of_scan]


def _in_parts(weights: Floats) -> Ints32:
    return np.maximum(np.rint(WEIGHT_UNIT * weights), 1).astype(np.int32)


def _stated_weights(noise: SensorNoise, rays: Rays) -> Floats:
    """Return the weight (N,) of each return by its stated deviations, relative to the mean of those of its radar."""
    assert rays.stated is not None
    weights = np.empty(len(rays))
    for rows, own in noise.by_radar(rays):
        ranges2, factors = np.square(rays.ranges_m[rows], dtype=np.float64), np.square(rays.stated[rows]).T
        along, azimuth, elevation = own.variances
        usual = along + ranges2 * (azimuth + elevation)
        of_rows = usual / (along * factors[0] + ranges2 * (azimuth * factors[1] + elevation * factors[2]))
        weights[rows] = of_rows * (len(of_rows) / max(of_rows.sum(), _LEAST_VARIANCE))
    return weights


def rig_noise(surfels: Surfels, rays: Rays, config: ReturnsConfig, num_threads: int = 0) -> RigNoise:
    """Estimate the noise of each radar from its own returns. With too few on flat surfels, it is that of all radars."""
    mean = sensor_noise(surfels, rays, config, num_threads)
    own = map(rays.select, rays.rows_of_sensors())
    return RigNoise.of([sensor_noise(surfels, part, config, num_threads, mean) for part in own], rays)


def sensor_noise(
    surfels: Surfels,
    rays: Rays,
    config: ReturnsConfig,
    num_threads: int = 0,
    initial: SensorNoise | None = None,
) -> SensorNoise:
    """Estimate the noise of the sensor from the distances of returns to their surfels.

    The variance across a plane is the sum of the three variances, each weighted by the squared component of the
    plane's normal along its axis. Across the beam, the deviation is an angle times the range. The three variances
    are fitted to the squared distances by weighted least squares. Those set in `config` are kept fixed. Where the sensor states
    a deviation for each return, they are those of a return with the median one: makers differ from them by up to 100 times.

    A surfel of leaf cells of 0.2 m is 1.2 m wide, so noise above about 0.4 m is underestimated. Surface roughness
    counts as noise. Measured on simulated scenes: 0.7 to 1.2 times the true deviation.
    """
    known = np.array([getattr(config, name) for name in NOISE_SETTINGS], np.float64)
    free = np.isnan(known)
    guess = [0.25 * surfels.cell_size_m, _FIRST_ANGLE_RAD, _FIRST_ANGLE_RAD]
    sigma2 = np.where(free, guess if initial is None else initial.deviations, known) ** 2
    if not free.any():
        return SensorNoise(*np.sqrt(sigma2).tolist())
    residual2, shares = _residuals(surfels, rays, num_threads)
    if len(residual2) >= _MIN_RETURNS:
        unexplained = residual2 - np.einsum("k,kn->n", sigma2[~free], shares[~free])
        least = np.array([0.025 * surfels.cell_size_m, 1e-3, 1e-3]) ** 2
        wanted = shares[free]
        for _ in range(_ROUNDS):  # weights from the variances of the previous iteration
            before = sigma2[free]
            variance = np.einsum("k,kn->n", sigma2, shares)
            weights = (residual2 < _SIGMAS2 * variance) / np.square(variance)
            weighted = wanted * weights
            normal = np.einsum("kn,ln->kl", weighted, wanted)
            solution = np.linalg.lstsq(normal, np.einsum("kn,n->k", weighted, unexplained), rcond=None)[0]
            sigma2[free] = _TRUNCATION * np.maximum(solution, least[free])
            if (np.abs(sigma2[free] - before) <= _SETTLED * before).all():
                break
    return SensorNoise(*np.sqrt(sigma2).tolist())


def _residuals(surfels: Surfels, rays: Rays, num_threads: int) -> tuple[Floats, Floats]:
    """Return the squared distances (M,) of a sample of the returns from flat surfels, m², and the factors (3, M) of :func:`_shares`."""
    on_flat = surfels.counts[surfels.cell_of_plane[surfels.is_flat()]].sum()
    tried = min(len(rays), int(_RETURNS * len(rays) / max(on_flat, 1.0)))
    rows = np.linspace(0, len(rays) - 1, tried).astype(np.int64)
    plane = surfels.flat_planes_at(rays.points.take(rows, axis=0), num_threads)
    rows, plane = rows[plane >= 0], plane[plane >= 0]
    normals = surfels.normals.take(plane, axis=0)  # a third of the time of indexing
    off_m = rays.points.take(rows, axis=0) - surfels.centres.take(plane, axis=0)
    return np.einsum("ni,ni->n", off_m, normals) ** 2, _shares(rays, rows, normals)


def without_false_deviations(rays: Rays, leaf_size_m: float, config: ReturnsConfig, num_threads: int) -> Rays:
    """Leave out the stated deviations of radars that are not credible."""
    if rays.stated is None:
        return rays
    credible = are_credible(rays, leaf_size_m, config, num_threads)
    medians = [np.ones(3) if known else np.full(3, np.nan) for known in credible]
    return rays.with_relative_deviations(medians) if any(credible) else replace(rays, stated=None)


def are_credible(rays: Rays, leaf_size_m: float, config: ReturnsConfig, num_threads: int) -> list[bool]:
    """Return whether the stated deviations of each radar, as weights, make the mean of its returns no less precise."""
    surfels, credible = Surfels.of(rays, leaf_size_m, num_threads), []
    for rows in rays.rows_of_sensors():
        own, means_m2 = rays.select(rows), []
        variances = sensor_noise(surfels, own, config, num_threads).variances
        for part in (own, replace(own, stated=None)):
            residual2, shares = _residuals(surfels, part, num_threads)
            weights = 1 / np.einsum("k,kn->n", variances, shares)
            means_m2.append(np.sum(weights**2 * residual2) / max(np.sum(weights) ** 2, _LEAST_VARIANCE))
        credible.append(bool(means_m2[0] <= means_m2[1]))
    if not all(credible):
        _LOG.warning(
            "Left out: deviations stated by the sensor. The mean with equal weights is more precise."
        )
    return credible


def variances_across(rays: Rays, rows: Ints, normals: Floats, noise: SensorNoise) -> Floats:
    """Return the variances (M,) of the returns in `rows` (M,) across planes with `normals` (M, 3), m²."""
    return np.einsum("k,kn->n", np.array(noise.variances), _shares(rays, rows, normals))


def _shares(rays: Rays, rows: Ints, normals: Floats) -> Floats:
    """Return the factors (3, M) of the three noise variances in the variance across planes."""
    ranges2 = np.square(rays.ranges_m.take(rows).astype(np.float64))
    shares = [np.square(_dot(axis, normals.T)) for axis in _error_axes(rays, rows)]
    of_rows = np.stack([shares[0], shares[1] * ranges2, shares[2] * ranges2])
    return of_rows if rays.stated is None else of_rows * np.square(rays.stated.take(rows, axis=0).T)


def errors_with(rays: Rays, rows: Ints, normals: Floats32 | Floats, noise: SensorNoise) -> Floats:
    """Return the errors (M, 3) of the returns in `rows` (M,) to expect from an error of 1 along `normals` (M, 3)."""
    variances, normal = noise.of_scans(rays)[rays.scans[rows]].T, normals.T.astype(np.float64)
    variances[1:] *= np.square(rays.ranges_m[rows].astype(np.float64))
    parts = zip(variances, _error_axes(rays, rows), strict=True)
    errors = np.sum([variance * _dot(axis, normal) * axis for variance, axis in parts], axis=0)
    return np.asarray(errors / _dot(errors, normal)).T


def _error_axes(rays: Rays, rows: Ints) -> tuple[Floats, Floats, Floats]:
    """Return the directions (3, M) of the three errors of returns: along the beam, and of increasing azimuth and elevation."""
    up = rays.up_of_scan.take(rays.scans.take(rows), axis=0).T
    along = rays.directions.take(rows, axis=0).T.astype(np.float64)
    azimuth = np.cross(up, along, axis=0)
    azimuth /= np.maximum(np.sqrt(_dot(azimuth, azimuth)), _MIN_SINE)
    return along, azimuth, np.cross(along, azimuth, axis=0)


# Vectors are columns (3, M): NumPy takes three times as long on rows of three.
def _dot(a: Floats, b: Floats) -> Floats:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def onto_surfels(
    surfels: Surfels,
    rays: Rays,
    cells: Ints32,
    noise: SensorNoise,
    kept: Bools | None = None,
    num_threads: int = 0,
) -> Rays:
    """Move each return towards the surfel of its cell, in row `cells` (N,) of `surfels`, if that is flat.

    `kept`: mask (N,) of the rays to return; None: all. The scatter below is that of all returns.

    A plane through dozens of returns has much less noise than one return. But a surface is not a plane: scatter
    of the returns beyond their noise is the shape of the surface. So a return keeps the share τ² / (τ² + σ²) of
    its distance from the plane, with the variance σ² of its noise across the plane and the variance τ² of the
    surface, which is that of the returns minus their mean σ². This is the best linear estimate of its true
    distance (Wiener, 1949). Along the plane, the return keeps its position.
    """
    scans, up, variances = rays.scans, rays.up_of_scan, noise.of_scans(rays)
    if rays.stated is not None:  # each return has its own
        up, variances = up[scans], variances[scans] * np.square(rays.stated)
        scans = np.arange(len(rays), dtype=np.int32)
    of_rays = rays.points, rays.directions, rays.ranges_m, scans, up
    thickness = np.ascontiguousarray(surfels.variances[:, 0])
    planes = surfels.flat_planes_of(cells), surfels.centres, surfels.normals, thickness
    moved_onto = move_onto_planes(*of_rays, *planes, variances, kept, num_threads)
    points, directions, ranges_m = moved_onto
    rest = rays if kept is None else rays.select(kept)
    return replace(rest, points=points, directions=directions, ranges_m=ranges_m)
