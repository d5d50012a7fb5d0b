"""Velocities of the sensor from Doppler, and the motion between scans that they imply."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from typing_extensions import Self

from radarsdf.arrays import Array, Bools, Floats, Ints
from radarsdf.poses.motion import KnownMotion, spans_of, turned_halfway, usual_duration_s, way
from radarsdf.poses.rigid import rotation, rotation_vector, step_vectors, steps
from radarsdf.products import normal_matrix
from radarsdf.returns.moving import (
    MIN_DOPPLER_RETURNS,
    SensorVelocity,
    folding_interval_mps,
    sensor_velocities,
)

_SAMPLED, _PAIRS = 200, 40  # returns of a scan, and pairs of neighbouring scans, that determine the sign
_FEW_SAMPLED = 100  # returns of a scan, where many pairs are compared
_FIRST_PAIRS = 12
_FEW_PAIRS = 8  # pairs from which on their spread determines the standard error, else that of single returns
YAW_STEP_RAD = 0.07
"""Resolution of the yaws between neighbouring scans."""
_TURNS_RAD = YAW_STEP_RAD * np.arange(-6, 7)
_TURNS, _HALF_TURNS = (rotation(np.multiply.outer(share * _TURNS_RAD, [0.0, 0.0, 1.0])) for share in (1, 0.5))
CLEAR = 4.0
"""Standard errors by which scans must agree better with one sign of the Doppler."""
LEAST_M = 0.05
"""Minimum distance between returns that counts, m, below the noise of any radar."""
ERRORS = 3.0
"""Standard errors of a significant difference."""
# Measured (Astyx drives): the error of a velocity exceeds that of independent returns, as does one from
# elevations with a common error.
LEAST_MPS = 0.02
# Prior deviation of the vertical velocity, share of the speed, where Doppler is less precise. Slopes of roads: 0.05.
_CLIMB = 0.1
_LEAST_STEP_M = 1e-4  # minimum deviation of a step, against division by zero
# Systematic error of all velocities of a drive in any direction, share of the speed: by the axes and the scale of the radar.
# Two radars on a motorway: 0.003 along it, 0.002 and 0.006 across.
_IN_COMMON = 0.003
_OFFSET_ERRORS = 6.0  # standard errors of a significant offset: noise of directions is common to the scans
_FEWEST_OFFSETS, _LEAST_OFFSET_MPS = 4, 1e-3  # scans, and deviation of a return, against division by zero
NOT_USED = "The Doppler is not used"  # prefix of notes on it


class NoVelocityError(ValueError):
    """The Doppler of a drive yields no velocities."""


@dataclass(frozen=True)
class SensorVelocities:
    """Velocities of the sensor in its own frame, at each of F scans."""

    mean_mps: Floats  # (F, 3)
    covariance: Floats  # (F, 3, 3), m²/s²
    change: Floats  # (3,) spectral density of the acceleration by component (random walk), m²/s³
    static: list[Bools]  # F masks (N_i,) of the returns that agree with the velocity
    found: Bools  # (F,) whether the returns agree on a velocity. Else it is interpolated
    # Standard deviation of the systematic error of all velocities in any direction, share of the speed.
    common_sigma: float = _IN_COMMON
    clock_sigma_s: float = 0.0  # standard deviation of the times of scans
    climb_assumed: int = 0  # number of scans with Doppler that hardly measures the vertical velocity
    of_scans: Sequence[SensorVelocity] = ()  # F estimates of each scan alone

    @classmethod
    def of(cls, scans: Sequence[Floats], doppler_mps: Sequence[Array], times_s: Floats) -> SensorVelocities:
        """Estimate from scans (N_i, 3), sensor frame, m. Raise a NoVelocityError if less than half, or two, yield a velocity."""
        each = sensor_velocities(scans, doppler_mps)
        found = np.array([velocity.found for velocity in each], bool)
        if 2 * found.sum() < max(len(found), 2):
            msg = (
                f"{found.sum()} of {len(found)} scans agree on a velocity of the sensor: at least {MIN_DOPPLER_RETURNS} returns with "
                "Doppler in m/s, of which 40 % agree"
            )
            raise NoVelocityError(msg)
        means = np.stack([velocity.velocity_mps for velocity in each])
        covariance = np.stack([velocity.covariance for velocity in each]) + LEAST_MPS**2 * np.eye(3)
        mean, covariance, weak = upright(means, covariance)
        static = [
            velocity.static | np.isnan(speeds) if velocity.found else np.ones(len(scan), bool)
            for velocity, scan, speeds in zip(each, scans, doppler_mps, strict=True)
        ]
        at = times_s[found]
        durations = np.diff(at)
        usual = (durations > 0) & (durations <= 2 * np.median(durations))
        # Includes the noise of the velocities: an overestimate.
        squares = np.diff(mean[found], axis=0)[usual] ** 2
        change = squares.sum(axis=0) / max(durations[usual].sum(), 1e-9) + LEAST_MPS**2
        for i in np.flatnonzero(~found):
            mean[i] = [np.interp(times_s[i], at, mean[found, axis]) for axis in range(3)]
            away_s = np.abs(at - times_s[i]).min()
            covariance[i] = np.diag(change * away_s) + covariance[found].mean(axis=0)
        return cls(mean, covariance, change, static, found, climb_assumed=weak, of_scans=each)

    def select(self, rows: slice | Ints) -> Self:
        static = [self.static[i] for i in np.arange(len(self.static))[rows]]
        columns = {name: getattr(self, name)[rows] for name in ("mean_mps", "covariance", "found")}
        return dataclasses.replace(self, static=static, of_scans=(), **columns)

    @property
    def usual_mps(self) -> float:
        """Median speed, m/s."""
        return float(np.median(np.linalg.norm(self.mean_mps, axis=1)))

    def scaled(self, factor: float, sigma: float = 0.0) -> SensorVelocities:
        """Scale by a factor with relative deviation `sigma`. -1 for a radar with positive Doppler for approaching objects."""
        mean = factor * self.mean_mps
        covariance = factor**2 * self.covariance + sigma**2 * mean[:, :, None] * mean[:, None, :]
        return dataclasses.replace(self, mean_mps=mean, covariance=covariance, change=factor**2 * self.change)

    @property
    def of_steps(self) -> tuple[Floats, Floats, Floats | None]:
        """Velocities at the beginning and the end of steps, (F - 1, 3) each, and derivatives by turn rates, (F - 1, 3, 3) m."""
        return self.mean_mps[:-1], self.mean_mps[1:], None

    def step_covariance(self, i: int, duration_s: float) -> Floats:
        """Return the covariance (3, 3) of the step from scan `i`, m²: of both velocities, and a Brownian bridge between them."""
        ends = (self.covariance[i] + self.covariance[i + 1]) * duration_s**2 / 4
        between: Floats = ends + np.diag(self.change) * duration_s**3 / 12
        if self.clock_sigma_s:
            between = between + 2 * self.clock_sigma_s**2 * np.outer(self.mean_mps[i], self.mean_mps[i])
        return between

    def step_covariances(self, durations_s: Floats) -> Floats:
        """Return the covariances (F - 1, 3, 3) of all steps, m²."""
        return np.stack([self.step_covariance(i, d) for i, d in enumerate(durations_s.tolist())])


def radial_offset_mps(
    scans: Sequence[Floats], doppler_mps: Sequence[Array], velocities: SensorVelocities
) -> float:
    """Return a significant constant in the Doppler of all static returns, m/s, or 0.

    Returns in different directions distinguish it from a velocity.
    """
    offsets, variances = [], []
    if folding_interval_mps(doppler_mps) is not None:
        return 0.0  # aliased speeds hide it
    for scan, speeds, static, found in zip(
        scans, doppler_mps, velocities.static, velocities.found, strict=True
    ):
        used = static & np.isfinite(speeds) & scan.any(axis=1)
        if not found or used.sum() <= 2 * MIN_DOPPLER_RETURNS:
            continue
        away = scan[used] / np.linalg.norm(scan[used], axis=1)[:, None]
        columns = np.column_stack([-away, np.ones(len(away))])
        normal = normal_matrix(columns, columns)
        if np.linalg.cond(normal) > 1e6:
            continue
        inverse = np.linalg.inv(normal)
        fitted = np.einsum("ij,nj,n->i", inverse, columns, speeds[used])
        spread = float(((speeds[used] - np.einsum("ni,i->n", columns, fitted)) ** 2).sum()) / (used.sum() - 4)
        offsets.append(float(fitted[3]))
        variances.append(max(spread, _LEAST_OFFSET_MPS**2) * float(inverse[3, 3]))
    if len(offsets) < _FEWEST_OFFSETS:
        return 0.0
    weights = 1 / np.array(variances)
    mean = float((weights * offsets).sum() / weights.sum())
    squares = (weights**2 * (np.array(offsets) - mean) ** 2).sum() / weights.sum() ** 2
    error = float(np.sqrt(squares * len(offsets) / (len(offsets) - 1)))
    return mean if abs(mean) > max(_OFFSET_ERRORS * error, LEAST_MPS) else 0.0


def upright(mean_mps: Floats, covariance: Floats) -> tuple[Floats, Floats, int]:
    """Apply a prior on small vertical velocities: means (F, 3), covariances (F, 3, 3), and the number of changed ones.

    It applies where Doppler is less precise than the prior, as for a radar with all returns in a plane.
    """
    variances = covariance[:, 2, 2]
    climbed = np.nansum(mean_mps[:, 2] ** 2 / variances) / np.nansum(1 / variances)
    variance = max(_CLIMB**2 * np.nanmean((mean_mps[:, :2] ** 2).sum(axis=1)), climbed, LEAST_MPS**2)
    weak = variances > variance
    gain = np.where(weak[:, None], covariance[:, :, 2] / (covariance[:, 2, 2] + variance)[:, None], 0.0)
    mean = mean_mps - gain * mean_mps[:, 2:]
    return mean, covariance - np.einsum("fi,fj->fij", gain, covariance[:, 2]), int(weak.sum())


@dataclass(frozen=True)
class DopplerMotion(KnownMotion):
    """Translations between scans from velocities. They depend on the rotation of the sensor in between."""

    velocities: SensorVelocities
    durations_s: Floats  # (F - 1,)
    # (F - 1, 3) approximate rotation vectors of the steps: over a gap, a sensor may turn by more than half a turn.
    turns: Floats

    @classmethod
    def by(
        cls, velocities: SensorVelocities, times_s: Floats, poses: Floats, turns: Floats | None = None
    ) -> DopplerMotion:
        """Build from times (F,) and approximate poses (F, 4, 4) of scans. `turns` None: those of the poses."""
        durations_s = np.diff(times_s)
        turns = step_vectors(poses)[:, 3:] if turns is None else turns
        ways = velocities.step_covariances(durations_s)
        shares = np.full((len(durations_s), 6), np.inf)
        shares[:, :3] = np.maximum(np.einsum("fii->fi", ways), _LEAST_STEP_M**2)
        spans = spans_of(times_s, len(times_s))
        speed_mps = np.sqrt((velocities.mean_mps**2).sum(axis=1).mean())
        common = np.repeat([velocities.common_sigma * speed_mps * usual_duration_s(durations_s), 0.0], 3)
        unknown = np.zeros(6), np.ones(2), shares, spans, velocities, durations_s, turns
        return cls(steps(poses), *unknown, bias_sigma=common).at(poses)

    def at(self, poses: Floats) -> DopplerMotion:
        return self.turned(steps(poses)[:, :3, :3])

    def turned(self, rotations: Floats) -> DopplerMotion:
        """Update the translations for rotations (F - 1, 3, 3) of the steps."""
        between, (begin, end, levers) = self.steps.copy(), self.velocities.of_steps
        between[:, :3, :3] = rotations
        turns = rotation_vector(rotations, self.turns)
        between[:, :3, 3] = way(turns, begin, end, self.durations_s[:, None])
        if levers is not None:
            between[:, :3, 3] += turned_halfway(turns, np.einsum("fij,fj->fi", levers, turns))
        return dataclasses.replace(self, steps=between)

    def jacobians(self, poses: Floats) -> tuple[Floats, Floats]:
        both, levers = super().jacobians(poses), self.velocities.of_steps[2]
        if levers is not None:
            for jacobian in both:
                jacobian[:, :3] -= levers @ jacobian[:, 3:]
        return both


class _Pair:
    """Two scans, whose returns are compared with the nearest one of the other."""

    def __init__(self, first: Floats, second: Floats, sampled: int = _SAMPLED) -> None:
        self._trees = cKDTree(first), cKDTree(second)
        self._sampled = [scan[:: max(1, len(scan) // sampled)] for scan in (first, second)]

    def log_distances(self, turn: Floats, shifts_m: Floats) -> Floats:
        """Return log distances (K, M) to the nearest returns, if the second scan is turned by (3, 3) and shifted by (K, 3)."""
        # Queries are turned back, since trees are dearer.
        first, second = self._sampled
        of_second = self._trees[0].query(second @ turn.T + shifts_m[:, None])[0]
        of_first = self._trees[1].query((first - shifts_m[:, None]) @ turn)[0]
        return np.log(np.maximum(np.concatenate([of_second, of_first], axis=1), LEAST_M))


def log_distances(first: Floats, second: Floats, shifts_m: Floats) -> Floats:
    """Return mean log distances (K,) to the nearest returns of scans in common axes, the second after shifts (K, 3)."""
    return _Pair(first, second, _FEW_SAMPLED).log_distances(np.eye(3), shifts_m).mean(axis=1)


def sign_significance(
    scans: Sequence[Floats], velocities: SensorVelocities, times_s: Floats
) -> tuple[float, Floats]:
    """Return the standard errors by which scans agree better with velocities than reversed, and the yaws (2, F - 1) for both."""
    durations_s = np.diff(times_s)
    moved_m = 0.5 * (velocities.mean_mps[1:] + velocities.mean_mps[:-1]) * durations_s[:, None]
    usable = velocities.found[1:] & velocities.found[:-1] & (durations_s <= 2 * np.median(durations_s))
    usable &= np.array([min(len(a), len(b)) > 0 for a, b in itertools.pairwise(scans)], bool)
    # The longest steps are most informative: if the first are twice as clear as needed, the others are not compared, unless
    # the sensor turns so fast that each yaw is needed.
    pairs = sorted(np.flatnonzero(usable).tolist(), key=lambda i: -float(moved_m[i] @ moved_m[i]))
    yaws = np.full((2, len(durations_s)), np.nan)
    gains, significance = [], 0.0
    for some in (pairs[:_FIRST_PAIRS], pairs[_FIRST_PAIRS:_PAIRS], pairs[_PAIRS:]):
        for i in some:
            gain, yaws[:, i] = _reversal_gains(scans[i], scans[i + 1], moved_m[i])
            gains.append(gain)
        significance = _significance(gains) if gains else 0.0
        clear = abs(significance) > 2 * CLEAR or len(gains) >= min(_PAIRS, len(pairs))
        if clear and not turns_fast(yaws[int(significance < 0)]):
            break
    return significance, yaws


def turns_fast(yaws: Floats) -> bool:
    """Return whether yaws (F - 1,) between scans, NaN if unknown, are beyond those that tracking expects of an unknown sensor."""
    known = np.abs(yaws[np.isfinite(yaws)])
    return bool(len(known) and np.median(known) > YAW_STEP_RAD)


def _significance(gains: Sequence[Floats]) -> float:
    """Return the mean gain of pairs of scans, from those of their returns, in standard errors."""
    means = np.array([gain.mean() for gain in gains])
    if len(gains) < _FEW_PAIRS:
        # Returns of both scans count, mostly on the same objects: half of them are independent.
        variance = sum(2 * gain.var() / len(gain) for gain in gains) / len(gains) ** 2
    else:
        variance = means.var(ddof=1) / len(gains)
    return float(means.mean() / np.sqrt(max(variance, 1e-12)))


def motion_significance(pairs: Sequence[tuple[Floats, Floats]], motions: Iterable[Floats]) -> float:
    """Return by how many standard errors pairs of scans agree better after `motions` (4, 4) than after their rotations alone."""
    # Negative where a pattern that moves with the sensor, such as that of a straight wall, explains the returns better.
    gains = [
        _Pair(first, second).log_distances(motion[:3, :3], np.outer([0.0, 1.0], motion[:3, 3])).mean(axis=1)
        for (first, second), motion in zip(pairs, motions, strict=True)
        if min(len(first), len(second)) > 0
    ]
    if len(gains) < _FEW_PAIRS:
        return 0.0
    still, moved = np.transpose(gains)
    return float((still - moved).mean() / max((still - moved).std(ddof=1) / np.sqrt(len(gains)), 1e-6))


def _reversal_gains(first: Floats, second: Floats, moved_m: Floats) -> tuple[Floats, tuple[float, float]]:
    """Return how much nearer each return (M,) is after this motion than after its reverse, each with its best yaw, and these."""
    pair, both = _Pair(first, second), []
    for whole, half in zip(_TURNS, _HALF_TURNS, strict=True):
        both.append(pair.log_distances(whole, np.multiply.outer([1.0, -1.0], half @ moved_m)))
    ahead, back = np.swapaxes(both, 0, 1)
    i, j = int(ahead.mean(axis=1).argmin()), int(back.mean(axis=1).argmin())
    return back[j] - ahead[i], (float(_TURNS_RAD[i]), float(_TURNS_RAD[j]))
