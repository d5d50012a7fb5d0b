"""Velocities of a sensor, or of the body of several, from Doppler, and the motion between scans that they imply."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.stats import t as student
from typing_extensions import Self

from radarsdf.arrays import Array, Bools, Floats, Ints
from radarsdf.poses.motion import LEAST_S, Motion, MotionRate, interpolate, spans_of, usual_duration_s, way
from radarsdf.poses.rigid import rotation_vector, skew, step_vectors, steps
from radarsdf.products import normal_matrix
from radarsdf.returns.moving import (
    MIN_DOPPLER_RETURNS,
    SensorVelocity,
    folding_interval_mps,
    sensor_velocities,
)
from radarsdf.rig import Rig

# Measured (Astyx drives): errors of velocities exceed those of independent returns, as those of elevations in common do.
LEAST_MPS = 0.02
# Prior deviation of the vertical velocity, share of the speed, where Doppler is less precise. Slopes of roads: 0.05.
_CLIMB = 0.1
LEAST_STEP_M = 1e-4  # minimum deviation of a step, against division by zero
# Systematic error of all velocities of a drive in any direction, share of the speed: by the axes and the scale of the radar.
# Two radars on a motorway: 0.003 along it, 0.002 and 0.006 across.
_IN_COMMON = 0.003
_OFFSET_ERRORS = 6.0  # standard errors of a significant offset: noise of directions is common to the scans
_FEWEST_OFFSETS, _LEAST_OFFSET_MPS = 4, 1e-3  # scans, and deviation of a return, against division by zero
BY_CHANCE = 0.01  # significance level of a contradiction, of all windows of a drive together
FEWEST_STEPS = 6  # of a window
# Objects that move slower may pass as static: of those near a hand-held radar, 13 scans in succession had an offset of 0.1 m/s.
_PASSING_MPS = 0.15
_Velocities = Sequence[SensorVelocity]
NOT_USED = "The Doppler is not used"  # prefix of notes on it


class NoVelocityError(ValueError):
    """The Doppler of a drive yields no velocities."""


@dataclass(frozen=True)
class SensorVelocities:
    """Velocities of the sensor in its own frame, at each of F scans."""

    mean_mps: Floats  # (F, 3)
    covariance: Floats  # (F, 3, 3), m²/s²
    change: Floats  # (3,) spectral density of the acceleration by component (random walk), m²/s³
    found: Bools  # (F,) whether the returns agree on a velocity. Else it is interpolated
    # Standard deviation of the systematic error of all velocities in any direction, share of the speed.
    common_sigma: float = _IN_COMMON
    clock_sigma_s: float = 0.0  # standard deviation of the times of scans
    climb_assumed: int = 0  # number of scans with Doppler that hardly measures the vertical velocity
    of_scans: _Velocities = ()  # F estimates of each scan alone
    # Significant constant in the Doppler of all returns as given, m/s, from scan to scan.
    offset: tuple[float, int, int] | None = None

    @classmethod
    def of(
        cls, scans: Sequence[Floats], doppler_mps: Sequence[Array], times_s: Floats, each: _Velocities = ()
    ) -> "SensorVelocities":
        """Estimate from scans (N_i, 3), sensor frame, m, or those of `each`. Raise a NoVelocityError if less than half, or two, have one."""
        each = each or sensor_velocities(scans, doppler_mps)
        found = np.array([velocity.found for velocity in each], bool)
        if 2 * found.sum() < max(len(found), 2):
            needed = f"at least {MIN_DOPPLER_RETURNS} returns with Doppler in m/s, of which 40 % agree"
            msg = f"{found.sum()} of {len(found)} scans agree on a velocity of the sensor: {needed}"
            raise NoVelocityError(msg)
        means = np.stack([velocity.velocity_mps for velocity in each])
        covariance = np.stack([velocity.covariance for velocity in each]) + LEAST_MPS**2 * np.eye(3)
        mean, covariance, weak = upright(means, covariance)
        at = times_s[found]
        durations = np.diff(at)
        longest_s = 2 * np.median(durations) if len(durations) else 0.0
        usual = (durations > 0) & (durations <= longest_s)
        # Includes the noise of the velocities: an overestimate.
        squares = np.diff(mean[found], axis=0)[usual] ** 2
        change = squares.sum(axis=0) / max(durations[usual].sum(), 1e-9) + LEAST_MPS**2
        mean[~found] = interpolate(times_s[~found], at, mean[found])
        away_s = np.abs(at - times_s[~found, None]).min(axis=1)
        covariance[~found] = np.multiply.outer(away_s, np.diag(change)) + covariance[found].mean(axis=0)
        offset = _offset(each, scans, doppler_mps)
        return cls(mean, covariance, change, found, climb_assumed=weak, of_scans=each, offset=offset)

    def select(self, rows: slice | Ints) -> Self:
        columns = {name: getattr(self, name)[rows] for name in ("mean_mps", "covariance", "found")}
        return replace(self, of_scans=(), **columns)

    @property
    def usual_mps(self) -> float:
        """Median speed, m/s."""
        return float(np.median(np.linalg.norm(self.mean_mps, axis=1)))

    def scaled(self, factor: float, sigma: float = 0.0) -> "SensorVelocities":
        """Scale by a factor with relative deviation `sigma`. -1 for a radar with positive Doppler for approaching objects."""
        mean = factor * self.mean_mps
        covariance = factor**2 * self.covariance + sigma**2 * mean[:, :, None] * mean[:, None, :]
        return replace(self, mean_mps=mean, covariance=covariance, change=factor**2 * self.change)

    @property
    def of_steps(self) -> tuple[Floats, Floats, Floats]:
        """Velocities at the beginning and the end of steps, (F - 1, 3) each, and derivatives by turn rates, (F - 1, 3, 3) m."""
        begin_mps, end_mps = self.mean_mps[:-1], self.mean_mps[1:]
        return begin_mps, end_mps, np.broadcast_to(np.zeros((3, 3)), (len(end_mps), 3, 3))

    def step_covariance(self, i: int, duration_s: float) -> Floats:
        """Return the covariance (3, 3) of the step from scan `i`, m²: of both velocities, and a Brownian bridge between them."""
        ends = (self.covariance[i] + self.covariance[i + 1]) * duration_s**2 / 4
        clock = 2 * self.clock_sigma_s**2 * np.outer(self.mean_mps[i], self.mean_mps[i])
        return ends + np.diag(self.change) * duration_s**3 / 12 + clock

    def step_covariances(self, durations_s: Floats) -> Floats:
        """Return the covariances (F - 1, 3, 3) of all steps, m²."""
        return np.stack([self.step_covariance(i, d) for i, d in enumerate(durations_s.tolist())])


def windows_of(count: int) -> Iterator[slice]:
    """Yield all steps, their halves, quarters and so on, of at least `FEWEST_STEPS`."""
    parts = 1
    while count // parts >= FEWEST_STEPS:
        edges = np.linspace(0, count, parts + 1).astype(int).tolist()
        yield from map(slice, edges, edges[1:])
        parts *= 2


def slope_of(x: Floats, y: Floats) -> tuple[float, float, Floats]:
    """Regress y on x, (K,) or (K, 3), without intercept; return the slope, its standard error, and the residuals."""
    # Errors of the components of a step depend on each other: cluster-robust, with as many degrees of freedom as steps less one.
    count, square = len(x), max(float((x**2).sum()), 1e-12)
    slope = float((x * y).sum()) / square
    left = y - slope * x
    scores = (x * left).reshape(count, -1).sum(axis=1)
    return slope, float(np.sqrt((scores**2).sum() * count / (count - 1)) / square), left


def _offset(
    each: _Velocities, scans: Sequence[Floats], doppler: Sequence[Array]
) -> tuple[float, int, int] | None:
    """Return a significant constant in the Doppler of static returns, which in all directions is no velocity."""
    found = list[tuple[float, ...]]()
    if folding_interval_mps(doppler) is not None:
        return None  # aliased speeds hide it
    for i, (scan, speeds, velocity) in enumerate(zip(scans, doppler, each, strict=True)):
        used = velocity.static & np.isfinite(speeds) & scan.any(axis=1)
        if used.sum() <= 2 * MIN_DOPPLER_RETURNS:
            continue
        away = scan[used] / np.linalg.norm(scan[used], axis=1)[:, None]
        columns = np.column_stack([-away, np.ones(len(away))])
        fitted, squares, rank, _ = np.linalg.lstsq(columns, speeds[used], rcond=1e-3)
        if rank == 4:
            variance = max(squares[0] / (used.sum() - 4), _LEAST_OFFSET_MPS**2)
            inverse = np.linalg.inv(normal_matrix(columns, columns))
            found.append((i, fitted[3], np.sqrt(variance * inverse[3, 3])))
    tried = [slice(len(found)), *windows_of(len(found))] if len(found) >= _FEWEST_OFFSETS else []
    for window, least_mps in zip(tried, [LEAST_MPS, *[_PASSING_MPS] * len(tried)], strict=False):
        rows, offsets, sigmas = np.array(found[window]).T
        mean, error, _ = slope_of(1 / sigmas, offsets / sigmas)
        errors = max(_OFFSET_ERRORS, student.ppf(1 - BY_CHANCE / (2 * len(tried)), len(rows) - 1))
        if abs(mean) > max(errors * error, least_mps):
            return mean, int(rows[0]), int(rows[-1])
    return None


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
class DopplerMotion(Motion):
    """Translations between scans from velocities. They depend on the rotation of the sensor in between.

    Their variances are known: learning them made errors of real drives four times larger.
    """

    velocities: SensorVelocities
    durations_s: Floats  # (F - 1,)
    # (F - 1, 3) approximate rotation vectors of the steps: over a gap, a sensor may turn by more than half a turn.
    turns: Floats

    @classmethod
    def by(
        cls, velocities: SensorVelocities, times_s: Floats, poses: Floats, turns: Floats | None = None
    ) -> "DopplerMotion":
        """Build from times (F,) and approximate poses (F, 4, 4) of scans. `turns` None: those of the poses."""
        durations_s = np.diff(times_s)
        turns = step_vectors(poses)[:, 3:] if turns is None else turns
        ways = velocities.step_covariances(durations_s)
        shares = np.full((len(durations_s), 6), np.inf)
        shares[:, :3] = np.maximum(np.einsum("fii->fi", ways), LEAST_STEP_M**2)
        # A change of the turn rate bends the way: at constant angular acceleration, by a twelfth of the change in a step.
        timed = durations_s > 0  # else, two radars measured at once
        rates, each_s = turns[timed] / durations_s[timed, None], durations_s[timed]
        weights = np.square(np.minimum(each_s[1:], each_s[:-1]))
        bends_rad2_s2 = weights @ np.square(np.diff(rates, axis=0) / 12) / max(weights.sum(), LEAST_S**2)
        shares[:, :3] += np.square(skew(velocities.mean_mps[:-1])) @ bends_rad2_s2 * durations_s[:, None] ** 4
        spans = spans_of(times_s)
        speed_mps = np.sqrt((velocities.mean_mps**2).sum(axis=1).mean())
        common = np.repeat([velocities.common_sigma * speed_mps * usual_duration_s(durations_s), 0.0], 3)
        motion = cls(steps(poses), shares, spans, velocities, durations_s, turns, bias_sigma=common)
        return motion.updated(poses)

    def updated(self, poses: Floats, *_: Floats) -> "DopplerMotion":
        return self.turned(steps(poses)[:, :3, :3])

    def turned(self, rotations: Floats) -> "DopplerMotion":
        """Update the translations for rotations (F - 1, 3, 3) of the steps."""
        between, (begin, end, levers) = self.steps.copy(), self.velocities.of_steps
        between[:, :3, :3] = rotations
        turns = rotation_vector(rotations, self.turns)
        between[:, :3, 3] = way(turns, begin, end, self.durations_s[:, None], levers)
        return replace(self, steps=between)

    def jacobians(self, poses: Floats) -> tuple[Ints, Floats]:
        scans, jacobians = super().jacobians(poses)
        jacobians[:, :, :3] -= self.velocities.of_steps[2] @ jacobians[:, :, 3:]
        return scans, jacobians


_ANY_MPS, _TURN_RAD_S = 100.0, 0.3  # prior deviations of a component of a velocity and of a turn rate


@dataclass(frozen=True)
class BodyVelocities(SensorVelocities):
    """Velocities of the radars of a rig, in the axes of its body, and those of the body that follow from them.

    If the body moves at v and turns at ω, a radar at the lever arm l moves at v + ω x l. Each radar measures each step of the
    body, by its scans before and after it: together they measure the turn, too, if their lever arms differ.
    """

    of_radars_mps: Floats = field(kw_only=True)  # (K, F - 1, 3) velocity of each radar in each step
    variances: Floats = field(kw_only=True)  # (K, F - 1, 3, 3) m²/s²
    levers: Floats = field(kw_only=True)  # (K, 3, 3) cross-product matrices of the lever arms, m
    # Whether the radars agree in the mean. Two on a motorway differ by 0.4 m/s in the vertical, which would be 5 degrees a second
    # of pitch: before, they do not measure turns.
    agree: bool = False

    @classmethod
    def of_radars(cls, rig: Rig, measured: Sequence[tuple[Ints, SensorVelocities]], times_s: Floats) -> Self:
        """Build from the scans (N,) of each radar with Doppler and its velocities at them. `times_s` (F,): of all scans."""
        count, mountings = len(rig.of_scan), rig.mountings
        mean, covariance = np.zeros((count, 3)), np.tile(_ANY_MPS**2 * np.eye(3), (count, 1, 1))
        durations_s, middles_s = np.maximum(np.diff(times_s), LEAST_S), (times_s[:-1] + times_s[1:]) / 2
        of_radars_mps, variances, changes = [], [], []
        for rows, velocities in measured:
            R, own_s = mountings[rows[0], :3, :3], times_s[rows]
            mean[rows] = velocities.mean_mps @ R.T
            covariance[rows] = R @ velocities.covariance @ R.T
            changes.append(np.square(R) @ velocities.change)
            of_radars_mps.append(interpolate(middles_s, own_s, mean[rows]))
            after = np.clip(np.searchsorted(own_s, middles_s), 1, max(len(rows) - 1, 1))
            before, after = rows[after - 1], rows[np.minimum(after, len(rows) - 1)]
            # The errors of two scans of a radar are those of all steps between them, in proportion to their durations.
            apart_s = np.maximum(times_s[after] - times_s[before], durations_s)
            beyond_s = np.maximum(np.maximum(own_s[0] - middles_s, middles_s - own_s[-1]), 0.0)
            change = np.multiply.outer(apart_s**2 / 12 / durations_s + beyond_s, np.diag(changes[-1]))
            ends = (covariance[before] + covariance[after]) / 4
            variances.append(ends * (apart_s / durations_s)[:, None, None] + change)
        return cls(
            mean,
            covariance,
            np.min(changes, axis=0),  # they include the noise of each radar
            np.ones(count, bool),
            common_sigma=max(velocities.common_sigma for _, velocities in measured),
            clock_sigma_s=max(velocities.clock_sigma_s for _, velocities in measured),
            of_radars_mps=np.stack(of_radars_mps),
            variances=np.stack(variances),
            levers=skew(np.stack([mountings[rows[0], :3, 3] for rows, _ in measured])),
        )

    def select(self, rows: slice | Ints) -> Self:
        """Select consecutive scans; of others, velocities without those of steps."""
        found = super().select(rows)
        steps = slice(rows.start, rows.stop - 1) if isinstance(rows, slice) else slice(0)
        of_radars_mps, variances = self.of_radars_mps[:, steps], self.variances[:, steps]
        return replace(found, of_radars_mps=of_radars_mps, variances=variances)

    def learnt(self, turn_rates: Sequence[MotionRate | None]) -> "BodyVelocities":
        """Remove the mean difference of each radar from the others, given turn rates (F - 1), rad/s; None: unknown."""
        rows = np.array([i for i, rate in enumerate(turn_rates) if rate is not None], np.int64)
        if len(rows) == 0:
            return self
        rates = np.stack([rate.mean for rate in turn_rates if rate is not None])
        mean_mps, _, levers = self.of_steps
        body_mps = mean_mps[rows] + np.einsum("fij,fj->fi", levers[rows], rates)
        off = self.of_radars_mps[:, rows] - body_mps + np.einsum("kij,fj->kfi", self.levers, rates)
        information = self._information[:, rows]
        sums = np.einsum("kfij,kfj->ki", information, off)
        variances = np.linalg.inv(information.sum(axis=1))
        biases = np.einsum("kij,kj->ki", variances, sums)
        # What they have in common stays in the velocity of the body, which each radar knows up to its systematic error.
        common_mps = self.common_sigma * float(np.linalg.norm(body_mps, axis=1).mean())
        weights = np.linalg.inv(variances + common_mps**2 * np.eye(3))
        biases -= np.linalg.solve(weights.sum(axis=0), np.einsum("kij,kj->i", weights, biases))
        return replace(self, of_radars_mps=self.of_radars_mps - biases[:, None], agree=True)

    @cached_property
    def _information(self) -> Floats:
        return np.asarray(np.linalg.inv(self.variances), np.float64)

    @cached_property
    def _weights(self) -> tuple[Floats, Floats]:
        """Weights (K, F - 1, 3, 3) of the radars in the velocity of a step, and its covariances (F - 1, 3, 3)."""
        variances = np.linalg.inv(self._information.sum(axis=0))
        return variances @ self._information, variances

    @cached_property
    def of_steps(self) -> tuple[Floats, Floats, Floats]:
        weights, _ = self._weights
        mean = np.einsum("kfij,kfj->fi", weights, self.of_radars_mps)
        return mean, mean, np.einsum("kfij,kjl->fil", weights, self.levers)

    def step_covariance(self, i: int, duration_s: float) -> Floats:
        covariance: Floats = self._weights[1][i] * duration_s**2
        clock = 2 * self.clock_sigma_s**2 * np.outer(self.mean_mps[i], self.mean_mps[i])
        return covariance + clock

    def turn_given(self, turn: MotionRate, i: int, duration_s: float) -> MotionRate:
        """Return a turn (rad) in the step from scan `i`, given the differences of the velocities of the radars."""
        mean_mps, _, levers = self.of_steps
        if duration_s == 0 or not self.agree:
            return turn
        apart = (self.levers - levers[i]) / duration_s
        information = self._information[:, i]
        off = mean_mps[i] - self.of_radars_mps[:, i] - apart @ turn.mean
        # In the information form, of a turn that may be known exactly.
        total = np.einsum("kji,kjl,klm->im", apart, information, apart)
        covariance = turn.covariance @ np.linalg.inv(np.eye(3) + total @ turn.covariance)
        gradient = np.einsum("kji,kjl,kl->i", apart, information, off)
        return MotionRate(turn.mean + covariance @ gradient, covariance)

    def measure_turns(self, durations_s: Floats, least: float) -> bool:
        """Whether these velocities remove at least this share of the variance of yaws between scans."""
        usual = MotionRate(np.zeros(3), _TURN_RAD_S**2 * np.eye(3))
        steps = [(i, usual.integrate(d), d) for i, d in enumerate(durations_s.tolist()) if d > 0]
        left = [self.turn_given(turn, i, d).covariance[2, 2] / turn.covariance[2, 2] for i, turn, d in steps]
        return bool(np.median(left) <= 1 - least)
