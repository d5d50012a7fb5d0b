# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a map consists of: what its file stores, its queries read and its mesh is extracted from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.intensity_scale import IntensityScale


@dataclass(frozen=True)
class MapContents:
    """The parts of a map."""

    field: Field
    """The learnt field, in the local frame."""
    origin: NDArray[np.float64]
    """(3,) world coordinates of the local frame's zero, m."""
    intensity_scale: IntensityScale | None
    """Range of the training intensities, sensor units. None: the map was fitted without intensities."""
    config: FitConfig
    """What it was fitted with."""
    support: NDArray[np.uint16]
    """(C,) returns in and round each leaf cell, in the order of the cells' keys."""
    report: dict[str, Any]
    """Counts, losses and seconds of the fit, and under `skipped` what the scene did not need."""
