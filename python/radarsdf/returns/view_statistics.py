# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""View statistics of intensity: mean intensities by place and view, which two maps can compare."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import cell_rows
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN

Float32 = NDArray[np.float32]
Floating = NDArray[np.floating]

PLACE_CELLS = 3
"""Returns that are so close, leaf cells, and are seen alike, have one mean."""
# Steps of the direction's components, and of the logarithm of the range: how strong an echo is hardly differs within one.
_DIRECTION_STEP, _LOG_RANGE_STEP = 0.25, 0.3
_UNITS = 127  # of a direction's components in 8 bits
_MOST = 2**16 - 1  # returns of a mean that are counted


def rows_of_views(
    points: Floating, directions: Floating, ranges_m: Floating, leaf_size_m: float
) -> tuple[NDArray[np.int32], int]:
    """The group (N,) by place and view of returns at points (N, 3), m, seen along directions (N, 3), and how many there are."""
    # The core's third step is of any number.
    kind = np.array([[PLACE_CELLS * leaf_size_m, _DIRECTION_STEP, _LOG_RANGE_STEP]])
    log_ranges = np.log(np.maximum(ranges_m, 1e-6))
    return cell_rows(kind, *(np.ascontiguousarray(a, np.float32) for a in (points, directions, log_ranges)))


_COLUMNS = ("points", "directions", "ranges_m", "intensities", "counts")


@dataclass(frozen=True)
class ViewStatisticsAt:
    """Means of returns that are close and seen alike, in the world."""

    points: NDArray[np.float64]  # (G, 3) mean place, m
    directions: NDArray[np.float64]  # (G, 3) unit vectors from the sensor
    ranges_m: NDArray[np.float64]  # (G,) mean range
    intensities: NDArray[np.float64]  # (G,) mean intensity, sensor units
    counts: NDArray[np.float64]  # (G,) returns
    sigma: float  # standard deviation of single returns from the mean of those that are close and seen alike

    def select(self, chosen: NDArray[np.bool_]) -> ViewStatisticsAt:
        return dataclasses.replace(self, **{name: getattr(self, name)[chosen] for name in _COLUMNS})

    @classmethod
    def together(cls, parts: Sequence[ViewStatisticsAt]) -> ViewStatisticsAt:
        weights = np.array([max(float(part.counts.sum()), 1.0) for part in parts])
        variances = np.array([part.sigma**2 for part in parts])
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        return cls(**columns, sigma=float(np.sqrt((weights * variances).sum() / weights.sum())))


@dataclass(frozen=True)
class ViewStatistics:
    """Means of returns that are close and seen alike, as a map keeps them: 23 bytes each."""

    points: Float32  # (G, 3) mean place, local frame, m
    directions: NDArray[np.int8]  # (G, 3) mean direction from the sensor, a unit vector times 127
    ranges_m: NDArray[np.float16]  # (G,) mean range
    intensities: Float32  # (G,) mean intensity, of which the range of the training intensities is [0, 1]
    counts: NDArray[np.int16]  # (G,) returns, up to 65,535, as a number without a sign
    sigma: float  # standard deviation of single returns from the mean of those that are close and seen alike

    @classmethod
    def of(cls, rays: Rays, unit: Float32, leaf_size_m: float) -> ViewStatistics:
        rows, count = rows_of_views(rays.points, rays.directions, rays.ranges_m, leaf_size_m)
        counts = np.bincount(rows, minlength=count)
        of_returns = unit.astype(np.float64)

        def means(column: Floating) -> NDArray[np.float64]:
            found: NDArray[np.float64] = np.bincount(rows, column, count) / counts
            return found

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
        """Raises a ValueError unless arrays of a file are what they should be."""
        count, limit_m = len(self.counts), MAX_CELLS_FROM_ORIGIN * leaf_size_m
        shapes = [getattr(self, name).shape for name in _COLUMNS]
        if shapes != [(count, 3), (count, 3), (count,), (count,), (count,)]:
            msg = "the view statistics have arrays of wrong shapes"
            raise ValueError(msg)
        near = (np.abs(self.points) <= limit_m).all() and (self.ranges_m >= 0).all()
        if not (near and (self.counts.view(np.uint16) > 0).all() and 0 <= self.sigma < np.inf):
            msg = "the view statistics hold numbers out of range"
            raise ValueError(msg)

    def in_world(self, origin: NDArray[np.float64], low: float, high: float) -> ViewStatisticsAt:
        """In the world, where the local frame has its origin (3,), m. `low`, `high`: 0 and 1 in units of the sensor."""
        width = high - low
        return ViewStatisticsAt(
            self.points.astype(np.float64) + origin,
            self.directions / float(_UNITS),
            self.ranges_m.astype(np.float64),
            low + width * self.intensities.astype(np.float64),
            self.counts.view(np.uint16).astype(np.float64),
            width * self.sigma,
        )
