# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The verdict: whether held-out returns agree better."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import t as student

from radarsdf.poses.planes import SensorReturns
from radarsdf.poses.rigid import Floats
from radarsdf.returns.noise import SensorNoise

_NEIGHBOURS = 16  # of a return, of which those of other scans make the density there
_MOST_RETURNS = 20_000  # that are asked
_BY_CHANCE = 1e-3  # probability that true poses seem improved
# However certain, a smaller gain is none. Measured: up to 0.0006 with true poses, 0.0015 and more where a drift of 0.01 m and 0.05
# degrees a step is found.
_LEAST_GAIN = 0.001
_HELD_OUT = 0.2  # of the returns
_PLACE = 0.25  # edge of a place, in median ranges: what is seen as one thing from near and far is smaller
# Edge of a cell, in median ranges, whose returns of other scans only say that scans overlap there.
_NEARBY = 0.5
_MOST_COUNTED = 100_000  # returns of these cells


def held_out(count: int, seed: int) -> NDArray[np.bool_]:
    """(count,) which returns take no part, so that they may judge."""
    return np.random.default_rng(seed).random(count) < _HELD_OUT


@dataclass(frozen=True)
class Verdict:
    """How much better returns agree with those of other scans."""

    gain: float
    """Mean over the scans of the mean logarithm of the density of other scans' returns where returns lie, with the poses after,
    less the same before."""
    error: float
    """Its standard error."""
    parts: int
    """Number of scans that tell it, or of places, if these are fewer."""
    crowding: float = 0.0
    """The same gain of the density in cells that are far larger than errors of poses. Where scans are drawn together, on
    top of each other in the end, all densities rise, whether or not surfaces agree."""

    @property
    def needed(self) -> float:
        """The gain that matters and that neither chance (Student's t) nor crowding explains."""
        if self.parts < 2:
            return np.inf
        return max(
            _LEAST_GAIN, float(student.ppf(1 - _BY_CHANCE, self.parts - 1)) * self.error, self.crowding
        )

    @property
    def improved(self) -> bool:
        """Whether the gain is significant."""
        return self.gain > self.needed

    @property
    def words(self) -> str:
        """One sentence."""
        figures = (
            f"their density changes by {self.gain:+.2%}, by chance and overlap alone up to {self.needed:.2%}"
        )
        if self.improved:
            return f"The refined poses make a sharper map: returns that took no part agree better with those of other scans ({figures})."
        return f"The given poses are kept: returns that took no part do not agree better with those of other scans ({figures})."

    @classmethod
    def of(
        cls, held: SensorReturns, used: SensorReturns, before: Floats, after: Floats, noise: SensorNoise
    ) -> Verdict:
        """Of the returns `held` that took no part, beside those that were `used`, by a sensor with this noise.

        Returns do not judge one by one. Those of a scan have the errors of its pose in common. Those of a place may lie on one
        thing that moved, or that looks different from everywhere. The standard error is the larger one of the two.
        """
        if len(held) == 0:
            return cls(0.0, np.inf, 0)
        step = -(-len(held) // _MOST_RETURNS)
        asked = held.select(np.arange(len(held)) % step == 0)
        gains = _gains(asked, used, before, after, noise)
        edge_m = _PLACE * float(np.median(asked.ranges_m))
        cells = np.floor(asked.posed(before).points / edge_m)
        places = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        by_scans = cls.by_groups(gains, asked.scans)
        parts = min(by_scans.parts, int(places.max()) + 1)
        if parts < 2:
            return cls(0.0, np.inf, parts)
        crowding = cls.by_groups(_crowding(asked, used, before, after), asked.scans).gain
        return cls(by_scans.gain, max(by_scans.error, _error_of_places(gains, places)), parts, crowding)

    @classmethod
    def by_groups(cls, gains: Floats, groups: NDArray[np.integer[Any]]) -> Verdict:
        """Of gains (N,) of which those of a group have errors in common. `groups` (N,): the number of the group of each."""
        counts = np.bincount(groups)
        means = np.bincount(groups, gains)[counts > 0] / counts[counts > 0]
        if len(means) < 2:
            return cls(0.0, np.inf, len(means))
        return cls(float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means))), len(means))


def _error_of_places(gains: Floats, places: NDArray[np.int64]) -> float:
    """Standard error of the mean of gains (N,) of which those of a place (N,) may all be wrong together."""
    sums = np.bincount(places, gains - gains.mean())
    return float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)) / len(gains))


def _gains(
    asked: SensorReturns, used: SensorReturns, before: Floats, after: Floats, noise: SensorNoise
) -> Floats:
    """(N,) by how much the logarithm of the density at the asked returns rises.

    Distances to a nearest return alone say mostly how returns happen to lie. A density over several ones says more. It is as wide
    as the noise of both returns and as they lie apart. A return without any others nearby is clutter or the first look at
    something: so the median of the densities is added to each, and such returns say little.
    """
    given = _Neighbours.of(asked, used, before)
    of_asked, of_used = (noise.mean_variances_m2(returns.ranges_m) for returns in (asked, used))
    of_asked += float(np.median(given.nearest_m)) ** 2
    density = given.density(of_asked, of_used)
    floor = float(np.median(density))
    if floor == 0:  # scans that have nothing in common where they are
        return np.zeros(len(asked))
    then = _Neighbours.of(asked, used, after).density(of_asked, of_used)
    gains: Floats = np.log((then + floor) / (density + floor))
    return gains


def _crowding(asked: SensorReturns, used: SensorReturns, before: Floats, after: Floats) -> Floats:
    """(N,) by how much the logarithm of the number of other scans' returns in the cell of each asked return rises."""
    edge_m = _NEARBY * float(np.median(asked.ranges_m))
    used = used.every(-(-len(used) // _MOST_COUNTED))
    counts = []
    for poses in (before, after):
        points = np.concatenate([asked.posed(poses).points, used.posed(poses).points])
        cells = np.unique(np.floor(points / edge_m), axis=0, return_inverse=True)[1].ravel()
        of_asked, of_used = np.split(cells, [len(asked)])
        own, of_scan = (
            cell * len(poses) + scan for cell, scan in ((of_asked, asked.scans), (of_used, used.scans))
        )
        scan_cells, of_scans = np.unique(of_scan, return_counts=True)
        place = np.searchsorted(scan_cells, own).clip(max=len(scan_cells) - 1)
        in_cell = np.bincount(of_used, minlength=int(cells.max()) + 1)[of_asked]
        counts.append(in_cell - np.where(scan_cells[place] == own, of_scans[place], 0))
    floor = max(float(np.median(counts[0])), 1.0)
    crowding: Floats = np.log((counts[1] + floor) / (counts[0] + floor))
    return crowding


@dataclass(frozen=True)
class _Neighbours:
    """The returns near those that are asked, with some poses."""

    distances_m: Floats
    """(N, K)."""
    rows: NDArray[np.int64]
    """(N, K) among the returns that were used."""
    others: NDArray[np.bool_]
    """(N, K) whether they belong to another scan."""

    @classmethod
    def of(cls, asked: SensorReturns, used: SensorReturns, poses: Floats) -> _Neighbours:
        tree = cKDTree(used.posed(poses).points)
        distances, rows = tree.query(asked.posed(poses).points, min(_NEIGHBOURS, len(used)))
        distances, rows = distances.reshape(len(asked), -1), rows.reshape(len(asked), -1)
        return cls(distances, rows, used.scans[rows] != asked.scans[:, None])

    @property
    def nearest_m(self) -> Floats:
        """(N,) distance to the nearest return of another scan. Of those without any, to the last of the same scan."""
        first = np.where(self.others.any(axis=1), self.others.argmax(axis=1), self.others.shape[1] - 1)
        nearest: Floats = self.distances_m[np.arange(len(first)), first]
        return nearest

    def density(self, of_asked: Floats, of_used: Floats) -> Floats:
        """(N,) of other scans' returns, up to a factor, by the variances of those asked (N,) and of all that were used, m²."""
        variance = of_asked[:, None] + of_used[self.rows]
        with np.errstate(under="ignore"):
            parts = np.exp(-0.5 * self.distances_m**2 / variance) / variance**1.5
        density: Floats = np.where(self.others, parts, 0.0).sum(axis=1)
        return density
