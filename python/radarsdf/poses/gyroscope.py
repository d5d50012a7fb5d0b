# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rotations from scan to scan that a gyroscope measured."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from radarsdf.poses.motion import Rate
from radarsdf.poses.rigid import Floats, nearest_rotation

# Bias and noise of cheap gyroscopes, until the drive itself shows them.
FIRST_BIAS_RAD_S = 0.02
_FIRST_NOISE_RAD = 0.003
# Requirements on estimated axes.
_LEAST_TURNS = 20
_UNRELATED = 60  # shifts between the two sequences of turns, which show what chance explains
_BY_CHANCE = 1e-3
_KNOWN_RAD = 0.1  # standard deviation
_LEAST_STEPS = 4  # fewer turns contradict nothing
_MOST_BIAS_RAD_S = 0.35  # zero-rate offset of the cheapest gyroscopes: 20 degrees a second
# Mean squared deviation of a turn from the rates, per step, and as a multiple of that from a constant rate, from which on rates
# contradict the returns. Simulated drives of 9 kinds: 0.02 to 0.63 times; in wrong units, signs or axes 1.3 times and more.
_CONTRADICTED, _CONTRADICTED_SHARE = 12.0, 1.2


class UnusableGyroscopeError(ValueError):
    """The rates of a gyroscope contradict a drive, or the drive does not determine its axes."""


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
    noise_rad2: float = (
        _FIRST_NOISE_RAD**2
    )  # variance of a rotation over the median duration; it grows with time
    known_axes: bool = True  # False: they are not those of the radar

    @classmethod
    def of(
        cls,
        angular_velocity: Floats,
        at_s: Floats,
        times_s: Floats,
        bias_rad_s: float = FIRST_BIAS_RAD_S,
        known_axes: bool = True,
    ) -> Gyroscope:
        """Of rates (G, 3), rad/s, measured at ascending times (G,), and scans at `times_s` (F,)."""
        # Between two neighbouring times, of scans or rates, the rate is their mean (the trapezoidal rule).
        inner = at_s[(at_s > times_s[0]) & (at_s < times_s[-1])]
        edges = np.union1d(inner, times_s)
        rates = np.stack([np.interp(edges, at_s, angular_velocity[:, axis]) for axis in range(3)], 1)
        poses = cumulated(0.5 * (rates[1:] + rates[:-1]) * np.diff(edges)[:, None])
        poses = poses[np.searchsorted(edges, times_s)]
        turns = Rotation.from_matrix(np.einsum("fji,fjk->fik", poses[:-1], poses[1:])).as_rotvec()
        bias = Rate(np.zeros(3), bias_rad_s**2 * np.eye(3))
        return cls(turns, np.diff(times_s), bias, known_axes=known_axes)

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
        """With axes, bias and noise estimated from rotations (F - 1, 3) and their covariance (F - 1, 3, 3). NaN: unknown.

        Raises an UnusableGyroscopeError if they contradict the rates.
        """
        known = np.isfinite(turns).all(axis=1) & (self.durations_s > 0)
        turns, covariance, durations_s = turns[known], covariance[known], self.durations_s[known]
        noise = self._noise[known]
        measured = self.turns
        if not self.known_axes:
            variances = np.einsum("fii->f", covariance) / 3 + noise
            R = _axes(measured[known], turns, durations_s, variances)
            measured = np.einsum("ij,fj->fi", R, measured)
        if len(turns) < 2:
            return self
        weights = np.linalg.inv(covariance + noise[:, None, None] * np.eye(3))
        off = measured[known] - turns
        _check(off, turns, durations_s, weights, covariance)
        bias, information, _ = _fitted_bias(off, durations_s, weights, np.linalg.inv(self.bias.covariance))
        squares = (off - bias * durations_s[:, None]) ** 2 - np.einsum("fii->fi", covariance)
        ratio = np.maximum(squares / (noise / self.noise_rad2)[:, None], 0.0).mean()
        return dataclasses.replace(
            self,
            turns=measured,
            bias=Rate(bias, np.linalg.inv(information)),
            noise_rad2=float(max(ratio, 1e-10)),
            known_axes=True,
        )


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


def _axes(measured: Floats, found: Floats, durations_s: Floats, variances: Floats) -> Floats:
    """(3, 3) rotation that brings `measured` turns (K, 3) to those `found`. Raises an UnusableGyroscopeError if it is not clear."""
    why = "the drive does not show the axes of the IMU in the frame of the radar: give R_sensor_imu"
    count = len(found)
    if count < _LEAST_TURNS:
        raise UnusableGyroscopeError(why)
    R, sigma_rad, cost = _wahba(measured, found, durations_s, 1 / variances)
    shifts = np.unique(np.linspace(count // 8, count - count // 8, _UNRELATED).astype(np.int64))
    unrelated = (np.roll(measured, shift, axis=0) for shift in shifts)
    logs = np.log([_wahba(turns, found, durations_s, 1 / variances)[2] for turns in unrelated])
    needed = float(student.ppf(1 - _BY_CHANCE, len(logs) - 1)) * logs.std(ddof=1)
    if sigma_rad > _KNOWN_RAD or logs.mean() - np.log(cost) < needed:
        raise UnusableGyroscopeError(why)
    return R


def _wahba(measured: Floats, found: Floats, spans: Floats, weights: Floats) -> tuple[Floats, float, float]:
    """Rotation (3, 3) from vectors `measured` (F, 3) to `found` up to a constant rate, its largest deviation, rad, and the cost.

    Kabsch's solution of Wahba's problem, weighted.
    """
    share = weights * spans / (weights * spans**2).sum()
    a, b = (x - spans[:, None] * np.einsum("f,fi->i", share, x) for x in (measured, found))
    R = nearest_rotation(np.einsum("f,fi,fj->ij", weights, b, a))
    off = b - np.einsum("ij,fj->fi", R, a)
    cost = float(np.einsum("f,fi,fi->", weights, off, off))
    information = np.einsum("f,fi,fi->", weights, a, a) * np.eye(3) - np.einsum("f,fi,fj->ij", weights, a, a)
    variance = max(cost / (3 * len(a)), 1.0) / max(float(np.linalg.eigvalsh(information)[0]), 1e-12)
    return R, float(np.sqrt(variance)), max(cost, 1e-12)
