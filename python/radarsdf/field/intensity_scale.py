# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Converts intensities between the sensor's units and the [0, 1] of the intensity network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class IntensityScale:
    """The range of the training intensities, which becomes [0, 1]."""

    low: float
    """Lowest training intensity, sensor units."""
    high: float
    """Highest training intensity, sensor units."""

    @classmethod
    def of(cls, intensities: NDArray[np.float32] | None) -> IntensityScale | None:
        """The range of `intensities` (N,), sensor units. None if there are none."""
        return None if intensities is None else cls(float(intensities.min()), float(intensities.max()))

    def to_unit(self, intensities: NDArray[np.float32]) -> NDArray[np.float32]:
        """Intensities (N,) from sensor units to [0, 1]."""
        return ((intensities - np.float32(self.low)) / np.float32(self.high - self.low)).astype(np.float32)

    def to_sensor(self, unit: Tensor) -> Tensor:
        """Intensities (N,) from [0, 1] to sensor units."""
        return self.low + (self.high - self.low) * unit
