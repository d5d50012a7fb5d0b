# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the surface can be coloured by, each with colours and a legend."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radarsdf.io.scans import Scan, Scans
from radarsdf.map.colors import NEUTRAL, intensity_colors
from radarsdf.map.map import Map
from radarsdf.threads import resolve_num_threads
from radarsdf.view.surface import ShownSurface

SCALE_PERCENTILES = (2.0, 98.0)
"""Of the values on the surface: these are the ends of a scale."""
BRIDGED = (213, 94, 0)
"""Not a colour of a scale, and told from the grey of the rest by colour-blind people, too."""
_SAMPLES = 30_000  # vertices of which the limits of intensities are taken

_Rows = NDArray[np.int64]
_Position = tuple[float, float, float]


@dataclass(frozen=True)
class Colors:
    """Colours of numbers on a scale that does not change. NaN is grey."""

    low: float
    """The limits of the scale, in the unit of the numbers."""
    high: float

    def __call__(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, 3) sRGB of values (N,)."""
        return intensity_colors(values, self.low, self.high)[:, :3]


@dataclass(frozen=True)
class Classes:
    """Colours of yes and no."""

    names: tuple[str, str]
    """What no and yes mean."""
    colors: tuple[tuple[int, int, int], tuple[int, int, int]] = (BRIDGED, NEUTRAL)
    """sRGB of no and yes."""

    def __call__(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, 3) sRGB of values (N,) bool."""
        return np.array(self.colors, np.uint8)[np.asarray(values, np.int64)]


@dataclass(frozen=True)
class Quantity:
    """Something that is known of every vertex."""

    label: str
    """What it is, with its unit."""
    values: Callable[[_Rows, _Position], NDArray[Any]]
    """Of vertices (N,), for a position of the sensor, world, m: (N,)."""
    scale: Colors | Classes
    of_sensor: bool = False
    """Whether it changes as the sensor moves."""

    def colors(self, rows: _Rows, sensor: _Position) -> NDArray[np.uint8]:
        """(N, 3) sRGB of vertices (N,)."""
        return self.scale(self.values(rows, sensor))


def quantities_of(
    radar_map: Map, surface: ShownSurface, scans: Scans | None, sensor: _Position
) -> dict[str, Quantity]:
    """All that the surface can be coloured by, by name; the first is shown first.

    `sensor`: the first position, for which the scale of the intensities is chosen.
    """
    found = {}
    if radar_map.has_intensity:

        def intensity(rows: _Rows, sensor: _Position) -> NDArray[Any]:
            values: NDArray[Any] = radar_map.intensity(
                surface.vertices[rows], np.array(sensor), extrapolate=True
            )
            return values

        some = np.arange(0, len(surface.vertices), max(1, len(surface.vertices) // _SAMPLES))
        limits = _limits(intensity(some, sensor))
        found["intensity"] = Quantity(
            "intensity from the sensor, its units", intensity, Colors(*limits), of_sensor=True
        )
    for name, label, values, ends in (
        ("uncertainty", "uncertainty (standard error), m", surface.uncertainty_m, None),
        ("confidence", "confidence (probability)", surface.confidence, (0.0, 1.0)),
        ("height", "height, m", surface.vertices[:, 2], None),
    ):
        found[name] = Quantity(
            label, _looked_up(values), Colors(*(_limits(values) if ends is None else ends))
        )
    if scans is not None:
        edge_m = radar_map.config.leaf_size_m
        names = f"bridged: no return within {edge_m:g} m", "observed"
        found["observed"] = Quantity("observed by returns", _Observed(surface, scans, edge_m), Classes(names))
    return found


class _Observed:
    """Whether a return is within the edge of a leaf cell: elsewhere the surface was continued from its neighbours."""

    def __init__(self, surface: ShownSurface, scans: Scans, edge_m: float) -> None:
        self._surface, self._scans, self._edge_m = surface, scans, edge_m
        self._observed: NDArray[np.bool_] | None = (
            None  # when it is asked for: it takes seconds of many returns
        )

    def __call__(self, rows: _Rows, _: _Position) -> NDArray[np.bool_]:
        """(N,) of vertices (N,)."""
        if self._observed is None:
            points, poses = self._scans.points, self._scans.poses
            returns = np.concatenate(
                [Scan(scan, pose).world_points for scan, pose in zip(points, poses, strict=True)]
            )
            nearest_m, _none = cKDTree(returns).query(
                self._surface.vertices,
                distance_upper_bound=self._edge_m,
                workers=resolve_num_threads(0),
            )
            self._observed = np.isfinite(nearest_m)
        return self._observed[rows]


def _looked_up(values: NDArray[Any]) -> Callable[[_Rows, _Position], NDArray[Any]]:
    return lambda rows, _: values[rows]


def _limits(values: NDArray[Any]) -> tuple[float, float]:
    """The ends of a scale for values (N,). (0, 1) if none is known."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return 0.0, 1.0
    low, high = np.percentile(known, SCALE_PERCENTILES)
    return float(low), float(high)
