# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How probable it is that a place changed, from what two maps tell of it.

Every probability here is Bayes' rule for two explanations, nothing changed or something did. The share of what
changed is unknown, too. It is found from all places together (empirical Bayes, Efron 2010): so where nothing changed, chance alone
makes few changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betaln, expit, log_ndtr, ndtr

from radarsdf.changes.placed import Floats, Told

# A field knows distances about so far from its surface: returns scatter into the next cells.
_REACH_CELLS = 2.0
_LEAST_SHARE, _MOST_SHARE = 1e-6, 0.5
_ROUNDS = 50  # of the share, which converges by then to four digits
_NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal number


@dataclass(frozen=True)
class Absence:
    """Whether a surface of one map is in the other."""

    absent: Floats
    """(N,) logarithm of how much more likely it is that rays saw through the place than that the surface is still there."""
    shifted: Floats
    """(N,) the same of a surface that is elsewhere along its normal, to either side. -inf where none was observed."""
    scale: float
    """By how much distances between the maps are larger than their uncertainty says, at least 1."""


def absence(own: Told, other: Told, other_leaf_m: float, own_sigma_m: Floats) -> Absence:
    """Of places on the surface of `own`. `own_sigma_m` (N,): its errors, with those of the alignment, m."""
    sigma_m = np.hypot(own_sigma_m, other.sigma_m)
    observed = np.isfinite(other.distance_m) & np.isfinite(sigma_m)
    distance_m, sigma_m = other.distance_m[observed], sigma_m[observed]
    scale = 1.0
    if observed.any():
        scale = max(1.0, float(np.median(np.abs(distance_m / sigma_m))) / _NORMAL_MEDIAN)
    sigma_m = sigma_m * scale
    reach_m = max(_REACH_CELLS * other_leaf_m, 1e-9)
    same = -0.5 * (distance_m / sigma_m) ** 2 - np.log(sigma_m * np.sqrt(2 * np.pi))
    passed = _passed(own, other)
    shifted = np.full(len(passed), -np.inf)
    shifted[observed] = _log_spread(distance_m, sigma_m, -reach_m, reach_m) - same
    absent = passed.copy()
    absent[observed] += _log_spread(distance_m, sigma_m, 0.0, reach_m) - same
    return Absence(absent, shifted, scale)


def _log_spread(x: Floats, sigma: Floats, lower: float, upper: float) -> Floats:
    """Logarithm of the density of what lies anywhere in [lower, upper], measured with an error."""
    inside = ndtr((upper - x) / sigma) - ndtr((lower - x) / sigma)
    # Far outside, the difference is nothing but rounding: the nearer end tells.
    nearest = log_ndtr(-np.maximum(np.maximum(lower - x, x - upper), 0) / sigma)
    found: Floats = np.where(inside > 1e-12, np.log(np.maximum(inside, 1e-300)), nearest) - np.log(
        upper - lower
    )
    return found


def _passed(own: Told, other: Told) -> Floats:
    """(N,) logarithm of how much more likely rays of the other map are if it is no longer there.

    Of all scans whose rays came to a place, some have returns there. If nothing changed, that share is the one that the own map
    shows: few of a thin fence, or of ground at a flat angle. If the surface is gone, it is another one (beta-binomial).
    """
    came = other.hits + other.passes
    hit, missed = own.hits + 0.5, own.passes + 0.5
    same = betaln(hit + other.hits, missed + other.passes) - betaln(hit, missed)
    changed = betaln(0.5 + other.hits, 0.5 + other.passes) - betaln(0.5, 0.5)
    fewer = other.hits < came * hit / (hit + missed)
    found: Floats = np.where(fewer, changed - same, np.minimum(changed - same, 0))
    return found


def share_of_changes(log_odds: Floats) -> float:
    """The share of places that changed, which makes what was seen of all of them most likely."""
    share = 0.01
    if len(log_odds) == 0:
        return _LEAST_SHARE
    for _ in range(_ROUNDS):
        share = float(np.clip(posterior(log_odds, share).mean(), _LEAST_SHARE, _MOST_SHARE))
    return share


def posterior(log_odds: Floats, share: float) -> Floats:
    """(N,) probability of a change, if such a share of all places changed."""
    found: Floats = expit(log_odds + np.log(share / (1 - share)))
    return found
