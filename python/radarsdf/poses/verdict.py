"""Test of refined poses on held-out returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree
from scipy.stats import t as student

from radarsdf.arrays import Bools, Floats
from radarsdf.poses.planes import SensorReturns
from radarsdf.returns.noise import SensorNoise

NEIGHBOURS = 16  # nearest neighbours of a return; those of other scans contribute to the density
_MOST_RETURNS = 20_000  # maximum number of held-out returns
_BY_CHANCE = 1e-3  # significance level: probability that true poses seem improved
# Minimum relevant gain, however significant. Measured: up to 0.0006 with true poses, 0.0015 and more where a drift of 0.01 m and
# 0.05 degrees a step is corrected.
_LEAST_GAIN = 0.001
_HELD_OUT = 0.2  # share of the returns
_PLACE = 0.25  # edge of a place, median ranges: larger than single objects, near or far
# Edge of a cell, median ranges, in which the returns of other scans indicate only that scans overlap.
_NEARBY = 0.5
_MOST_COUNTED = 100_000  # maximum number of returns counted in these cells


def held_out(count: int, seed: int) -> Bools:
    """Return a mask (count,) of the held-out returns."""
    return np.random.default_rng(seed).random(count) < _HELD_OUT


@dataclass(frozen=True)
class Verdict:
    """Gain in agreement between returns of different scans."""

    gain: float  # mean over scans of the increase of the log density of other scans' returns at held-out ones
    error: float  # its standard error
    parts: int  # number of independent scans, or of places if these are fewer
    # The same gain for the density in cells far larger than pose errors. Where scans contract, in the end on top of each
    # other, all densities rise, whether or not surfaces agree.
    crowding: float = 0.0

    @property
    def needed(self) -> float:
        """Minimum gain: relevant, significant (Student's t), and not explained by crowding."""
        if self.parts < 2:
            return np.inf
        by_chance = float(student.ppf(1 - _BY_CHANCE, self.parts - 1)) * self.error
        return max(_LEAST_GAIN, by_chance, self.crowding)

    @property
    def improved(self) -> bool:
        return self.gain > self.needed

    @property
    def words(self) -> str:
        first, agree = "The given poses are kept", "do not agree"
        if self.improved:
            first, agree = "The refined poses make a sharper map", "agree"
        change = f"{self.gain:+.2%}, by chance and overlap alone up to {self.needed:.2%}"
        agreement = f"{agree} better with those of other scans (their density changes by {change})"
        return f"{first}: returns that took no part {agreement}."

    @classmethod
    def of(
        cls, held: SensorReturns, used: SensorReturns, before: Floats, after: Floats, noise: SensorNoise
    ) -> Verdict:
        """Compare `held`-out returns with the `used` ones at poses `before` and `after`.

        Returns are not independent. Those of a scan share the error of its pose. Those of a place may lie on one object that
        moved, or that looks different from each side. The standard error is the larger of the two clustered ones.
        """
        if len(held) == 0:
            return cls(0.0, np.inf, 0)
        held = held.every(-(-len(held) // _MOST_RETURNS))
        gains = _gains(held, used, before, after, noise)
        edge_m = _PLACE * float(np.median(held.ranges_m))
        cells = np.floor(held.posed(before).points / edge_m)
        places = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        by_scans = cls.by_groups(gains, held.scans)
        parts = min(by_scans.parts, int(places.max()) + 1)
        if parts < 2:
            return cls(0.0, np.inf, parts)
        # Cluster-robust standard error over places.
        sums = np.bincount(places, gains - gains.mean())
        error = float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)) / len(gains))
        crowding = cls.by_groups(_crowding(held, used, before, after), held.scans).gain
        return cls(by_scans.gain, max(by_scans.error, error), parts, crowding)

    @classmethod
    def by_groups(cls, gains: Floats, groups: NDArray[np.integer[Any]]) -> Verdict:
        """Compute mean and standard error of gains (N,) with common errors within `groups` (N,)."""
        counts = np.bincount(groups)
        means = np.bincount(groups, gains)[counts > 0] / counts[counts > 0]
        if len(means) < 2:
            return cls(0.0, np.inf, len(means))
        return cls(float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means))), len(means))


def _gains(
    held: SensorReturns, used: SensorReturns, before: Floats, after: Floats, noise: SensorNoise
) -> Floats:
    """Return the increase (N,) of the log density at the held-out returns."""
    # A nearest neighbour alone mostly reflects the sampling. The density is a sum over several, with a kernel as wide as the noise
    # of both returns and the spacing of returns. An isolated return is clutter or a new object: the median density is added to
    # each, so that such returns count little.
    variances = noise.mean_variances_m2(held.ranges_m), noise.mean_variances_m2(used.ranges_m)
    densities, apart_m2 = [], 0.0
    for poses in (before, after):
        tree = cKDTree(used.posed(poses).points)
        distances, rows = tree.query(held.posed(poses).points, min(NEIGHBOURS, len(used)))
        distances, rows = distances.reshape(len(held), -1), rows.reshape(len(held), -1)
        others = used.scans[rows] != held.scans[:, None]
        if poses is before:
            apart_m2 = median_apart_m(distances, others) ** 2
        variance = variances[0][:, None] + apart_m2 + variances[1][rows]
        densities.append(np.where(others, density(distances, variance), 0.0).sum(axis=1))
    floor = float(np.median(densities[0]))
    if floor == 0:  # the scans do not overlap
        return np.zeros(len(held))
    return np.log((densities[1] + floor) / (densities[0] + floor))


def density(distances_m: Floats, variances_m2: Floats) -> Floats:
    """Return normal densities of errors of these lengths, up to a factor."""
    with np.errstate(under="ignore"):
        return np.exp(-0.5 * distances_m**2 / variances_m2) / variances_m2**1.5


def median_apart_m(distances_m: Floats, others: Bools) -> float:
    """Return the median distance to the nearest neighbour of another scan, else to the last one, of neighbours (N, K)."""
    nearest = np.where(others.any(axis=1), others.argmax(axis=1), -1)
    return float(np.median(distances_m[np.arange(len(nearest)), nearest]))


def _crowding(held: SensorReturns, used: SensorReturns, before: Floats, after: Floats) -> Floats:
    """Return the increase (N,) of the log number of other scans' returns in the cell of each held-out return."""
    edge_m = _NEARBY * float(np.median(held.ranges_m))
    used = used.every(-(-len(used) // _MOST_COUNTED))
    counts = []
    for poses in (before, after):
        points = np.concatenate([held.posed(poses).points, used.posed(poses).points])
        cells = np.unique(np.floor(points / edge_m), axis=0, return_inverse=True)[1].ravel()
        of_held, of_used = np.split(cells, [len(held)])
        # Sparse matrix of counts by cell and scan.
        shape = int(cells.max()) + 1, len(poses)
        table = coo_matrix((np.ones(len(used)), (of_used, used.scans)), shape).tocsr()
        in_cell = np.asarray(table.sum(axis=1)).ravel()[of_held]
        counts.append(in_cell - np.asarray(table[of_held, held.scans]).ravel())
    floor = max(float(np.median(counts[0])), 1.0)
    return np.log((counts[1] + floor) / (counts[0] + floor))
