# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which intensities are outliers, and the scale of the others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from radarsdf.checks import real_array

# An intensity is left out if it lies beyond a gap, and farther than the tail of the others reaches but by chance.
_GAP = 3.0  # times as far from the median as any other. Tails have gaps, too
_CHANCE = 1e-3  # that so many of a tail lie beyond
_RARE = 0.03  # share of the returns. More are another kind of returns ...
_FEW = 3  # ... unless they have no more different values than this: sentinels
_FEWEST = 128  # returns; fewer do not determine the usual range
_MOST = 1 << 15  # returns that determine it
_THINNED = 7  # times fewer of more than these. Few sensors repeat anything after seven returns


@dataclass(frozen=True)
class Plausible:
    """Limits of the intensities that can belong to the others, sensor units."""

    low: float
    high: float

    @classmethod
    def of(cls, intensities: NDArray[Any]) -> Plausible:
        known = Intensities()
        known.add(intensities)
        return known.plausible()

    def holds(self, intensities: NDArray[Any]) -> NDArray[np.bool_]:
        return (intensities >= np.float64(self.low)) & (intensities <= np.float64(self.high))

    def kept(self, intensities: NDArray[Any]) -> NDArray[Any]:
        """The intensities (N,); NaN in place of those beyond the limits."""
        return np.where(self.holds(intensities), intensities, intensities.dtype.type(np.nan))


class Intensities:
    """Intensities that come a part at a time: some of them, the lowest and the highest."""

    def __init__(self) -> None:
        self._some: NDArray[Any] = np.zeros(0, np.float32)
        self._every, self._count = 1, 0
        self.low, self.high = math.inf, -math.inf

    def add(self, intensities: NDArray[Any]) -> None:
        """The next ones (N,), sensor units; NaN for none."""
        none = np.isnan(intensities)
        known = intensities[~none] if none.any() else intensities
        if len(known) == 0:
            return
        self._some = np.concatenate([self._some, known[-self._count % self._every :: self._every]])
        self._count += len(known)
        while len(self._some) > _MOST:
            self._some, self._every = self._some[::_THINNED], _THINNED * self._every
        self.low, self.high = min(self.low, float(known.min())), max(self.high, float(known.max()))

    def plausible(self) -> Plausible:
        if len(self._some) < _FEWEST:
            return Plausible(-math.inf, math.inf)
        values = self._some
        if self._every > 1:
            values = np.append(values, np.array([self.low, self.high], values.dtype))
        median = np.partition(values, len(values) // 2)[len(values) // 2]
        limit = _farthest(np.sort(np.abs(values - median)), self._count)
        return Plausible(float(median) - limit, float(median) + limit)


def _farthest(distances: NDArray[Any], count: int) -> float:
    """How far from the median one of `count` intensities can be, by the distances (M,) of some, ascending."""
    of_all = len(distances)
    distances = distances[distances > 0]  # half of the returns may have the same intensity
    gaps = np.flatnonzero(distances[1:] > _GAP * distances[:-1]) + 1
    for first in gaps[gaps >= _FEWEST]:
        usual, beyond = distances[:first], distances[first:]
        different = 1 + np.count_nonzero(np.diff(beyond))
        if len(beyond) > _RARE * of_all and different > _FEW:
            continue
        # n of a tail lie beyond with this chance, nearly, where so large a share is expected there (Poisson).
        share = len(beyond) / (math.e * count) * _CHANCE ** (1 / len(beyond))
        if beyond[0] > _reach(usual, share):
            return _GAP * float(usual[-1])
    return math.inf


def _reach(distances: NDArray[Any], share: float) -> float:
    """How far from the median such a `share` of the returns lies, by the distances (M,) of others, ascending.

    An exponential tail grows by the same length with each quartering of the share, a heavy one by longer and longer ones. A
    lighter one than exponential is taken for that: returns are of several kinds.
    """
    quarter, second, third = (float(distances[len(distances) * (4**k - 1) // 4**k]) for k in (1, 2, 3))
    step, before = third - second, second - quarter
    growth = max(step / before, 1.0) if before > 0 else 1.0
    steps = max(-math.log(share, 4) - 3, 0.0)
    length = max(step, quarter)
    if growth == 1:
        return third + length * steps
    with np.errstate(over="ignore"):
        return float(third + length * growth * (np.float64(growth) ** steps - 1) / (growth - 1))


@dataclass(frozen=True)
class IntensityScale:
    """The range of the training intensities, which becomes [0, 1]."""

    low: float  # lowest training intensity, sensor units
    high: float  # highest training intensity, sensor units

    @classmethod
    def of(cls, intensities: NDArray[np.float32] | None) -> IntensityScale | None:
        """The range of `intensities` (N,), sensor units, NaN where there is none. None if there are none at all."""
        if intensities is None:
            return None
        return cls(float(np.nanmin(intensities)), float(np.nanmax(intensities)))

    @classmethod
    def between(cls, intensity_range: ArrayLike) -> IntensityScale:
        """A range (low, high) that is given. Raises a ValueError unless it is finite and ascending."""
        ends = real_array(intensity_range, "intensity_range")
        if ends.shape != (2,) or not -np.inf < ends[0] < ends[1] < np.inf:
            msg = "intensity_range must be two finite numbers, the lower one first"
            raise ValueError(msg)
        return cls(*ends.tolist())

    def to_unit(self, intensities: NDArray[np.float32]) -> NDArray[np.float32]:
        """Intensities (N,) from sensor units to [0, 1]. Those beyond the range are moved to its ends, NaN stays."""
        unit = (intensities - np.float32(self.low)) / np.float32(self.high - self.low)
        clipped: NDArray[np.float32] = np.clip(unit, 0, 1).astype(np.float32)
        return clipped

    def to_sensor(self, unit: Tensor) -> Tensor:
        """Intensities (N,) from [0, 1] to sensor units."""
        return self.low + (self.high - self.low) * unit
