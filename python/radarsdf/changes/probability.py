# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How probable it is that a place changed, from what two maps tell of it.

Every probability here is Bayes' rule for two explanations, nothing changed or something did. The share of what
changed is unknown, too. It is found from all places together (empirical Bayes, Efron 2010): so where nothing changed, chance alone
makes few changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, expit, gammaln, stdtr

from radarsdf.changes.placed import Floats, Told

REACH_CELLS = 2.0
"""A field knows distances about so far from its surface: returns scatter into the next cells."""
_LEAST_SHARE, _MOST_SHARE = 1e-6, 0.5
_ROUNDS, _SETTLED = 50, 1e-4  # of the share
# Returns of a scan in cells side by side have causes in common: so many of them count once. Chosen on facade, hall and
# forest of seed 31.
_CELLS_PER_SCAN = 2.0
PARALLEL = np.cos(np.pi / 4)
"""Least cosine between normals of surfaces that are about parallel: one that moved still is."""
_FREEDOMS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 30.0)
_SCALES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
_MOST_DISTANCES = 5_000  # that tell both, evenly spread


@dataclass(frozen=True)
class Errors:
    """Distances between surfaces that did not change, over their standard error: Student's t, widened.

    At edges, in corners and at ghosts both maps are worse than their uncertainty says, so some distances are far off.
    """

    freedom: float
    """Degrees of freedom. Few: some distances are far larger than the others."""
    scale: float
    """By how much they are larger than the standard errors say."""

    @classmethod
    def of(cls, distance_m: Floats, sigma_m: Floats, reach_m: Floats) -> Errors:
        """The errors that make distances (N,) most likely, if an unknown share of them is of other surfaces within reach (N,)."""
        some = slice(None, None, -(-len(distance_m) // _MOST_DISTANCES) or 1)
        distance_m, sigma_m, reach_m = distance_m[some], sigma_m[some], reach_m[some]
        if len(distance_m) == 0:
            return cls(_FREEDOMS[-1], 1.0)

        def likelihood(errors: Errors) -> float:
            same, other = errors.log_density(distance_m, sigma_m), -np.log(2 * reach_m)
            share = share_of_changes(other - same)
            return float(np.logaddexp(np.log(1 - share) + same, np.log(share) + other).sum())

        return max((cls(freedom, scale) for freedom in _FREEDOMS for scale in _SCALES), key=likelihood)

    def log_density(self, distance_m: Floats, sigma_m: Floats) -> Floats:
        """(N,) logarithm of the density of distances (N,) with standard errors (N,), 1/m."""
        width_m, n = self.scale * sigma_m, self.freedom
        constant = gammaln((n + 1) / 2) - gammaln(n / 2) - 0.5 * np.log(n * np.pi)
        found: Floats = constant - np.log(width_m) - (n + 1) / 2 * np.log1p((distance_m / width_m) ** 2 / n)
        return found

    def log_spread(self, distance_m: Floats, sigma_m: Floats, lower_m: float, upper_m: float) -> Floats:
        """The same of a surface that lies anywhere in [lower_m, upper_m]."""
        width_m = self.scale * sigma_m
        inside = stdtr(self.freedom, (upper_m - distance_m) / width_m)
        inside -= stdtr(self.freedom, (lower_m - distance_m) / width_m)
        # Far outside, the difference is nothing but rounding.
        found: Floats = np.log(np.maximum(inside, 1e-12) / (upper_m - lower_m))
        return found


@dataclass(frozen=True)
class Absence:
    """Whether a surface of one map is in the other."""

    absent: Floats
    """(N,) logarithm of how much more likely it is that rays saw through the place than that the surface is still there."""
    shifted: Floats
    """(N,) the same of a surface that is elsewhere along its normal, to either side. -inf where none was observed."""


@dataclass(frozen=True)
class Beside:
    """Places on the surface of one map, beside another map."""

    own: Told
    other: Told
    sigma_m: Floats
    """(N,) standard error of the distance between both surfaces, with that of the alignment, m."""
    reach_m: float
    """So far from its surface the other map knows distances, m."""

    @classmethod
    def of(cls, own: Told, other: Told, other_leaf_m: float, own_sigma_m: Floats) -> Beside:
        """`own_sigma_m` (N,): errors of the own surface, with those of the alignment, m."""
        return cls(own, other, np.hypot(own_sigma_m, other.sigma_m), REACH_CELLS * other_leaf_m)

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(N,) whether the distance is known."""
        return np.isfinite(self.other.distance_m) & np.isfinite(self.sigma_m)

    @property
    def parallel(self) -> NDArray[np.bool_]:
        """(N,) whether the other map's surface is about parallel."""
        mask: NDArray[np.bool_] = np.einsum("ni,ni->n", self.own.normals, self.other.normals) >= PARALLEL
        return mask

    def agree(self, errors: Errors, sigmas: float) -> NDArray[np.bool_]:
        """(N,) whether the other map has the surface, to within so many of its standard errors."""
        return self.parallel & (np.abs(self.other.distance_m) <= sigmas * errors.scale * self.sigma_m)

    def distances(self) -> tuple[Floats, Floats]:
        """(K,) distances that are known, and their standard errors, m."""
        return self.other.distance_m[self.observed], self.sigma_m[self.observed]

    def absence(self, errors: Errors) -> Absence:
        """Whether the surface is in the other map."""
        observed, reach_m = self.observed, self.reach_m
        distance_m, sigma_m = self.distances()
        same = errors.log_density(distance_m, sigma_m)
        absent = _passed(self.own, self.other)
        shifted = np.full(len(absent), -np.inf)
        shifted[observed] = errors.log_spread(distance_m, sigma_m, -reach_m, reach_m) - same
        absent[observed] += errors.log_spread(distance_m, sigma_m, 0.0, reach_m) - same
        return Absence(absent, shifted)


def errors_of(sides: Sequence[Beside]) -> Errors:
    """The errors of the distances between two maps."""
    known = [side.distances() for side in sides]
    reaches_m = [np.full(len(found[0]), side.reach_m) for side, found in zip(sides, known, strict=True)]
    distance_m, sigma_m = (np.concatenate(columns) for columns in zip(*known, strict=True))
    return Errors.of(distance_m, sigma_m, np.concatenate(reaches_m))


def _passed(own: Told, other: Told) -> Floats:
    """(N,) logarithm of how much more likely rays of the other map are if it is no longer there.

    Of all scans whose rays came to a place, some have returns there, and others passed behind it. If nothing changed, that
    share is the one that the own map shows: few of a thin fence. If the surface is gone, it is another one (beta-binomial).
    """
    hits, passes = other.hits / _CELLS_PER_SCAN, other.passes / _CELLS_PER_SCAN
    hit, missed = own.hits / _CELLS_PER_SCAN + 0.5, own.passes / _CELLS_PER_SCAN + 0.5
    same = betaln(hit + hits, missed + passes) - betaln(hit, missed)
    changed = betaln(0.5 + hits, 0.5 + passes) - betaln(0.5, 0.5)
    fewer = hits < (hits + passes) * hit / (hit + missed)
    found: Floats = np.where(fewer, changed - same, np.minimum(changed - same, 0))
    return found


def odds_of_differences(differences: Floats, sigma: Floats, reach: float) -> Floats:
    """(N,) logarithm of how much more likely differences (N,) are by a change than by errors with deviations (N,).

    A change may make any difference within reach.
    """
    found: Floats = 0.5 * (differences / sigma) ** 2 + np.log(sigma * np.sqrt(2 * np.pi) / (2 * reach))
    return found


def share_of_changes(log_odds: Floats) -> float:
    """The share of places that changed, which makes what was seen of all of them most likely."""
    share = 0.01
    if len(log_odds) == 0:
        return _LEAST_SHARE
    for _ in range(_ROUNDS):
        before, share = share, float(np.clip(posterior(log_odds, share).mean(), _LEAST_SHARE, _MOST_SHARE))
        if abs(share - before) < _SETTLED * share:
            break
    return share


def posterior(log_odds: Floats, share: float) -> Floats:
    """(N,) probability of a change, if such a share of all places changed."""
    found: Floats = expit(log_odds + np.log(share / (1 - share)))
    return found
