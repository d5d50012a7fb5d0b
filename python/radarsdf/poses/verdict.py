# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Whether returns that took no part agree better."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import t as student

from radarsdf.poses.planes import SensorReturns
from radarsdf.poses.rigid import Floats

_NEIGHBOURS = 8  # of a return, among which the nearest one of another scan is looked for
_MOST_RETURNS = 50_000  # that are asked
_BY_CHANCE = (
    1e-3  # probability that true poses seem improved. Of 48 simulated drives, seeds 101 to 112, none were
)
_HELD_OUT = 0.2  # of the returns


def held_out(count: int, seed: int) -> NDArray[np.bool_]:
    """(count,) which returns take no part, so that they may judge."""
    return np.random.default_rng(seed).random(count) < _HELD_OUT


@dataclass(frozen=True)
class Verdict:
    """How much nearer returns are to those of other scans."""

    gain: float
    """Mean over the scans of the mean logarithm of the distance to the nearest return of another scan, with the poses before,
    less the same after."""
    error: float
    """Its standard error."""
    scans: int
    """Number of scans that tell it."""

    @property
    def needed(self) -> float:
        """The gain that is no chance: Student's t. With few scans, the standard error is uncertain, too."""
        return float(student.ppf(1 - _BY_CHANCE, self.scans - 1)) * self.error if self.scans > 1 else np.inf

    @property
    def improved(self) -> bool:
        """Whether the gain is significant."""
        return self.gain > self.needed

    @property
    def words(self) -> str:
        """One sentence."""
        figures = f"{self.gain:+.2%} of their distance, by chance less than {self.needed:.2%} in {1 - _BY_CHANCE:.1%} of all cases"
        if self.improved:
            return f"The refined poses make a sharper map: returns that took no part are nearer to those of other scans ({figures})."
        return f"The given poses are kept: returns that took no part are not nearer to those of other scans ({figures})."

    @classmethod
    def of(cls, held: SensorReturns, used: SensorReturns, before: Floats, after: Floats) -> Verdict:
        """Of the returns `held` that took no part, beside those that were `used`.

        Returns of a scan have errors in common, so that scans are counted. Blocks of them gave true poses no other
        errors, but hid what a single jump costs, which only the scans near it tell.
        """
        step = max(1, len(held) // _MOST_RETURNS)
        asked = held.select(np.arange(len(held)) % step == 0)
        gains = np.log(_distances(asked, used, before) / _distances(asked, used, after))
        counts = np.bincount(asked.scans)
        means = np.bincount(asked.scans, gains)[counts > 0] / counts[counts > 0]
        if len(means) < 2:
            return cls(0.0, np.inf, len(means))
        return cls(float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means))), len(means))


def _distances(asked: SensorReturns, used: SensorReturns, poses: Floats) -> NDArray[np.float64]:
    tree = cKDTree(used.posed(poses).points)
    distances, rows = tree.query(asked.posed(poses).points, _NEIGHBOURS)
    others = used.scans[np.minimum(rows, len(used) - 1)] != asked.scans[:, None]
    first = np.where(others.any(axis=1), others.argmax(axis=1), _NEIGHBOURS - 1)
    found: NDArray[np.float64] = distances[np.arange(len(first)), first]
    return np.maximum(found, 1e-3)
