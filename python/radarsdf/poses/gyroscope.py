# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rotations from scan to scan that a gyroscope measured."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.poses.rates import Rate
from radarsdf.poses.rigid import Floats

# What a gyroscope begins with: the bias and the noise of cheap ones. The drive itself replaces them.
_FIRST_BIAS_RAD_S = 0.02
_FIRST_NOISE_RAD = 0.003


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
    def of(cls, angular_velocity: Floats, at_s: Floats, times_s: Floats) -> Gyroscope:
        """Of rates (G, 3), rad/s, frame of the sensor, measured at ascending times (G,), and scans at `times_s` (F,)."""
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
        bias = Rate(np.zeros(3), _FIRST_BIAS_RAD_S**2 * np.eye(3))
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
        """With the bias and the noise that rotations (F - 1, 3) show, with their covariance (F - 1, 3, 3). NaN: unknown."""
        known = np.isfinite(turns).all(axis=1) & (self.durations_s > 0)
        if known.sum() < 2:
            return self
        duration_s = self.durations_s[known, None, None]
        off = (self.turns - turns)[known]
        # Weighted least squares, with what is known of any gyroscope's bias.
        of_step = covariance[known] + self.noise_rad2 * self._spans[known, None, None] * np.eye(3)
        weights = np.linalg.inv(of_step)
        information = np.eye(3) / _FIRST_BIAS_RAD_S**2 + (weights * duration_s**2).sum(axis=0)
        sums = np.einsum("fij,fj->i", weights * duration_s, off)
        bias = Rate(np.linalg.solve(information, sums), np.linalg.inv(information))
        left = off - bias.mean * self.durations_s[known, None]
        squares = left**2 - np.einsum("fii->fi", covariance[known])
        noise = np.maximum(squares / self._spans[known, None], 0.0).mean()
        return dataclasses.replace(self, bias=bias, noise_rad2=float(max(noise, 1e-10)))
