# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The parts of a map, which its file, its queries and its mesh have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field
from radarsdf.returns.evidence import Evidence
from radarsdf.returns.free_space import FreeSpace
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.view_statistics import ViewStatistics

_Part = TypeVar("_Part")


class Deferred(Generic[_Part]):
    """A part that `make` computes when it is first asked for. What `make` refers to stays in memory until then."""

    def __init__(self, make: Callable[[], _Part]) -> None:
        self._make: Callable[[], _Part] | None = make

    def __call__(self) -> _Part:
        if (make := self._make) is not None:
            self._part = make()
            self._make = None
        return self._part


@dataclass(frozen=True)
class WholeMap:
    """What evidence at a place depends on besides the returns there: properties of the whole map."""

    origin: NDArray[np.float64]  # (3,) origin of the local frame in world coordinates, m
    config: FitConfig
    clutter_ratio: float  # share of the returns that lie on no thin surface, in [0, 1]
    returns_per_cell: float  # mean number of returns in the cells of surfels that hold any


@dataclass(frozen=True)
class MapContents(WholeMap):
    """The parts of a map."""

    field: Field  # signed distance and intensity, in the local frame
    intensity_scale: IntensityScale | None  # range of the training intensities. None: it has no intensities
    evidence: Evidence  # evidence of a surface in each leaf cell
    sensor: Sensor  # the radar, as the scans of the fit show it
    report: dict[str, Any]  # counts, losses, noise of the sensor and seconds of the fit
    free_space: Callable[[], FreeSpace] = FreeSpace.none  # free-space crossings, or none
    view_statistics: Callable[[], ViewStatistics] = (
        ViewStatistics.none
    )  # view statistics of intensity, or none
