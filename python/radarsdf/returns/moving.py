# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Velocity of the sensor from the Doppler of a scan, and the returns that move.

A static return in direction d of a sensor with velocity v has the Doppler ``-d·v``, negative where the sensor approaches.
Three returns give v; the v on which most returns agree is refined by least squares. The method is that of C. Doer and
G. Trommer, "An EKF Based Approach to Radar Inertial Odometry", MFI 2020, written anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import check_values_of_scans, one_for_each_scan, real_array
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.products import normal_matrix, product
from radarsdf.returns.rays import Rays, check_scans, prepare
from radarsdf.scans import Scans

FloatArray = NDArray[np.float64]

MIN_DOPPLER_RETURNS = 10
"""Fewer returns of a scan determine no velocity."""

# Of three returns. With 40 % moving, one without them is among 38 draws with a probability of 0.9999.
_DRAWS = 64
_SIGMA_MPS = 0.15  # a return is off if its Doppler differs by three times the noise, and by at least this
_LEAST_SIGMA_MPS = 1e-3
_ROUNDS = 4
_MIN_AGREEING = 0.4  # share of the returns that must agree on a velocity
_FILLER = 0.2  # share of all returns with one and the same speed, from which on it may be none
# Share from which on the other returns are too few to distinguish a sensor that stands still from one that does not measure.
_ONLY_FILLER = 0.9
# Deviation of any velocity. Across the directions of all returns, as the vertical of a flat field of view, nothing else is known.
_ANY_MPS = 100.0
_FOLDS = (-1.0, 0.0, 1.0)  # intervals by which all three returns of a draw may be folded


@dataclass(frozen=True)
class SensorVelocity:
    """The velocity that the Doppler of one scan gives."""

    velocity_mps: FloatArray  # (3,) of the sensor in its own frame. NaN if the returns do not agree on one
    covariance: FloatArray  # (3, 3) m²/s², large in directions that no return measures
    static: NDArray[np.bool_]  # (N,) whether each return agrees with it. All False without a velocity

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.velocity_mps).all())


def sensor_velocity(
    points: NDArray[Any], doppler_mps: NDArray[Any], *, interval_mps: float | None = None
) -> SensorVelocity:
    """The velocity of the sensor in one scan of returns (N, 3) with `doppler_mps` (N,), positive away from the sensor.

    NaN with fewer than 10 returns, or if less than 40 % of them agree. A component that no return measures is 0 m/s, with a
    deviation of 100 m/s. `interval_mps`: width of the interval into which the sensor folds speeds.
    """
    x, speeds = np.asarray(points, np.float64), np.asarray(doppler_mps, np.float64)
    ranges = np.linalg.norm(x, axis=1)
    usable = (ranges > 0) & np.isfinite(speeds) & np.isfinite(ranges)
    unknown = SensorVelocity(np.full(3, np.nan), np.full((3, 3), np.nan), np.zeros(len(x), bool))
    rows = np.flatnonzero(usable)
    if len(rows) < MIN_DOPPLER_RETURNS:
        return unknown
    away = -x[rows] / ranges[rows, None]
    away_columns = np.ascontiguousarray(away.T)
    measured = speeds[rows]

    def residuals(velocities: FloatArray) -> FloatArray:
        """(K, M) differences of the measured speeds from those of velocities (K, 3)."""
        off: FloatArray = measured - product(velocities, away_columns)
        return off if interval_mps is None else off - interval_mps * np.round(off / interval_mps)

    velocity = _most_agreed(away, measured, residuals, interval_mps)
    sigma = _SIGMA_MPS / 3
    for _ in range(_ROUNDS):
        off = residuals(velocity[None])[0]
        agrees = np.abs(off) < max(_SIGMA_MPS, 3 * sigma)
        if agrees.sum() < max(MIN_DOPPLER_RETURNS / 2, _MIN_AGREEING * len(rows)):
            return unknown
        weak = sigma**2 / _ANY_MPS**2
        normal = normal_matrix(away[agrees], away[agrees]) + weak * np.eye(3)
        right = normal_matrix(away[agrees], off[agrees, None])[:, 0] - weak * velocity
        velocity = velocity + np.linalg.solve(normal, right)
        # The median is not drawn by what moves.
        sigma = min(1.4826 * float(np.median(np.abs(residuals(velocity[None])[0][agrees]))), _SIGMA_MPS)
        sigma = max(sigma, _LEAST_SIGMA_MPS)
    static = np.zeros(len(x), bool)
    off = residuals(velocity[None])[0]
    static[rows] = np.abs(off) < max(_SIGMA_MPS, 3 * sigma)
    spread = float(np.sum(off[agrees] ** 2)) / max(int(agrees.sum()) - 3, 1)
    covariance: FloatArray = np.multiply(max(spread, _LEAST_SIGMA_MPS**2), np.linalg.inv(normal))
    return SensorVelocity(velocity, covariance, static)


def _most_agreed(
    away: FloatArray,
    measured: FloatArray,
    residuals: Callable[[FloatArray], FloatArray],
    interval_mps: float | None,
) -> FloatArray:
    """The velocity (3,) of those of random draws of three returns with which most returns agree."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(measured), (_DRAWS, 3))
    speeds = measured[drawn]
    if interval_mps is not None:
        speeds = np.concatenate([speeds + fold * interval_mps for fold in _FOLDS])
        drawn = np.tile(drawn, (len(_FOLDS), 1))
    matrices = away[drawn]
    normal = np.einsum("kij,kil->kjl", matrices, matrices) + (_SIGMA_MPS / _ANY_MPS) ** 2 * np.eye(3)
    velocities = np.linalg.solve(normal, np.einsum("kij,ki->kj", matrices, speeds)[:, :, None])[:, :, 0]
    counts = (np.abs(residuals(velocities)) < _SIGMA_MPS).sum(axis=1)
    best: FloatArray = velocities[int(np.argmax(counts))]
    return best


def folding_interval_mps(doppler_mps: Sequence[NDArray[Any]]) -> float | None:
    """Width of the interval into which the sensor seems to fold speeds, m/s: None if the speeds do not fill one."""
    speeds = np.concatenate([np.asarray(values, np.float64) for values in doppler_mps])
    speeds = speeds[np.isfinite(speeds)]
    if len(speeds) < 100:
        return None
    # Folded speeds reach both ends of the interval, which lie about as far from 0.
    low, high = float(speeds.min()), float(speeds.max())
    edge = 0.05 * (high - low)
    symmetric = 0 < -low < 1.25 * high and high < -1.25 * low
    if not symmetric or min((speeds < low + edge).mean(), (speeds > high - edge).mean()) < 0.002:
        return None
    values = np.unique(np.abs(np.diff(np.unique(speeds))))
    step = float(values[values > 1e-6].min(initial=np.inf))
    return high - low + (step if step < 0.05 * (high - low) else 0.0)


def sensor_velocities(
    points: Sequence[NDArray[Any]],
    doppler_mps: Sequence[NDArray[Any]],
    others_mps: Sequence[NDArray[Any]] = (),
) -> list[SensorVelocity]:
    """The velocity in each of K scans of one sensor. `others_mps`: speeds of other scans, which help to find the folding interval."""
    interval = folding_interval_mps([*others_mps, *doppler_mps]) if points else None
    choices = [
        [sensor_velocity(x, v, interval_mps=folded) for x, v in zip(points, doppler_mps, strict=True)]
        for folded in ((None, interval) if interval else (None,))
    ]
    agreeing = [sum(int(velocity.static.sum()) for velocity in found) for found in choices]
    # Folding lets more returns agree by chance, so that it must explain clearly more.
    return choices[-1] if agreeing[-1] > 1.2 * agreeing[0] else choices[0]


def without_filler(
    points: Sequence[NDArray[Any]], doppler_mps: Sequence[NDArray[Any]]
) -> tuple[list[FloatArray], str | None]:
    """Doppler of K scans with NaN where a driver wrote a fixed value because it measured none, and a note on that."""
    # Many equal speeds are a filler if the other returns show a velocity that contradicts them, or if there are hardly any
    # others: a sensor that stands still and resolves speeds coarsely has many equal ones, too.
    speeds = [np.asarray(values, np.float64) for values in doppler_mps]
    values, counts = np.unique(np.concatenate([v[np.isfinite(v)] for v in speeds]), return_counts=True)
    if len(values) == 0 or counts.max() < _FILLER * counts.sum():
        return speeds, None
    filler, share = values[counts.argmax()] + 0.0, counts.max() / counts.sum()  # + 0.0: not -0
    others = [np.where(v == filler, np.nan, v) for v in speeds]
    contradicting, asked = 0, 0
    for x, v, velocity in zip(points, speeds, sensor_velocities(points, others), strict=True):
        filled = (v == filler) & x.any(axis=1)
        if velocity.found and filled.any():
            away = -x[filled] / np.linalg.norm(x[filled], axis=1)[:, None]
            expected = product(velocity.velocity_mps[None], np.ascontiguousarray(away.T))
            contradicting += int((np.abs(expected - filler) > 3 * _SIGMA_MPS).sum())
            asked += int(filled.sum())
    if 2 * contradicting > asked or (asked == 0 and share > _ONLY_FILLER):
        note = (
            f"{share:.0%} of the Doppler values are {filler:g} m/s: they were not measured, and are left out"
        )
        return others, note
    return speeds, None


_MIN_SHARE_WITH_VELOCITY = 0.5  # of the scans that have enough returns
_MAX_MOVING = 0.4  # share of the returns; if more disagree, it is the Doppler that is not understood


@dataclass(frozen=True)
class MovingReturns:
    """Which returns of F scans move."""

    masks: list[NDArray[np.bool_]]  # F arrays (N_i,). All False where a scan gives no velocity of the sensor
    why_none: str | None  # why none are named although there is Doppler, in words

    @classmethod
    def of(cls, points: Sequence[ArrayLike], doppler_mps: Sequence[ArrayLike]) -> MovingReturns:
        """The returns (N_i, 3), sensor frame, m, whose Doppler (N_i,), m/s or NaN, of either sign, disagrees with a static world."""
        scans, _, _ = check_scans(points)
        speeds, filler = without_filler(scans, checked_doppler(scans, doppler_mps))
        none = [np.zeros(len(scan), bool) for scan in scans]
        tried = [i for i, scan in enumerate(scans) if len(scan) >= MIN_DOPPLER_RETURNS]
        found = sensor_velocities([scans[i] for i in tried], [speeds[i] for i in tried])
        telling = [(i, velocity) for i, velocity in zip(tried, found, strict=True) if velocity.found]
        if len(telling) < max(1, _MIN_SHARE_WITH_VELOCITY * len(tried)):
            few = f"only {len(telling)} of {len(scans)} scans agree on a velocity of the sensor"
            return cls(none, filler or few)
        masks = list(none)
        for i, velocity in telling:
            masks[i] = ~velocity.static & np.isfinite(speeds[i]) & scans[i].any(axis=1)
        share = sum(int(masks[i].sum()) for i, _ in telling) / sum(len(masks[i]) for i, _ in telling)
        if share > _MAX_MOVING:
            return cls(none, f"{share:.0%} of the returns disagree with the sensor's own motion")
        return cls(masks, None)

    @property
    def count(self) -> int:
        return sum(int(mask.sum()) for mask in self.masks)

    def without(self, arrays: Sequence[ArrayLike]) -> list[NDArray[Any]]:
        return [np.asarray(array)[~mask] for array, mask in zip(arrays, self.masks, strict=True)]


@dataclass(frozen=True)
class StaticReturns:
    """The returns of F scans without those that move, as far as Doppler shows them."""

    points: Iterable[ArrayLike]  # F arrays (N_i, 3), sensor frame, m
    intensities: Iterable[ArrayLike] | None  # F arrays (N_i,), sensor units
    moving: int  # number of returns that were left out
    why_none: str | None  # as of :class:`MovingReturns`

    @classmethod
    def of(
        cls,
        points: Iterable[ArrayLike],
        intensities: Iterable[ArrayLike] | None,
        doppler_mps: Sequence[ArrayLike] | None,
        config: ReturnsConfig,
    ) -> StaticReturns:
        """All returns, if there is no Doppler or ``config.drop_moving`` is False; else see :meth:`MovingReturns.of`."""
        if doppler_mps is None or not config.drop_moving:
            return cls(points, intensities, 0, None)
        points = list(one_for_each_scan(points, "points"))
        intensities = None if intensities is None else list(one_for_each_scan(intensities, "intensities"))
        check_scans(points, intensities)
        moving = MovingReturns.of(points, doppler_mps)
        values = None if intensities is None else moving.without(intensities)
        return cls(moving.without(points), values, moving.count, moving.why_none)


def checked_doppler(scans: list[NDArray[Any]], doppler_mps: Sequence[ArrayLike]) -> list[NDArray[Any]]:
    """F arrays (N_i,) of numbers. Raises TypeError or ValueError where they are none, or do not fit to the scans."""
    speeds = [
        real_array(values, f"doppler_mps of scan {i}")
        for i, values in enumerate(one_for_each_scan(doppler_mps, "doppler_mps"))
    ]
    check_values_of_scans(speeds, scans, "doppler_mps")
    return speeds


def rays_as_measured(scans: Scans, config: FitConfig) -> Rays:
    """The static returns within the ranges of a fit, each seen from where its scan was taken. Intensity outliers are NaN."""
    static = StaticReturns.of(scans.points, scans.intensities, scans.doppler_mps, config.returns)
    limits: dict[str, Any] = {
        "min_range_m": config.returns.min_range_m,
        "max_range_m": config.returns.max_range_m,
    }
    return prepare(static.points, scans.poses, static.intensities, **limits)
