# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rotations from scan to scan that a gyroscope measured."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from radarsdf.poses.motion import Rate
from radarsdf.poses.rigid import Floats, nearest_rotation

# What a gyroscope begins with: the bias and the noise of cheap ones. The drive itself replaces them.
FIRST_BIAS_RAD_S = 0.02
_FIRST_NOISE_RAD = 0.003
# How sure it must be how a gyroscope sits on the radar.
_LEAST_TURNS = 20
_LEAST_STEPS = 4  # fewer turns contradict nothing
_UNRELATED = 60  # shifts between two courses of turns that have nothing to do with each other, to see what chance explains
_BY_CHANCE = 1e-3
_HOW = "the drive does not show the axes of the IMU in the frame of the radar"
_KNOWN_RAD = 0.1  # standard deviation
_MOST_BIAS_RAD_S = 0.35  # zero-rate offset of the cheapest gyroscopes: 20 degrees a second
# Mean squared deviation of a turn from the rates, per step, and as a multiple of that from a constant rate, from which on rates
# contradict the returns. Simulated drives of 9 kinds: 0.02 to 0.63 times; in wrong units, signs or axes 1.3 times and more.
_CONTRADICTED, _CONTRADICTED_SHARE = 12.0, 1.2
_MISTAKES = {
    "deg/s, not rad/s": np.degrees(1.0),
    "mrad/s, not rad/s": 1e3,
    "of the opposite sign": -1.0,
}
"""Factors by which rates may be wrong."""


@dataclass(frozen=True)
class Gyroscope:
    """Rotations between F scans, with their errors."""

    turns: Floats
    """(F - 1, 3) rotation vectors in the frame of the first of two scans, rad."""
    durations_s: Floats
    """(F - 1,)."""
    bias: Rate
    """rad/s, that the measured rate has too much."""
    noise_rad2: float
    """Variance of each component of a rotation over the median duration; it grows with time."""

    @classmethod
    def of(
        cls, angular_velocity: Floats, at_s: Floats, times_s: Floats, bias_rad_s: float = FIRST_BIAS_RAD_S
    ) -> Gyroscope:
        """Of rates (G, 3), rad/s, frame of the sensor, measured at ascending times (G,), and scans at `times_s` (F,).

        `bias_rad_s` is the deviation of their bias.
        """
        # Between two neighbouring times, of scans or rates, the rate is their mean (the trapezoidal rule).
        inner = at_s[(at_s > times_s[0]) & (at_s < times_s[-1])]
        edges = np.union1d(inner, times_s)
        rates = np.stack([np.interp(edges, at_s, angular_velocity[:, axis]) for axis in range(3)], 1)
        small = Rotation.from_rotvec(0.5 * (rates[1:] + rates[:-1]) * np.diff(edges)[:, None])
        first = np.searchsorted(edges, times_s)
        turns = np.zeros((len(times_s) - 1, 3))
        for i, (low, high) in enumerate(itertools.pairwise(first)):
            if low < high:
                whole = small[low]
                for k in range(low + 1, high):
                    whole = whole * small[k]
                turns[i] = whole.as_rotvec()
        bias = Rate(np.zeros(3), bias_rad_s**2 * np.eye(3))
        return cls(turns, np.diff(times_s), bias, _FIRST_NOISE_RAD**2)

    @property
    def _spans(self) -> Floats:
        median = float(np.median(self.durations_s))
        return self.durations_s / median if median > 0 else np.ones(len(self.durations_s))

    def step(self, i: int) -> Rate:
        """The rotation vector from scan `i` to the next, rad."""
        duration_s = self.durations_s[i]
        covariance = self.bias.covariance * duration_s**2 + self.noise_rad2 * self._spans[i] * np.eye(3)
        return Rate(self.turns[i] - self.bias.mean * duration_s, covariance)

    def learnt(self, turns: Floats, covariance: Floats) -> Gyroscope:
        """With the bias and the noise that rotations (F - 1, 3) show, with their covariance (F - 1, 3, 3). NaN: unknown.

        Raises an :class:`UnusableGyroscopeError` if they contradict the rates.
        """
        known = np.isfinite(turns).all(axis=1) & (self.durations_s > 0)
        if known.sum() < 2:
            return self
        self._check(turns[known], covariance[known], known)
        duration_s = self.durations_s[known, None, None]
        off = (self.turns - turns)[known]
        # Weighted least squares, with what was known of the bias.
        of_step = covariance[known] + self.noise_rad2 * self._spans[known, None, None] * np.eye(3)
        weights = np.linalg.inv(of_step)
        before = np.linalg.inv(self.bias.covariance)
        information = before + (weights * duration_s**2).sum(axis=0)
        sums = np.einsum("fij,fj->i", weights * duration_s, off) + np.einsum(
            "ij,j->i", before, self.bias.mean
        )
        bias = Rate(np.linalg.solve(information, sums), np.linalg.inv(information))
        left = off - bias.mean * self.durations_s[known, None]
        squares = left**2 - np.einsum("fii->fi", covariance[known])
        noise = np.maximum(squares / self._spans[known, None], 0.0).mean()
        return dataclasses.replace(self, bias=bias, noise_rad2=float(max(noise, 1e-10)))

    def _check(self, turns: Floats, covariance: Floats, known: NDArray[np.bool_]) -> None:
        """Raises an UnusableGyroscopeError if these turns (K, 3) of the steps that are `known` contradict the rates."""
        durations_s = self.durations_s[known]
        noise = self.noise_rad2 * self._spans[known, None, None] * np.eye(3)
        weights = np.linalg.inv(covariance + noise)
        information = np.einsum("fij,f->ij", weights, durations_s**2)

        def fit(measured: Floats) -> tuple[float, Floats]:
            """Mean square of the deviations, but for a constant bias, and the bias (3,)."""
            off = measured - turns
            bias: Floats = np.linalg.solve(information, np.einsum("fij,fj,f->i", weights, off, durations_s))
            left = off - bias * durations_s[:, None]
            return float(np.einsum("fi,fij,fj->f", left, weights, left).mean()), bias

        measured = self.turns[known]
        (square, bias), constant = fit(measured), fit(0 * measured)[0]
        rate = float(np.linalg.norm(bias))
        contradicted = len(turns) > _LEAST_STEPS and square > max(
            _CONTRADICTED, _CONTRADICTED_SHARE * constant
        )
        # Turns that the returns hardly show all have the error of what was expected.
        unknown = float(np.sqrt(np.median(np.einsum("fii->f", covariance) / durations_s**2)))
        if not contradicted and rate < _MOST_BIAS_RAD_S + 3 * unknown:
            return
        squares = {name: fit(measured / factor)[0] for name, factor in _MISTAKES.items()}
        best = min(squares, key=squares.__getitem__)
        likely = (
            f"they seem to be {best}"
            if squares[best] < min(square, constant) / 2
            else "are they in the axes of the radar, and of this drive?"
        )
        msg = (
            f"its rates differ from the turns that the returns show by {np.sqrt(square / 3):.1f} standard deviations and a bias "
            f"of {rate:.2f} rad/s, a constant rate by {np.sqrt(constant / 3):.1f}: {likely}"
        )
        raise UnusableGyroscopeError(msg)


class UnusableGyroscopeError(ValueError):
    """The rates of a gyroscope cannot be those of a drive."""


class UnknownAxesError(UnusableGyroscopeError):
    """The turns of a drive do not tell how a gyroscope sits on the radar."""


@dataclass(frozen=True)
class UnalignedGyroscope(Gyroscope):
    """A gyroscope whose axes are not those of the radar. The drive tells how it sits there."""

    def learnt(self, turns: Floats, covariance: Floats) -> Gyroscope:
        """In the axes of the radar, as :meth:`Gyroscope.learnt`. Raises :class:`UnknownAxesError`."""
        known = np.isfinite(turns).all(axis=1) & (self.durations_s > 0)
        if known.sum() < _LEAST_TURNS:
            msg = f"{_HOW}: too few turns are known"
            raise UnknownAxesError(msg)
        weights = 3 / (np.einsum("fii->f", covariance[known]) + 3 * self.noise_rad2 * self._spans[known])
        measured, found, spans = self.turns[known], turns[known], self.durations_s[known]
        R, sigma_rad, cost = _wahba(measured, found, spans, weights)
        # What rotations explain that have nothing to do with each other.
        count = len(found)
        away = np.unique(np.linspace(count // 8, count - count // 8, _UNRELATED).astype(np.int64))
        logs = np.log([_wahba(np.roll(measured, k, axis=0), found, spans, weights)[2] for k in away])
        needed = float(student.ppf(1 - _BY_CHANCE, len(logs) - 1)) * logs.std(ddof=1)
        if sigma_rad > _KNOWN_RAD or logs.mean() - np.log(cost) < needed:
            msg = f"{_HOW}: their deviation would be {np.degrees(sigma_rad):.1f} degrees, or chance explains the turns as well. Give R_sensor_imu"
            raise UnknownAxesError(msg)
        in_radar = Gyroscope(
            np.einsum("ij,fj->fi", R, self.turns), self.durations_s, self.bias, self.noise_rad2
        )
        return in_radar.learnt(turns, covariance)


def _wahba(measured: Floats, found: Floats, spans: Floats, weights: Floats) -> tuple[Floats, float, float]:
    """Rotation (3, 3) that turns the vectors `measured` (F, 3) into those `found`, but for a constant rate; its deviation, rad,
    about the axis that is known least; and the weighted sum of squares that is left.

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
