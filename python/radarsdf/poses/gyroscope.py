# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rotations from scan to scan that a gyroscope measured."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.poses.motion import Rate
from radarsdf.poses.rigid import Floats

# Bias and noise of cheap gyroscopes, until the drive itself shows them.
FIRST_BIAS_RAD_S = 0.02
_FIRST_NOISE_RAD = 0.003
_LEAST_STEPS = 4  # fewer turns contradict nothing
_MOST_BIAS_RAD_S = 0.35  # zero-rate offset of the cheapest gyroscopes: 20 degrees a second
# Mean squared deviation of a turn from the rates, per step, and as a multiple of that from a constant rate, from which on rates
# contradict the returns. Simulated drives of 9 kinds: 0.02 to 0.63 times; in wrong units, signs or axes 1.3 times and more.
_CONTRADICTED, _CONTRADICTED_SHARE = 12.0, 1.2


class UnusableGyroscopeError(ValueError):
    """The rates of a gyroscope contradict a drive."""


def cumulated(turns: Floats) -> Floats:
    """(N + 1, 3, 3) cumulative products of rotation vectors (N, 3), the identity first."""
    count = len(turns) + 1
    width = int(np.ceil(np.sqrt(count)))
    padded = np.zeros((width * width, 3))
    padded[1:count] = turns
    found: Floats = Rotation.from_rotvec(padded).as_matrix().reshape(width, width, 3, 3)
    # Rows in parallel, then one row after another: few steps of many products each.
    for k in range(1, width):
        found[:, k] = found[:, k - 1] @ found[:, k]
    for row in range(1, width):
        found[row] = found[row - 1, -1] @ found[row]
    return found.reshape(-1, 3, 3)[:count]


@dataclass(frozen=True)
class Gyroscope:
    """Rotations between F scans, with their errors."""

    turns: Floats  # (F - 1, 3) rotation vectors in the frame of the first of two scans, rad
    durations_s: Floats  # (F - 1,)
    bias: Rate  # of the measured rate, rad/s
    noise_rad2: float = _FIRST_NOISE_RAD**2  # variance of a rotation over the median duration

    @classmethod
    def of(
        cls, angular_velocity: Floats, at_s: Floats, times_s: Floats, bias_rad_s: float = FIRST_BIAS_RAD_S
    ) -> Gyroscope:
        """Of rates (G, 3), rad/s, measured at ascending times (G,), and scans at `times_s` (F,)."""
        # Between two neighbouring times, of scans or rates, the rate is their mean (the trapezoidal rule).
        inner = at_s[(at_s > times_s[0]) & (at_s < times_s[-1])]
        edges = np.union1d(inner, times_s)
        rates = np.stack([np.interp(edges, at_s, angular_velocity[:, axis]) for axis in range(3)], 1)
        poses = cumulated(0.5 * (rates[1:] + rates[:-1]) * np.diff(edges)[:, None])
        poses = poses[np.searchsorted(edges, times_s)]
        turns = Rotation.from_matrix(np.einsum("fji,fjk->fik", poses[:-1], poses[1:])).as_rotvec()
        return cls(turns, np.diff(times_s), Rate(np.zeros(3), bias_rad_s**2 * np.eye(3)))

    @property
    def _noise(self) -> Floats:
        """(F - 1,) variance of each component of a rotation, rad²."""
        return self.noise_rad2 * self.durations_s / max(float(np.median(self.durations_s)), 1e-9)

    def step(self, i: int) -> Rate:
        """The rotation vector from scan `i` to the next, rad."""
        duration_s = self.durations_s[i]
        covariance = self.bias.covariance * duration_s**2 + self._noise[i] * np.eye(3)
        return Rate(self.turns[i] - self.bias.mean * duration_s, covariance)

    def learnt(self, turns: Floats, covariance: Floats) -> Gyroscope:
        """With the bias and the noise that rotations (F - 1, 3) show, with their covariance (F - 1, 3, 3). NaN: unknown.

        Raises an UnusableGyroscopeError if they contradict the rates.
        """
        known = np.isfinite(turns).all(axis=1) & (self.durations_s > 0)
        if known.sum() < 2:
            return self
        off, covariance, durations_s = (self.turns - turns)[known], covariance[known], self.durations_s[known]
        noise = self._noise[known]
        weights = np.linalg.inv(covariance + noise[:, None, None] * np.eye(3)).astype(np.float64)
        _check(off, turns[known], durations_s, weights, covariance)
        before = np.linalg.inv(self.bias.covariance).astype(np.float64)
        bias, information, _ = _fitted_bias(off, durations_s, weights, before)
        squares = (off - bias * durations_s[:, None]) ** 2 - np.einsum("fii->fi", covariance)
        noise_rad2 = np.maximum(squares * (self.noise_rad2 / noise)[:, None], 0.0).mean()
        fitted = Rate(bias, np.linalg.inv(information).astype(np.float64))
        return dataclasses.replace(self, bias=fitted, noise_rad2=float(max(noise_rad2, 1e-10)))


def _fitted_bias(
    off: Floats, durations_s: Floats, weights: Floats, before: Floats | float = 0.0
) -> tuple[Floats, Floats, float]:
    """Constant rate (3,) that rotations `off` (K, 3) show, its information (3, 3), and the mean squared residual.

    Weighted least squares; `before` is the information that the rate is 0.
    """
    information = before + np.einsum("fij,f->ij", weights, durations_s**2)
    bias: Floats = np.linalg.solve(information, np.einsum("fij,fj,f->i", weights, off, durations_s))
    left = off - bias * durations_s[:, None]
    return bias, information, float(np.einsum("fi,fij,fj->f", left, weights, left).mean())


def _check(off: Floats, turns: Floats, durations_s: Floats, weights: Floats, covariance: Floats) -> None:
    """Raises an UnusableGyroscopeError if rotations that are `off` (K, 3) from those of returns contradict them."""
    bias, _, square = _fitted_bias(off, durations_s, weights)
    constant = _fitted_bias(-turns, durations_s, weights)[2]
    rate = float(np.linalg.norm(bias))
    contradicted = len(off) > _LEAST_STEPS and square > max(_CONTRADICTED, _CONTRADICTED_SHARE * constant)
    # Turns that the returns hardly show all have the error of what was expected.
    unknown = float(np.sqrt(np.median(np.einsum("fii->f", covariance) / durations_s**2)))
    if contradicted or rate >= _MOST_BIAS_RAD_S + 3 * unknown:
        msg = (
            f"its rates differ from the turns that the returns show by {np.sqrt(square / 3):.1f} standard deviations and a bias "
            f"of {rate:.2f} rad/s: are they in rad/s, and in the axes of the radar?"
        )
        raise UnusableGyroscopeError(msg)
