# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Whether returns that took no part agree better."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
_PLACE = 0.25  # edge of a place, in median ranges: what is seen as one thing from near and far is smaller


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
    parts: int
    """Number of scans that tell it, or of places, if these are fewer."""

    @property
    def needed(self) -> float:
        """The gain that is no chance: Student's t. With few scans or places, the standard error is uncertain, too."""
        return float(student.ppf(1 - _BY_CHANCE, self.parts - 1)) * self.error if self.parts > 1 else np.inf

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

        Returns do not judge one by one. Those of a scan have the errors of its pose in common, and so have neighbouring scans,
        since errors of poses last. Those of a place may lie on one thing that moved, or that looks different from everywhere.
        The standard error is the largest that one of these gives.
        """
        if len(held) == 0:
            return cls(0.0, np.inf, 0)
        step = max(1, len(held) // _MOST_RETURNS)
        asked = held.select(np.arange(len(held)) % step == 0)
        gains = np.log(_distances(asked, used, before) / _distances(asked, used, after))
        edge_m = _PLACE * float(np.median(asked.ranges_m))
        cells = np.floor(asked.posed(before).points / edge_m)
        places = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        means = means_of(gains, asked.scans)
        parts = min(len(means), int(places.max()) + 1)
        if parts < 2:
            return cls(0.0, np.inf, parts)
        return cls(float(means.mean()), max(_error_of_scans(means), _error_of_places(gains, places)), parts)


def means_of(gains: Floats, groups: NDArray[np.integer[Any]]) -> Floats:
    """(G,) mean of the gains (N,) of each group that has some. `groups` (N,): the number of the group of each."""
    counts = np.bincount(groups)
    found: Floats = np.bincount(groups, gains)[counts > 0] / counts[counts > 0]
    return found


def _error_of_scans(means: Floats) -> float:
    """Standard error of the mean of those of scans (F,), in which neighbours are alike (Newey and West 1987, with their lags of
    1994)."""
    count, off = len(means), means - means.mean()
    lags = min(int(4 * (count / 100) ** (2 / 9)), count - 1)
    alone = (off**2).sum()
    alike = [(1 - lag / (lags + 1)) * (off[lag:] * off[:-lag]).sum() for lag in range(1, lags + 1)]
    together = alone + 2 * sum(alike)
    return float(np.sqrt(max(alone, together) / (count * (count - 1))))


def _error_of_places(gains: Floats, places: NDArray[np.int64]) -> float:
    """Standard error of the mean of gains (N,) of which those of a place (N,) may all be wrong together."""
    sums = np.bincount(places, gains - gains.mean())
    return float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)) / len(gains))


def _distances(asked: SensorReturns, used: SensorReturns, poses: Floats) -> NDArray[np.float64]:
    tree = cKDTree(used.posed(poses).points)
    distances, rows = tree.query(asked.posed(poses).points, _NEIGHBOURS)
    others = used.scans[np.minimum(rows, len(used) - 1)] != asked.scans[:, None]
    first = np.where(others.any(axis=1), others.argmax(axis=1), _NEIGHBOURS - 1)
    found: NDArray[np.float64] = distances[np.arange(len(first)), first]
    return np.maximum(found, 1e-3)
