# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The motion that an IMU measures, integrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.io.imu import Imu
from radarsdf.poses.rigid import Floats


@dataclass(frozen=True)
class ImuMotion:
    """The motion of an IMU, integrated."""

    times_s: Floats
    rates: Floats
    """(G, 3) rad/s without bias."""
    forces: Floats
    """(G, 3) m/s² without bias, in its axes."""
    turns: Floats
    """(G, 3, 3) to the frame of the first time."""
    part: Floats
    """(G,) number of the part of the drive."""

    @classmethod
    def of(cls, imu: Imu, rate_bias: Floats, force_bias: Floats) -> ImuMotion:
        assert imu.specific_force is not None
        parts = len(rate_bias)
        elapsed = imu.times_s - imu.times_s[0]
        part = np.minimum((elapsed / max(elapsed[-1], 1e-9) * parts).astype(np.int64), parts - 1)
        rates = imu.angular_velocity - rate_bias[part]
        durations = np.diff(imu.times_s)[:, None]
        turns = cumulated(0.5 * (rates[1:] + rates[:-1]) * durations)
        return cls(imu.times_s, rates, imu.specific_force - force_bias, turns, part)

    def integral(self, values: Floats) -> Floats:
        """Of values (G, …) over time, by the trapezoidal rule."""
        found = np.zeros_like(values)
        durations = np.diff(self.times_s).reshape(-1, *[1] * (values.ndim - 1))
        np.cumsum(0.5 * (values[1:] + values[:-1]) * durations, axis=0, out=found[1:])
        return found

    def at(self, values: Floats, times_s: Floats) -> Floats:
        """Values (G, …) at times between."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        width = self.times_s[after] - self.times_s[after - 1]
        share = np.where(width > 0, (times_s - self.times_s[after - 1]) / np.maximum(width, 1e-12), 1.0)
        share = np.clip(share, 0, 1).reshape(-1, *[1] * (values.ndim - 1))
        found: Floats = values[after - 1] + share * (values[after] - values[after - 1])
        return found

    def turns_at(self, times_s: Floats) -> Floats:
        """(F, 3, 3) rotations at times between."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        left = (times_s - self.times_s[after - 1])[:, None]
        small = Rotation.from_rotvec(self.rates[after - 1] * left).as_matrix()
        found: Floats = np.einsum("fij,fjk->fik", self.turns[after - 1], small)
        return found


def cumulated(turns: Floats) -> Floats:
    """(N + 1, 3, 3) products of rotation vectors (N, 3), the identity first: where a body is that turns so, step after step."""
    count = len(turns) + 1
    width = int(np.ceil(np.sqrt(count)))
    padded = np.zeros((width * width, 3))
    padded[1:count] = turns
    found: Floats = Rotation.from_rotvec(padded).as_matrix().reshape(width, width, 3, 3)
    # Rows side by side, then one row after another: few steps of many products each.
    for k in range(1, width):
        found[:, k] = np.einsum("rij,rjk->rik", found[:, k - 1], found[:, k])
    for row in range(1, width):
        found[row] = np.einsum("ij,kjl->kil", found[row - 1, -1], found[row])
    return found.reshape(-1, 3, 3)[:count]
