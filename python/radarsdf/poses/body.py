"""Velocities of a body from those of the radars that it carries."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from typing_extensions import Self

from radarsdf.arrays import Floats, Ints
from radarsdf.poses.doppler import SensorVelocities
from radarsdf.poses.imu import interpolate
from radarsdf.poses.motion import MotionRate
from radarsdf.poses.rigid import skew
from radarsdf.rig import Rig

_ANY_MPS, _TURN_RAD_S = 100.0, 0.3  # prior deviations of a component of a velocity and of a turn rate
_LEAST_S = 1e-6  # of a step, against division by zero


class MeasuredScans(NamedTuple):
    """Scans of one or several radars, with times and velocities by Doppler."""

    rows: Ints  # (K,) among the scans of all radars
    scans: list[Floats]  # (N_i, 3) static returns, frame of the poses, m
    times_s: Floats | None
    velocities: SensorVelocities | None


def join_radars(rig: Rig | None, radars: Sequence[MeasuredScans]) -> MeasuredScans:
    """Return the scans of all radars in order, in the frame of the body."""
    if rig is None:
        return radars[0]
    rows = np.concatenate([each.rows for each in radars])
    order, scans = np.argsort(rows), [scan for each in radars for scan in each.scans]
    known = [each.times_s for each in radars if each.times_s is not None]
    # They need not ascend after a correction of those of one radar.
    times_s = np.maximum.accumulate(np.concatenate(known)[order]) if known else None
    measured = [(each.rows, each.velocities) for each in radars if each.velocities is not None]
    velocities = None
    if measured and times_s is not None:
        velocities = BodyVelocities.of_radars(rig, measured, times_s)
    return MeasuredScans(rows[order], rig.in_body([scans[i] for i in order]), times_s, velocities)


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
    def of_radars(
        cls, rig: Rig, measured: Sequence[tuple[Ints, SensorVelocities]], times_s: Floats
    ) -> BodyVelocities:
        """Build from the scans (N,) of each radar with Doppler and its velocities at them. `times_s` (F,): of all scans."""
        count, mountings = len(rig.of_scan), rig.mountings
        mean, covariance = np.zeros((count, 3)), np.tile(_ANY_MPS**2 * np.eye(3), (count, 1, 1))
        durations_s, middles_s = np.maximum(np.diff(times_s), _LEAST_S), (times_s[:-1] + times_s[1:]) / 2
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
            [np.zeros(0, bool)] * count,  # moving returns were left out before
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
        return dataclasses.replace(found, of_radars_mps=of_radars_mps, variances=variances)

    def learnt(self, turn_rates: Sequence[MotionRate | None]) -> BodyVelocities:
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
        biases = np.linalg.solve(information.sum(axis=1), sums[:, :, None])[:, :, 0]
        return dataclasses.replace(self, of_radars_mps=self.of_radars_mps - biases[:, None], agree=True)

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
        """Return the covariance (3, 3) of the step from scan `i`, m²."""
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
