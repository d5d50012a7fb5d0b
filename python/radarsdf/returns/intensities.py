"""Detection of intensity outliers, the scale of the inliers, and samples of returns that do not depend on their order."""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from radarsdf.arrays import Array, ArrayLike, Bools, Floats32, Ints, Keys
from radarsdf.checks import check, real_array


def sample(keys: Keys, most: int) -> Ints:
    """Return the rows of the `most` smallest keys (N,), or of all."""
    return np.arange(len(keys)) if len(keys) <= most else np.argpartition(keys, most)[:most]


# An intensity is an outlier if it lies beyond a gap and significantly outside the extrapolated tail of the inliers.
_GAP = 3.0  # ratio of distances from the median across a gap. Tails have gaps, too
_CHANCE = 1e-3  # significance level: probability that a tail extends so far
_RARE = 0.03  # largest share of outliers. A larger group is another kind of returns ...
_FEW = 3  # ... unless it has at most this many distinct values: sentinels
_FEWEST = 128  # fewest returns that determine the usual range
_MOST = 1 << 15  # size of the sample that determines it


@dataclass(frozen=True)
class Plausible:
    """Limits of inlier intensities, sensor units."""

    low: float
    high: float

    @classmethod
    def of(cls, intensities: Array, keys: Keys | None = None) -> "Plausible":
        """Find the limits from intensities (N,), of samples by pseudo-random `keys` (N,); None: by row."""
        if keys is None:
            keys = np.arange(len(intensities), dtype=np.uint64)
            keys *= np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio, odd
            keys ^= keys >> np.uint64(32)
        known = Intensities()
        known.add(intensities, keys)
        return known.plausible()

    def holds(self, intensities: Array) -> Bools:
        return (intensities >= np.float64(self.low)) & (intensities <= np.float64(self.high))

    def kept(self, intensities: Array) -> Array:
        """Return the intensities (N,) with NaN in place of those beyond the limits."""
        return np.where(self.holds(intensities), intensities, intensities.dtype.type(np.nan))


class Intensities:
    """Streaming sample of intensities, with the lowest and the highest, independent of their order."""

    def __init__(self) -> None:
        self._some: Array = np.zeros(0, np.float32)
        self._keys: Keys = np.zeros(0, np.uint64)
        self._count = 0
        self.low, self.high = math.inf, -math.inf

    def add(self, intensities: Array, keys: Keys) -> None:
        """Add intensities (N,), sensor units, NaN where missing, with pseudo-random keys (N,)."""
        none = np.isnan(intensities)
        known, keys = (intensities[~none], keys[~none]) if none.any() else (intensities, keys)
        if len(known) == 0:
            return
        self._count += len(known)
        rows = sample(keys, _MOST)
        some, keys = (np.concatenate(pair) for pair in ((self._some, known[rows]), (self._keys, keys[rows])))
        rows = sample(keys, _MOST)
        self._some, self._keys = some[rows], keys[rows]
        self.low, self.high = min(self.low, float(known.min())), max(self.high, float(known.max()))

    def plausible(self) -> Plausible:
        if len(self._some) < _FEWEST:
            return Plausible(-math.inf, math.inf)
        values = self._some
        if self._count > len(values):
            values = np.append(values, np.array([self.low, self.high], values.dtype))
        median = np.partition(values, len(values) // 2)[len(values) // 2]
        limit = _farthest(np.sort(np.abs(values - median)), self._count)
        return Plausible(float(median) - limit, float(median) + limit)


def _farthest(distances: Array, count: int) -> float:
    """Return the largest inlier distance from the median of `count` intensities, from a sample of distances (M,), ascending."""
    of_all = len(distances)
    distances = distances[distances > 0]  # up to half of the returns may have the same intensity
    gaps = np.flatnonzero(distances[1:] > _GAP * distances[:-1]) + 1
    for first in gaps[gaps >= _FEWEST]:
        usual, beyond = distances[:first], distances[first:]
        different = 1 + np.count_nonzero(np.diff(beyond))
        if len(beyond) > _RARE * of_all and different > _FEW:
            continue
        # Share beyond a distance at which n tail values lie beyond it with probability `_CHANCE`, about (Poisson).
        share = len(beyond) / (math.e * count) * _CHANCE ** (1 / len(beyond))
        if beyond[0] > _reach(usual, share):
            return _GAP * float(usual[-1])
    return math.inf


def _reach(distances: Array, share: float) -> float:
    """Extrapolate the distance from the median beyond which a `share` of returns lies, from distances (M,), ascending."""
    # Each quartering of the share extends an exponential tail by the same length, and a heavy tail by growing lengths. A tail
    # lighter than exponential is treated as exponential, because returns are of several kinds.
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
    """Range of the training intensities, mapped to [0, 1]."""

    low: float  # lowest training intensity, sensor units
    high: float  # highest training intensity, sensor units

    @classmethod
    def of(cls, intensities: Floats32 | None) -> "IntensityScale | None":
        """Build from `intensities` (N,), sensor units, NaN where missing. None without intensities."""
        if intensities is None:
            return None
        return cls(float(np.nanmin(intensities)), float(np.nanmax(intensities)))

    @classmethod
    def between(cls, intensity_range: ArrayLike) -> "IntensityScale":
        """Build from a range (low, high). Raise a ValueError unless it is finite and ascending."""
        ends = real_array(intensity_range, "intensity_range")
        fits = ends.shape == (2,) and -np.inf < ends[0] < ends[1] < np.inf
        check(fits, "intensity_range must be two finite numbers, the lower one first")
        return cls(*ends.tolist())

    def to_unit(self, intensities: Floats32) -> Floats32:
        """Scale intensities (N,) from sensor units to [0, 1], clipped to the range; NaN stays."""
        unit = (intensities - np.float32(self.low)) / np.float32(self.high - self.low)
        return np.clip(unit, 0, 1).astype(np.float32)

    def to_sensor(self, unit: Tensor) -> Tensor:
        """Scale intensities (N,) from [0, 1] to sensor units."""
        return self.low + (self.high - self.low) * unit
