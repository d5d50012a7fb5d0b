# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Between the sensor's units and those of the intensity network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class IntensityScale:
    """Between the sensor's units and the [0, 1] of the intensity network: the training data's range."""

    low: float
    high: float

    @classmethod
    def of(cls, intensities: NDArray[np.float32] | None) -> IntensityScale | None:
        return None if intensities is None else cls(float(intensities.min()), float(intensities.max()))

    def to_unit(self, intensities: NDArray[np.float32]) -> NDArray[np.float32]:
        return ((intensities - np.float32(self.low)) / np.float32(self.high - self.low)).astype(np.float32)

    def to_sensor(self, unit: Tensor) -> Tensor:
        return self.low + (self.high - self.low) * unit
