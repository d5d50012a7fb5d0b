"""Velocity of the sensor from the Doppler of a scan, and moving returns.

A static return in direction d of a sensor with velocity v has the Doppler ``-d·v``, negative where the sensor approaches.
RANSAC over draws of three returns gives v, which least squares refines. The method is that of C. Doer and G. Trommer,
"An EKF Based Approach to Radar Inertial Odometry", MFI 2020; the implementation is independent.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from radarsdf.arrays import Array, ArrayLike, Bools, Floats
from radarsdf.checks import one_for_each_scan, values_of_scans
from radarsdf.config.fit_config import FitConfig
from radarsdf.products import normal_matrix, product
from radarsdf.returns.rays import Rays, check_scans, prepare
from radarsdf.rig import Rig
from radarsdf.scans import Scans

MIN_DOPPLER_RETURNS = 10
"""Minimum number of returns of a scan that determine a velocity."""

# RANSAC draws of three returns. With 40 % moving, 38 draws contain one without moving returns with probability 0.9999.
_DRAWS = 64
_SIGMA_MPS = 0.15  # a return is an outlier if its residual exceeds three times the noise and this
_LEAST_SIGMA_MPS = 1e-3
_ROUNDS = 4
_MIN_AGREEING = 0.4  # minimum share of inliers
_FILLER = 0.2  # share of returns with the same speed from which on it may be a fill value
# Share from which on the other returns are too few to distinguish a stationary sensor from one that measures no Doppler.
_ONLY_FILLER = 0.9
# Prior standard deviation of a velocity component. It is all that is known of unobserved ones, as the vertical of a flat scan.
_ANY_MPS = 100.0
_FOLDS = (-1.0, 0.0, 1.0)  # ambiguity intervals by which the three returns of a draw may be aliased


@dataclass(frozen=True)
class SensorVelocity:
    """Velocity of the sensor estimated from the Doppler of one scan."""

    velocity_mps: Floats  # (3,) in the sensor frame. NaN if the returns do not agree
    covariance: Floats  # (3, 3) m²/s², large in unobserved directions
    static: Bools  # (N,) inliers of the velocity. All False without a velocity

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.velocity_mps).all())


def sensor_velocity(points: Array, doppler_mps: Array, interval_mps: float | None = None) -> SensorVelocity:
    """Estimate the velocity of the sensor from a scan (N, 3) with `doppler_mps` (N,), positive away from the sensor.

    NaN with fewer than 10 returns, or if less than 40 % of them are inliers. An unobserved component is 0 m/s, with a standard
    deviation of 100 m/s. `interval_mps`: width of the ambiguity interval into which the sensor aliases speeds.
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

    def residuals(velocities: Floats) -> Floats:
        off: Floats = measured - product(velocities, away_columns)
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
        # The median is robust against moving returns.
        sigma = min(1.4826 * float(np.median(np.abs(residuals(velocity[None])[0][agrees]))), _SIGMA_MPS)
        sigma = max(sigma, _LEAST_SIGMA_MPS)
    static = np.zeros(len(x), bool)
    off = residuals(velocity[None])[0]
    static[rows] = np.abs(off) < max(_SIGMA_MPS, 3 * sigma)
    spread = float(np.sum(off[agrees] ** 2)) / max(int(agrees.sum()) - 3, 1)
    covariance: Floats = np.multiply(max(spread, _LEAST_SIGMA_MPS**2), np.linalg.inv(normal))
    return SensorVelocity(velocity, covariance, static)


def _most_agreed(
    away: Floats, measured: Floats, residuals: Callable[[Floats], Floats], interval_mps: float | None
) -> Floats:
    """Return the velocity (3,) with the most inliers among random draws of three returns (RANSAC)."""
    drawn = np.random.default_rng(0).integers(0, len(measured), (_DRAWS, 3))
    speeds = measured[drawn]
    if interval_mps is not None:
        speeds = np.concatenate([speeds + fold * interval_mps for fold in _FOLDS])
        drawn = np.tile(drawn, (len(_FOLDS), 1))
    matrices = away[drawn]
    normal = np.einsum("kij,kil->kjl", matrices, matrices) + (_SIGMA_MPS / _ANY_MPS) ** 2 * np.eye(3)
    velocities = np.linalg.solve(normal, np.einsum("kij,ki->kj", matrices, speeds)[:, :, None])[:, :, 0]
    counts = (np.abs(residuals(velocities)) < _SIGMA_MPS).sum(axis=1)
    return velocities[int(np.argmax(counts))]


def folding_interval_mps(doppler_mps: Sequence[Array]) -> float | None:
    """Estimate the width of the ambiguity interval of the speeds, m/s. None if the speeds do not fill one."""
    speeds = np.concatenate([np.asarray(values, np.float64) for values in doppler_mps])
    speeds = speeds[np.isfinite(speeds)]
    if len(speeds) < 100:
        return None
    # Aliased speeds reach both ends of the interval, which is nearly symmetric about 0.
    low, high = float(speeds.min()), float(speeds.max())
    edge = 0.05 * (high - low)
    symmetric = 0 < -low < 1.25 * high and high < -1.25 * low
    if not symmetric or min((speeds < low + edge).mean(), (speeds > high - edge).mean()) < 0.002:
        return None
    values = np.unique(np.abs(np.diff(np.unique(speeds))))
    step = float(values[values > 1e-6].min(initial=np.inf))
    return high - low + (step if step < 0.05 * (high - low) else 0.0)


def sensor_velocities(
    points: Sequence[Array], doppler_mps: Sequence[Array], others_mps: Sequence[Array] = ()
) -> list[SensorVelocity]:
    """Estimate the velocity in each of K scans of a sensor. `others_mps`: further speeds to find the ambiguity interval."""
    interval = folding_interval_mps([*others_mps, *doppler_mps]) if points else None
    pairs, folds = list(zip(points, doppler_mps, strict=True)), (None, interval) if interval else (None,)
    choices = [[sensor_velocity(x, v, folded) for x, v in pairs] for folded in folds]
    agreeing = [sum(int(velocity.static.sum()) for velocity in found) for found in choices]
    # Aliasing lets more returns agree by chance, so it must explain clearly more of them.
    return choices[-1] if agreeing[-1] > 1.2 * agreeing[0] else choices[0]


def without_filler(points: Sequence[Array], doppler_mps: Sequence[Array]) -> tuple[list[Floats], str | None]:
    """Replace the fill value that a driver writes for unmeasured Doppler of K scans by NaN. Also return a note, or None."""
    # Many equal speeds are a fill value if the velocity of the other returns contradicts them, or if there are hardly any
    # others: a stationary sensor with a coarse speed resolution has many equal ones, too.
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
        equal = f"{share:.0%} of the Doppler values are {filler:g} m/s"
        return others, f"{equal}: they were not measured, and are left out"
    return speeds, None


_MIN_SHARE_WITH_VELOCITY = 0.5  # minimum share of the scans with enough returns that have a velocity
_MAX_MOVING = 0.4  # maximum share of the returns; if more disagree, the Doppler is misinterpreted


def moving_returns(
    points: Sequence[ArrayLike], doppler_mps: Sequence[ArrayLike], rig: Rig | None = None
) -> tuple[list[Bools], str | None]:
    """Return masks (N_i,) of the moving returns of scans (N_i, 3), sensor frame, m, and why Doppler was not used, in words.

    `doppler_mps` (N_i,): m/s, either sign, NaN where missing. The masks of a scan without a velocity of the sensor are False.
    Each radar of a `rig` is judged alone: they differ in the sign of the Doppler and in its ambiguity interval.
    """
    if rig is not None:
        masks, why = [np.zeros(0, bool)] * len(rig.of_scan), list[str]()
        for label, rows in rig.scans_of_radars().items():
            own, why_none = moving_returns([points[i] for i in rows], [doppler_mps[i] for i in rows])
            why += [] if why_none is None else [f"{label}: {why_none}"]
            for i, mask in zip(rows.tolist(), own, strict=True):
                masks[i] = mask
        return masks, "; ".join(why) or None
    scans, _, _ = check_scans(points)
    speeds, filler = without_filler(scans, values_of_scans(doppler_mps, scans, "doppler_mps"))
    none = [np.zeros(len(scan), bool) for scan in scans]
    tried = [i for i, scan in enumerate(scans) if len(scan) >= MIN_DOPPLER_RETURNS]
    found = sensor_velocities([scans[i] for i in tried], [speeds[i] for i in tried])
    telling = [(i, velocity) for i, velocity in zip(tried, found, strict=True) if velocity.found]
    if len(telling) < max(1, _MIN_SHARE_WITH_VELOCITY * len(tried)):
        return none, filler or f"only {len(telling)} of {len(scans)} scans agree on a velocity of the sensor"
    masks = list(none)
    for i, velocity in telling:
        masks[i] = ~velocity.static & np.isfinite(speeds[i]) & scans[i].any(axis=1)
    share = sum(int(masks[i].sum()) for i, _ in telling) / sum(len(masks[i]) for i, _ in telling)
    if share > _MAX_MOVING:
        return none, f"{share:.0%} of the returns disagree with the sensor's own motion"
    return masks, None


def static_rays(
    points: Iterable[ArrayLike],
    poses: ArrayLike,
    intensities: Iterable[ArrayLike] | None,
    doppler_mps: Sequence[ArrayLike] | None,
    rig: Rig | None,
    config: FitConfig,
    sigmas: Sequence[ArrayLike] | None = None,
    **options: Any,
) -> tuple[Rays, int, str | None]:
    """Prepare rays for a fit without :func:`moving_returns`; keep all without Doppler or ``config.returns.drop_moving``.

    Return them, the number of returns left out, and why Doppler was not used, in words. `options`: of :func:`prepare`, before
    those of `config`; the other arguments are also those of :func:`prepare`.
    """
    moving, why_none = 0, None
    if doppler_mps is not None and config.returns.drop_moving:
        points = list(one_for_each_scan(points, "points"))
        intensities = None if intensities is None else list(one_for_each_scan(intensities, "intensities"))
        check_scans(points, intensities)
        masks, why_none = moving_returns(points, doppler_mps, rig)
        moving = sum(int(mask.sum()) for mask in masks)

        def static(arrays: Sequence[ArrayLike]) -> list[Array]:
            return [np.asarray(array)[~mask] for array, mask in zip(arrays, masks, strict=True)]

        points = static(points)
        intensities, sigmas = (None if each is None else static(each) for each in (intensities, sigmas))
    rays = prepare(points, poses, intensities, rig=rig, sigmas=sigmas, **config.preparation | options)
    return rays, moving, why_none


def rays_as_measured(scans: Scans, config: FitConfig) -> Rays:
    """Return rays of the static returns within the ranges of a fit, without accumulating scans. Intensity outliers are NaN."""
    given = scans.points, scans.sensor_poses, scans.intensities, scans.doppler_mps, scans.rig
    return static_rays(*given, config, accumulate_scans=1, lattice=None)[0]
