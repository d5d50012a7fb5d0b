"""View statistics of intensity: mean intensities by place and view, comparable between maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import cell_rows
from radarsdf.arrays import AnyFloats, Bools, Floats, Floats32, Ints32
from radarsdf.checks import check
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN

PLACE_CELLS = 3
"""Edge of the cells in which returns of similar view share a mean, leaf cells."""
# Bin widths of the direction's components and of the logarithm of the range: an echo hardly varies within one.
_DIRECTION_STEP, _LOG_RANGE_STEP = 0.25, 0.3
_UNITS = 127  # scale of a direction's components in 8 bits
_MOST = 2**16 - 1  # largest stored count


def rows_of_views(
    points: AnyFloats, directions: AnyFloats, ranges_m: AnyFloats, leaf_size_m: float
) -> tuple[Ints32, int]:
    """Return the group (N,) by place and view of returns at points (N, 3), m, along directions (N, 3), and their number."""
    # The third bin width of the core applies to any quantity.
    kind = np.array([[PLACE_CELLS * leaf_size_m, _DIRECTION_STEP, _LOG_RANGE_STEP]])
    log_ranges = np.log(np.maximum(ranges_m, 1e-6))
    return cell_rows(kind, *(np.ascontiguousarray(a, np.float32) for a in (points, directions, log_ranges)))


_COLUMNS = ("points", "directions", "ranges_m", "intensities", "counts")


@dataclass(frozen=True)
class ViewStatisticsAt:
    """View statistics in the world frame."""

    points: Floats  # (G, 3) mean place, m
    directions: Floats  # (G, 3) unit vectors from the sensor
    ranges_m: Floats  # (G,) mean range
    intensities: Floats  # (G,) mean intensity, sensor units
    counts: Floats  # (G,) number of returns
    sigma: float  # standard deviation of single returns from the mean of their group

    def select(self, chosen: Bools) -> ViewStatisticsAt:
        return dataclasses.replace(self, **{name: getattr(self, name)[chosen] for name in _COLUMNS})

    @classmethod
    def together(cls, parts: Sequence[ViewStatisticsAt]) -> ViewStatisticsAt:
        weights = np.array([max(float(part.counts.sum()), 1.0) for part in parts])
        variances = np.array([part.sigma**2 for part in parts])
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        return cls(**columns, sigma=float(np.sqrt((weights * variances).sum() / weights.sum())))


@dataclass(frozen=True)
class ViewStatistics:
    """View statistics in the compact form that a map stores: 23 bytes each."""

    points: Floats32  # (G, 3) mean place, local frame, m
    directions: NDArray[np.int8]  # (G, 3) mean direction from the sensor, a unit vector times 127
    ranges_m: NDArray[np.float16]  # (G,) mean range
    intensities: Floats32  # (G,) mean intensity, scaled to [0, 1]
    counts: NDArray[np.int16]  # (G,) number of returns, at most 65,535, as the bits of an uint16
    sigma: float  # standard deviation of single returns from the mean of their group

    @classmethod
    def of(cls, rays: Rays, unit: Floats32, leaf_size_m: float) -> ViewStatistics:
        rows, count = rows_of_views(rays.points, rays.directions, rays.ranges_m, leaf_size_m)
        counts = np.bincount(rows, minlength=count)
        of_returns = unit.astype(np.float64)

        def means(column: AnyFloats) -> Floats:
            return np.bincount(rows, column, count) / counts

        mean = means(of_returns)
        squares = ((of_returns - mean[rows]) ** 2).sum()
        directions = np.stack([means(column) for column in rays.directions.T], axis=1)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
        return cls(
            np.stack([means(column) for column in rays.points.T], axis=1).astype(np.float32),
            np.rint(_UNITS * directions).astype(np.int8),
            means(rays.ranges_m).astype(np.float16),
            mean.astype(np.float32),
            np.minimum(counts, _MOST).astype(np.uint16).view(np.int16),
            float(np.sqrt(squares / max(len(rows) - count, 1))),
        )

    @classmethod
    def none(cls) -> ViewStatistics:
        empty = np.zeros((0, 3), np.float32)
        none = empty[:, 0]
        return cls(empty, empty.astype(np.int8), none.astype(np.float16), none, none.astype(np.int16), 0.0)

    def check(self, leaf_size_m: float) -> None:
        count, limit_m = len(self.counts), MAX_CELLS_FROM_ORIGIN * leaf_size_m
        shapes = [getattr(self, name).shape for name in _COLUMNS]
        fits = shapes == [(count, 3), (count, 3), (count,), (count,), (count,)]
        check(fits, "the view statistics have arrays of wrong shapes")
        near = (np.abs(self.points) <= limit_m).all() and (self.ranges_m >= 0).all()
        plausible = near and (self.counts.view(np.uint16) > 0).all() and 0 <= self.sigma < np.inf
        check(plausible, "the view statistics hold numbers out of range")

    def in_world(self, origin: Floats, low: float, high: float) -> ViewStatisticsAt:
        """Convert to the world frame. `origin` (3,): of the local frame, m. `low`, `high`: values of 0 and 1, sensor units."""
        width = high - low
        return ViewStatisticsAt(
            self.points.astype(np.float64) + origin,
            self.directions / float(_UNITS),
            self.ranges_m.astype(np.float64),
            low + width * self.intensities.astype(np.float64),
            self.counts.view(np.uint16).astype(np.float64),
            width * self.sigma,
        )
