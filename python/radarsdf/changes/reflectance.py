"""Comparison of mean intensities between two drives, at places and from views that both have."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from radarsdf.arrays import Bools, Floats
from radarsdf.changes.probability import PlacedMap, odds_of_differences, posterior, share_of_changes
from radarsdf.products import turned
from radarsdf.returns.view_statistics import PLACE_CELLS, rows_of_views

_UNITS_RATIO = 1.7  # ratio of spreads that shows different units: half decibels and decibels differ by 2
_MIN_VIEWS = 100  # needed to determine the units


@dataclass(frozen=True)
class _Means:
    """Values at places, each with a variance."""

    points: Floats  # (K, 3) common frame, m
    values: Floats  # (K,) sensor units
    variances: Floats  # (K,) from the number of returns per mean

    def select(self, chosen: Bools) -> _Means:
        return _Means(self.points[chosen], self.values[chosen], self.variances[chosen])

    def near(self, x: Floats, reach_m: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Weighted mean of values within reach of places (V, 3) (NaN without any), standard error, χ² and degrees of freedom."""
        near = cKDTree(x).sparse_distance_matrix(cKDTree(self.points), reach_m, output_type="coo_matrix")

        def total(values: Floats) -> Floats:
            return np.bincount(near.row, values[near.col], len(x)).astype(np.float64)

        weights = 1 / self.variances
        weight = total(weights)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = total(weights * self.values) / weight
            chi2 = total(weights * self.values**2) - weight * mean**2
            freedom = np.maximum(total(np.ones(len(weights))) - 1, 0)
            return mean, 1 / np.sqrt(weight), np.nan_to_num(chi2), freedom


@dataclass(frozen=True)
class Differences:
    """Differences of mean intensities between two drives, per place and view."""

    between: _Means  # later minus earlier, without `offset`
    within: list[_Means]  # per drive, residuals of the intensities from its own map
    offset: float  # common increase of all returns, sensor units
    reach_m: float  # radius of the neighbourhood of a place, m
    width: float  # width of the range of intensities, sensor units

    @classmethod
    def of(cls, before: PlacedMap, after: PlacedMap) -> Differences | str:
        """Build from two maps; or return the reason why they cannot be compared.

        The predictions of both maps are subtracted from both drives, so views may differ a little within one view bin.
        """
        scales = [p.radar_map.intensity_scale for p in (before, after)]
        days = [p.radar_map.view_statistics() for p in (before, after)]
        days = [
            replace(
                day, points=p.to_common(day.points), directions=turned(day.directions, p.T_common_map[:3, :3])
            )
            for p, day in zip((before, after), days, strict=True)
        ]
        if None in scales or not all(len(day.counts) for day in days):
            return "Reflectance was not compared: a map has no intensities."
        leaf_m = max(before.leaf_m, after.leaf_m)
        points, directions, ranges_m, counts, intensities = (
            np.concatenate([getattr(day, name) for day in days])
            for name in ("points", "directions", "ranges_m", "counts", "intensities")
        )
        sensors = points - directions * ranges_m[:, None]
        expected = [p.radar_map.intensity(p.to_own(points), p.to_own(sensors)) for p in (before, after)]
        left = intensities - np.mean(expected, axis=0)
        of_day = np.repeat([0, 1], [len(day.counts) for day in days])
        views, count = rows_of_views(points - points.mean(axis=0), directions, ranges_m, leaf_m)
        known = np.isfinite(left)
        row = (of_day * count + views)[known]
        columns = np.column_stack([np.ones(len(left)), left, intensities, points])[known]
        sums = np.stack([np.bincount(row, counts[known] * column, 2 * count) for column in columns.T])
        sums = sums.reshape(len(sums), 2, count)  # by day and view
        first, second = sums[:, :, (sums[0] > 0).all(axis=0)].transpose(1, 0, 2)
        if first.size == 0:
            return "Reflectance was not compared: the maps share no view."
        spreads = [np.subtract(*np.percentile(day[2] / day[0], [95, 5])) for day in (first, second)]
        if first.shape[1] > _MIN_VIEWS and max(spreads) > _UNITS_RATIO * min(spreads):
            return "Reflectance was not compared: spreads of intensities from equal views imply other units."
        values = second[1] / second[0] - first[1] / first[0]
        offset = float(np.median(values))
        variances = days[0].sigma ** 2 / first[0] + days[1].sigma ** 2 / second[0]
        between = _Means(((first[3:] + second[3:]) / (first[0] + second[0])).T, values - offset, variances)
        within = []
        for number, day in enumerate(days):
            rest = day.intensities - expected[number][of_day == number]
            within.append(_Means(day.points, rest, day.sigma**2 / day.counts).select(np.isfinite(rest)))
        width = max(scale.high - scale.low for scale in scales if scale is not None)
        return cls(between, within, offset, PLACE_CELLS * leaf_m, width)

    def probability(self, x: Floats, same: Bools, changed: Floats) -> tuple[Floats, Floats]:
        """(V,) difference near places (V, 3), and probability that only the reflectance changed, for places that are `same` (V,).

        Views near places (C, 3) that `changed` otherwise are ignored. If views of one place scatter more than their numbers
        of returns explain, within a drive or in their differences, errors are scaled up (Birge's ratio): at edges, near
        mirrors, in thickets. A change of reflectance is the same from all views.
        """
        between = self.between
        if len(changed):
            between = between.select(cKDTree(changed).query(between.points)[0] > self.reach_m)
        mean, sigma, chi2, freedom = between.near(x, self.reach_m)
        _, _, chi2_of_day, freedom_of_day = np.sum([day.near(x, self.reach_m) for day in self.within], axis=0)
        ratios = chi2 / np.maximum(freedom, 1), chi2_of_day / np.maximum(freedom_of_day, 1)
        sigma = sigma * np.sqrt(np.maximum(np.maximum(*ratios), 1))
        known = same & np.isfinite(mean)
        # A change may have any size within the range of intensities.
        odds = odds_of_differences(mean[known], sigma[known], self.width)
        probability = np.zeros(len(x))
        probability[known] = posterior(odds, share_of_changes(odds))
        return mean, probability
