"""Rotations from a gyroscope, with bias and noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.poses.motion import MotionRate, usual_duration_s
from radarsdf.poses.rigid import rotation, rotation_vector

# Prior bias and noise, of cheap gyroscopes, until they are estimated from the drive.
FIRST_BIAS_RAD_S = 0.02
_FIRST_NOISE_RAD = 0.003
_LEAST_STEPS = 4  # minimum number of turns for a contradiction
_MOST_BIAS_RAD_S = 0.35  # zero-rate offset of the cheapest gyroscopes: 20 degrees a second
# Gate on the mean squared residual of turns from the rates, absolute and relative to that from a constant rate. Simulated
# drives of 9 kinds: 0.02 to 0.63 times; in wrong units, signs or axes 1.3 times and more.
_CONTRADICTED, _CONTRADICTED_SHARE = 12.0, 1.2


class UnusableGyroscopeError(ValueError):
    """The rates of a gyroscope contradict a drive."""


def cumulate_turns(turns: Floats) -> Floats:
    """Return the cumulative products (N + 1, 3, 3) of rotation vectors (N, 3), the identity first."""
    count = len(turns) + 1
    width = int(np.ceil(np.sqrt(count)))
    padded = np.zeros((width * width, 3))
    padded[1:count] = turns
    found = rotation(padded).reshape(width, width, 3, 3)
    # Scan within rows in parallel, then across rows: few steps of many products each.
    for k in range(1, width):
        found[:, k] = found[:, k - 1] @ found[:, k]
    for row in range(1, width):
        found[row] = found[row - 1, -1] @ found[row]
    return found.reshape(-1, 3, 3)[:count]


def integrate_rates(times_s: Floats, rates: Floats) -> Floats:
    """Return the rotations (G, 3, 3) to the first frame, from rates (G, 3), rad/s, by the trapezoidal rule."""
    return cumulate_turns(0.5 * (rates[1:] + rates[:-1]) * np.diff(times_s)[:, None])


def interpolate(times_s: Floats, at_s: Floats, values: Floats) -> Floats:
    """Interpolate values (G, 3) at ascending times (G,) linearly at `times_s` (F,)."""
    return np.stack([np.interp(times_s, at_s, column) for column in values.T], 1)


@dataclass(frozen=True)
class Gyroscope:
    """Rotations between F scans, with their errors."""

    turns: Floats  # (F - 1, 3) rotation vectors in the frame of the first of two scans, rad
    durations_s: Floats  # (F - 1,)
    bias: MotionRate  # bias of the measured rate, rad/s
    noise_rad2: float = _FIRST_NOISE_RAD**2  # variance of a rotation over the median duration

    @classmethod
    def of(
        cls, angular_velocity: Floats, at_s: Floats, times_s: Floats, bias_rad_s: float = FIRST_BIAS_RAD_S
    ) -> Gyroscope:
        """Integrate rates (G, 3), rad/s, at ascending times (G,) between scans at `times_s` (F,)."""
        inner = at_s[(at_s > times_s[0]) & (at_s < times_s[-1])]
        edges = np.union1d(inner, times_s)
        rates = interpolate(edges, at_s, angular_velocity)
        poses = integrate_rates(edges, rates)[np.searchsorted(edges, times_s)]
        turns = rotation_vector(np.einsum("fji,fjk->fik", poses[:-1], poses[1:]))
        return cls(turns, np.diff(times_s), MotionRate(np.zeros(3), bias_rad_s**2 * np.eye(3)))

    @property
    def _noise(self) -> Floats:
        """Variance (F - 1,) of each component of a rotation, rad²."""
        return self.noise_rad2 * self.durations_s / max(usual_duration_s(self.durations_s), 1e-9)

    def step(self, i: int) -> MotionRate:
        """Return the rotation vector from scan `i` to the next, rad."""
        duration_s = self.durations_s[i]
        covariance = self.bias.covariance * duration_s**2 + self._noise[i] * np.eye(3)
        return MotionRate(self.turns[i] - self.bias.mean * duration_s, covariance)

    def learnt(self, rates: Sequence[MotionRate | None]) -> Gyroscope:
        """Estimate bias and noise from turn rates, rad/s. Raise an UnusableGyroscopeError if they contradict the gyroscope."""
        known = {i: rate for i, rate in enumerate(rates) if rate is not None and self.durations_s[i] > 0}
        if len(known) < 2:
            return self
        rows, motions = list(known), [rate.integrate(self.durations_s[i]) for i, rate in known.items()]
        durations_s, noise = self.durations_s[rows], self._noise[rows]
        turns = np.stack([motion.mean for motion in motions])
        covariance = np.stack([motion.covariance for motion in motions])
        off = self.turns[rows] - turns
        weights = np.linalg.inv(covariance + noise[:, None, None] * np.eye(3)).astype(np.float64)
        _check_agreement(off, turns, durations_s, weights, covariance)
        prior = np.linalg.inv(self.bias.covariance).astype(np.float64)
        bias, information, _ = _fit_bias(off, durations_s, weights, prior)
        squares = (off - bias * durations_s[:, None]) ** 2 - np.einsum("fii->fi", covariance)
        noise_rad2 = np.maximum(squares * (self.noise_rad2 / noise)[:, None], 0.0).mean()
        fitted = MotionRate(bias, np.linalg.inv(information).astype(np.float64))
        return dataclasses.replace(self, bias=fitted, noise_rad2=float(max(noise_rad2, 1e-10)))


def _fit_bias(
    off: Floats, durations_s: Floats, weights: Floats, before: Floats | float = 0.0
) -> tuple[Floats, Floats, float]:
    """Fit a constant rate to rotations `off` (K, 3), with prior information `before` at 0: rate, information, mean square."""
    information = before + np.einsum("fij,f->ij", weights, durations_s**2)
    bias: Floats = np.linalg.solve(information, np.einsum("fij,fj,f->i", weights, off, durations_s))
    left = off - bias * durations_s[:, None]
    return bias, information, float(np.einsum("fi,fij,fj->f", left, weights, left).mean())


def _check_agreement(
    off: Floats, turns: Floats, durations_s: Floats, weights: Floats, covariance: Floats
) -> None:
    """Raise an UnusableGyroscopeError if the residual rotations `off` (K, 3) are too large or biased."""
    bias, _, square = _fit_bias(off, durations_s, weights)
    constant = _fit_bias(-turns, durations_s, weights)[2]
    rate = float(np.linalg.norm(bias))
    contradicted = len(off) > _LEAST_STEPS and square > max(_CONTRADICTED, _CONTRADICTED_SHARE * constant)
    # Turns that the returns hardly observe share the error of their prediction.
    unknown = float(np.sqrt(np.median(np.einsum("fii->f", covariance) / durations_s**2)))
    if contradicted or rate >= _MOST_BIAS_RAD_S + 3 * unknown:
        off_by = f"{np.sqrt(square / 3):.1f} standard deviations and a bias of {rate:.2f} rad/s"
        what = f"its rates differ from the turns that the returns show by {off_by}"
        msg = f"{what}: are they in rad/s, and in the axes of the radar?"
        raise UnusableGyroscopeError(msg)
