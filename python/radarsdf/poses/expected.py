# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Where a scan is expected, from the one before it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from radarsdf.poses.by_doppler import way
from radarsdf.poses.rates import Rate
from radarsdf.poses.rigid import Floats, rotation, skew, transform

_SPAN = 4.0  # standard deviations from end to end, that a search covers
_FEWEST, _MOST = 64, 8192  # poses of a search


@dataclass(frozen=True)
class ExpectedStep:
    """The motion from one scan to the next, in the frame of the first, before its returns are looked at."""

    turn: Rate
    """Rotation vector, rad, and its covariance."""
    begin_mps: Floats
    """(3,) velocity at the first scan, in its frame."""
    end_mps: Floats
    """(3,) at the second scan, in the frame of that."""
    way_covariance: Floats
    """(3, 3) of the translation if the turn is known, m²."""
    duration_s: float

    def pose(self, turn: Floats | None = None) -> Floats:
        """(..., 4, 4) of a sensor that turned by the rotation vectors `turn` (..., 3). None: as is expected."""
        turn = self.turn.mean if turn is None else turn
        return transform(turn, way(turn, self.begin_mps, self.end_mps, self.duration_s))

    def covariance(self, turn: Floats | None = None) -> Floats:
        """(6, 6) of translation and rotation vector, in the first frame. A sensor that turned more has gone elsewhere, too."""
        turn = self.turn.mean if turn is None else turn
        # Half of the way's second half turns with the sensor.
        swept = -skew((self.duration_s / 2 * rotation(turn) @ self.end_mps)[None])[0]
        both = np.concatenate([swept, np.eye(3)])
        found: Floats = both @ self.turn.covariance @ both.T
        found[:3, :3] += self.way_covariance
        return found

    def spread_m(self, radius_m: float) -> float:
        """Standard deviation of the place of a return so far away, m: largest over the directions."""
        moved = np.linalg.eigvalsh(self.covariance()[:3, :3])[-1]
        turned = np.linalg.eigvalsh(self.turn.covariance)[-1]
        return float(np.sqrt(max(moved + radius_m**2 * turned, 0.0)))

    def candidates(self, capture_m: float, radius_m: float) -> tuple[Floats, Floats]:
        """Turns (K, 3) and poses (K, 4, 4) that cover what is likely, about `capture_m` apart for returns so far away."""
        turns, turn_axes = np.linalg.eigh(self.turn.covariance)
        ways, way_axes = np.linalg.eigh(self.way_covariance)
        deviations = np.sqrt(np.maximum(np.concatenate([turns, ways]), 0.0))
        needed = np.maximum(1.0, _SPAN * deviations / np.repeat([capture_m / radius_m, capture_m], 3)).prod()
        count = int(np.clip(2 ** np.ceil(np.log2(needed)), _FEWEST, _MOST))
        # A quasi-random sequence leaves fewer holes than random numbers (Sobol 1967).
        draws = qmc.MultivariateNormalQMC(np.zeros(6), seed=0).random(count) * deviations
        drawn = self.turn.mean + draws[:, :3] @ turn_axes.T
        shifts: NDArray[np.float64] = draws[:, 3:] @ way_axes.T
        poses = self.pose(drawn)
        poses[:, :3, 3] += shifts
        return drawn, poses
