# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Converts intensities between the sensor's units and the [0, 1] of the intensity network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from radarsdf.checks import real_array


@dataclass(frozen=True)
class IntensityScale:
    """The range of the training intensities, which becomes [0, 1]."""

    low: float
    """Lowest training intensity, sensor units."""
    high: float
    """Highest training intensity, sensor units."""

    @classmethod
    def of(cls, intensities: NDArray[np.float32] | None) -> IntensityScale | None:
        """The range of `intensities` (N,), sensor units, NaN where there is none. None if there are none at all."""
        return (
            None if intensities is None else cls(float(np.nanmin(intensities)), float(np.nanmax(intensities)))
        )

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
