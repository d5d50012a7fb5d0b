"""The contents of a map, shared by its file, its queries and its mesh."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

from radarsdf._core import CellBlocks
from radarsdf.arrays import Floats, Floats32
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field
from radarsdf.returns.evidence import Evidence
from radarsdf.returns.free_space import FreeSpace
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.view_statistics import ViewStatistics, ViewStatisticsAt
from radarsdf.rig import Label
from radarsdf.threads import resolve_num_threads

_Part = TypeVar("_Part")


class Deferred(Generic[_Part]):
    """A part computed by `make` on first use. Until then, the references of `make` stay in memory."""

    def __init__(self, make: Callable[[], _Part]) -> None:
        self._make: Callable[[], _Part] | None = make

    def __call__(self) -> _Part:
        if (make := self._make) is not None:
            self._part = make()
            self._make = None
        return self._part


@dataclass(frozen=True)
class WholeMap:
    """Properties of the whole map on which evidence at a place depends, besides the returns there."""

    origin: Floats  # (3,) origin of the local frame in world coordinates, m
    config: FitConfig
    clutter_ratio: float  # share of the returns not on a thin surface, in [0, 1]
    returns_per_cell: float  # mean number of returns in the cells of surfels with returns


@dataclass(frozen=True)
class MapContents(WholeMap):
    field: Field  # signed distance and intensity, in the local frame
    intensity_scale: IntensityScale | None  # range of the training intensities. None without intensities
    evidence: Evidence  # evidence of a surface in each leaf cell
    sensor: Sensor  # the radar, estimated from the scans of the fit
    report: dict[str, Any]  # counts, losses, sensor noise and times of the fit, s
    free_space: Callable[[], FreeSpace] = FreeSpace.none  # free-space crossings, or none
    view_statistics: Callable[[], ViewStatistics] = ViewStatistics.none  # of intensity, or none
    sensors: dict[Label, Sensor] = dataclasses.field(default_factory=dict)  # radars of a rig by label

    def views_in_world(self) -> ViewStatisticsAt:
        """Return the view statistics in the world frame, in sensor units."""
        scale = self.intensity_scale
        low, high = (0.0, 1.0) if scale is None else (scale.low, scale.high)
        return self.view_statistics().in_world(self.origin, low, high)

    @cached_property
    def evidence_of_cells(self) -> tuple[CellBlocks, Floats32]:
        """The leaf cells, and (C, 4) see :meth:`radarsdf.returns.evidence.Evidence.columns`. Prepared by the first query."""
        keys = self.field.table.leaf_keys()
        return CellBlocks(keys), self.evidence.columns(keys, resolve_num_threads(0))
