# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Mean intensities on two days, at places and from views that both drives had."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radarsdf.changes.probability import (
    Floats,
    PlacedMap,
    odds_of_differences,
    posterior,
    share_of_changes,
)
from radarsdf.products import turned
from radarsdf.returns.view_statistics import PLACE_CELLS, EchoesAt, rows_of_views

_SAME_UNITS = np.sqrt(2)  # units differ by factors of 2 at least, as half decibels and decibels do
_FEWEST_VIEWS = 10


@dataclass(frozen=True)
class _Means:
    """Numbers at places, each with a variance."""

    points: Floats  # (K, 3) common frame, m
    values: Floats  # (K,) sensor units
    variances: Floats  # (K,) by how many returns they are means of

    def select(self, chosen: NDArray[np.bool_]) -> _Means:
        """Some (K,) of them."""
        return _Means(self.points[chosen], self.values[chosen], self.variances[chosen])

    def near(self, x: Floats, reach_m: float) -> _Near:
        """The means within reach of places (V, 3)."""
        tree = cKDTree(self.points)
        near = cKDTree(x).sparse_distance_matrix(tree, reach_m, output_type="coo_matrix")

        def total(values: Floats) -> Floats:
            found: Floats = np.bincount(near.row, values[near.col], len(x)).astype(np.float64)
            return found

        weights = 1 / self.variances
        weight = total(weights)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = total(weights * self.values) / weight
            chi2 = total(weights * self.values**2) - weight * mean**2
            return _Near(
                mean,
                1 / np.sqrt(weight),
                np.nan_to_num(chi2),
                np.maximum(total(np.ones(len(weights))) - 1, 0),
            )


class _Near(NamedTuple):
    """Statistics of the means near V places."""

    mean: Floats  # (V,) weighted by their variances. NaN where there are none.
    sigma: Floats  # (V,) its standard error, if nothing but the numbers of returns made them differ
    chi2: Floats  # (V,) their squared deviations over their variances
    freedom: Floats  # (V,) its expectation then: degrees of freedom


@dataclass(frozen=True)
class Differences:
    """Differences of mean intensities between two days, each at one place from one view."""

    between: _Means  # later less earlier, without `offset`
    within: list[_Means]  # of each day, what its own map leaves of the intensities
    offset: float  # by so much more all returns are stronger, sensor units
    reach_m: float  # means that are so close to a place belong to it, m
    width: float  # of the range of intensities, sensor units
    other_units: float | None
    """How many times as widely the later intensities spread, if the two days are in different units. None: they are not."""

    @property
    def words(self) -> str:
        """What all places have in common, in one sentence."""
        if self.other_units is not None:
            return (
                "Reflectance was not compared: at the same places and from the same views, the intensities of the later map spread "
                f"{self.other_units:.3g} times as widely, so they are in other units."
            )
        return f"All returns of the later drive are {self.offset:+.1f} stronger, sensor units: that is no change of a place."

    @classmethod
    def of(cls, before: PlacedMap, after: PlacedMap) -> Differences | None:
        """Of two maps. None: they have no view in common, or no intensities.

        What both maps expect is subtracted from both days: so views may differ a little within what counts as one.
        """
        scales = [scale for p in (before, after) if (scale := p.radar_map.intensity_scale) is not None]
        days = [_placed(placed) for placed in (before, after)]
        if len(scales) < len(days) or not all(len(day.counts) for day in days):
            return None
        leaf_m = max(before.leaf_m, after.leaf_m)
        points, directions, ranges_m, counts, intensities = (
            np.concatenate([getattr(day, name) for day in days])
            for name in ("points", "directions", "ranges_m", "counts", "intensities")
        )
        sensors = points - directions * ranges_m[:, None]
        expected = [p.radar_map.intensity(p.to_own(points), p.to_own(sensors)) for p in (before, after)]
        left = intensities - np.mean(expected, axis=0)
        later = np.repeat([False, True], [len(day.counts) for day in days])
        rows, count = rows_of_views(points - points.mean(axis=0), directions, ranges_m, leaf_m)
        sums = []
        for of_day in (~later, later):
            known = of_day & np.isfinite(left)
            columns = np.column_stack([np.ones(len(left)), left, intensities, points])
            sums.append(
                np.stack(
                    [np.bincount(rows[known], counts[known] * column[known], count) for column in columns.T]
                )
            )
        both = (sums[0][0] > 0) & (sums[1][0] > 0)
        if not both.any():
            return None
        first, second = (summed[:, both] for summed in sums)
        values = second[1] / second[0] - first[1] / first[0]
        offset = float(np.median(values))
        between = _Means(
            ((first[3:] + second[3:]) / (first[0] + second[0])).T,
            values - offset,
            days[0].sigma ** 2 / first[0] + days[1].sigma ** 2 / second[0],
        )
        within = [_left_of(day, expected[number][later == bool(number)]) for number, day in enumerate(days)]
        width = max(scale.high - scale.low for scale in scales)
        other_units = _ratio_of_units(first[2] / first[0], second[2] / second[0])
        return cls(between, within, offset, PLACE_CELLS * leaf_m, width, other_units)

    def apart_from(self, changed: Floats) -> Differences:
        """Without those near places (C, 3) that changed otherwise: the returns of one day are of what is not there on the other."""
        if len(changed) == 0:
            return self
        away_m, _ = cKDTree(changed).query(self.between.points)
        return replace(self, between=self.between.select(away_m > self.reach_m))

    def probability(self, x: Floats, counting: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """(V,) difference near places (V, 3), and the probability that the reflectance there changed.

        Only the places that are `counting` (V,) may have changed. Where views of one place differ by more than their numbers of
        returns explain, on one day or in how far they changed, errors are as much larger (Birge's ratio): at edges, near
        mirrors, in thickets. What is repainted changes alike from all views.
        """
        between = self.between.near(x, self.reach_m)
        days = [means.near(x, self.reach_m) for means in self.within]
        chi2, freedom = (np.sum([getattr(day, name) for day in days], axis=0) for name in ("chi2", "freedom"))
        known = counting & np.isfinite(between.mean)
        changed = np.zeros(len(x))
        of_day, of_change = chi2 / np.maximum(freedom, 1), between.chi2 / np.maximum(between.freedom, 1)
        ratio = np.sqrt(np.maximum(np.maximum(of_day, of_change), 1))
        sigma = (between.sigma * ratio)[known]
        # A change is as likely by any difference that the range of intensities has room for.
        odds = odds_of_differences(between.mean[known], sigma, self.width)
        changed[known] = posterior(odds, share_of_changes(odds))
        return between.mean, changed


def _ratio_of_units(earlier: Floats, later: Floats) -> float | None:
    """How many times as widely the later of two intensities (G,) of the same views spread, if that is no noise. None: they agree.

    Noise lowers the slope of either on the other, so one that is still above the limit is of the units. Linear powers have long
    tails, which are clipped.
    """
    x, y = (np.clip(values, *np.percentile(values, [5, 95])) for values in (earlier, later))
    (var_x, cov), (_, var_y) = np.cov(x, y, bias=True)
    if len(x) <= _FEWEST_VIEWS:
        return None
    error = np.sqrt(max(var_x * var_y - cov**2, 0) / len(x))
    return float(np.sqrt(var_y / var_x)) if cov - 3 * error > _SAME_UNITS * min(var_x, var_y) > 0 else None


def _placed(placed: PlacedMap) -> EchoesAt:
    """The echoes of a map in the common frame."""
    echoes = placed.radar_map.echoes()
    return replace(
        echoes,
        points=placed.to_common(echoes.points),
        directions=turned(echoes.directions, placed.T_common_map[:3, :3]),
    )


def _left_of(day: EchoesAt, expected: Floats) -> _Means:
    """What its map leaves of the means of a day, of which it expects `expected` (G,)."""
    left = day.intensities - expected
    known = np.isfinite(left)
    return _Means(day.points, left, day.sigma**2 / day.counts).select(known)
