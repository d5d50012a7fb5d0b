"""Scales of colours."""

from dataclasses import dataclass

import numpy as np

from radarsdf.arrays import Array, ArrayLike, Bytes

# From indigo through magenta and orange to yellow. Lightness increases from 0.32 to 0.93 in OKLab, in equal steps.
_ANCHORS = np.array([
    [43, 20, 133], [91, 33, 143], [137, 45, 141], [181, 60, 128], [218, 82, 107],
    [245, 113, 79], [253, 156, 70], [254, 197, 84], [249, 237, 82],
])  # fmt: skip
NEUTRAL = (190, 196, 204)  # light grey, for surfaces without a value


@dataclass(frozen=True)
class Scale:
    """A fixed scale of colours, from dark indigo at `low` to bright yellow at `high`, both finite and in this order."""

    low: float
    high: float

    @classmethod
    def of(cls, values: Array) -> "Scale":
        """Build from the 2nd and the 98th percentile of values (N,)."""
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, [2, 98]) if len(known) else (0.0, 1.0)
        return cls(float(low), float(high))

    def __call__(self, values: ArrayLike) -> Bytes:
        """Map values (N,) to sRGB (N, 3), clipped to the scale; NaN is grey. On a scale without extent, all get the middle colour."""
        v, extent = np.asarray(values, np.float64), self.high - self.low
        where = np.clip((v - self.low) / extent, 0.0, 1.0) if extent else np.where(np.isnan(v), np.nan, 0.5)
        known = ~np.isnan(where)
        positions = np.linspace(0.0, 1.0, len(_ANCHORS))
        colors = np.full((*v.shape, 3), NEUTRAL, dtype=np.uint8)
        for channel in range(3):
            colors[known, channel] = np.rint(np.interp(where[known], positions, _ANCHORS[:, channel]))
        return colors


SHARES = Scale(0.0, 1.0)
