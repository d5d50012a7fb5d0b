"""Colour map of intensities, and scales of it."""

from dataclasses import dataclass

import numpy as np

from radarsdf.arrays import Array, ArrayLike, Bytes
from radarsdf.checks import check, real_array

# From indigo through magenta and orange to yellow. Lightness increases from 0.32 to 0.93 in OKLab, in equal steps.
_ANCHORS = np.array([
    [43, 20, 133], [91, 33, 143], [137, 45, 141], [181, 60, 128], [218, 82, 107],
    [245, 113, 79], [253, 156, 70], [254, 197, 84], [249, 237, 82],
])  # fmt: skip
NEUTRAL = (190, 196, 204)  # light grey, for surfaces without a value


def intensity_colors(values: ArrayLike, low: float, high: float) -> Bytes:
    """Map values (N,) to RGBA colours (N, 4) uint8, from dark indigo at `low` to bright yellow at `high`; NaN is grey.

    Values outside the limits are clipped; if the limits are equal, all values get the middle colour.
    """
    ascending = np.isfinite([low, high]).all() and low <= high
    check(ascending, f"limits must be finite and ascending, not {low} and {high}")
    v = real_array(values, "values")
    where = np.clip((v - low) / (high - low), 0.0, 1.0) if high > low else np.where(np.isnan(v), np.nan, 0.5)
    known = ~np.isnan(where)
    positions = np.linspace(0.0, 1.0, len(_ANCHORS))
    colors = np.full((*v.shape, 4), (*NEUTRAL, 255), dtype=np.uint8)
    for channel in range(3):
        colors[known, channel] = np.rint(np.interp(where[known], positions, _ANCHORS[:, channel]))
    return colors


@dataclass(frozen=True)
class Scale:
    """A fixed scale of sRGB colours from `low` to `high`; NaN is grey."""

    low: float
    high: float

    @classmethod
    def of(cls, values: Array) -> "Scale":
        """Build from the 2nd and the 98th percentile of values (N,)."""
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, [2, 98]) if len(known) else (0.0, 1.0)
        return cls(float(low), float(high))

    def __call__(self, values: Array) -> Bytes:
        """(N, 3) sRGB of values (N,)."""
        return intensity_colors(values, self.low, self.high)[:, :3]


SHARES = Scale(0.0, 1.0)
