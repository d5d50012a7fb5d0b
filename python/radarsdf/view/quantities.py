# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Quantities that the surface can be coloured by, with their colour scales."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radarsdf.io.scans import Scans
from radarsdf.map.colors import NEUTRAL, intensity_colors
from radarsdf.map.map import Map
from radarsdf.threads import resolve_num_threads
from radarsdf.view.surface import ShownSurface

Color = tuple[int, int, int]
Position = tuple[float, float, float]
_Rows = NDArray[np.int64]

_BRIDGED = (213, 94, 0)  # distinct from NEUTRAL for colour-blind readers, too
_SAMPLES = 30_000  # vertices that the limits of the intensities are taken from


@dataclass(frozen=True)
class Colors:
    """A fixed scale of sRGB colours from `low` to `high`. NaN is grey."""

    low: float
    high: float

    def __call__(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, 3) sRGB of values (N,)."""
        return intensity_colors(values, self.low, self.high)[:, :3]


@dataclass(frozen=True)
class Classes:
    """sRGB colours of no and yes, and what these mean."""

    names: tuple[str, str]
    colors: tuple[Color, Color] = (_BRIDGED, NEUTRAL)

    def __call__(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, 3) sRGB of values (N,) bool."""
        return np.array(self.colors, np.uint8)[np.asarray(values, np.int64)]


@dataclass(frozen=True)
class Quantity:
    """A value of each vertex."""

    label: str
    """What it is, with its unit."""
    values: Callable[[_Rows, Position], NDArray[Any]]
    """Of vertices (N,), for a sensor position, world, m: (N,)."""
    scale: Colors | Classes
    of_sensor: bool = False
    """Whether it depends on the sensor position."""

    def colors(self, rows: _Rows, sensor: Position) -> NDArray[np.uint8]:
        """(N, 3) sRGB of vertices (N,)."""
        return self.scale(self.values(rows, sensor))


def quantities_of(
    radar_map: Map, surface: ShownSurface, scans: Scans | None, sensor: Position
) -> dict[str, Quantity]:
    """The quantities by name, the default first. The intensity scale is that for the first `sensor` position."""
    vertices, found = surface.vertices, {}

    def intensity(rows: _Rows, sensor: Position) -> NDArray[Any]:
        values: NDArray[Any] = radar_map.intensity(vertices[rows], np.array(sensor), extrapolate=True)
        return values

    if radar_map.has_intensity:
        some = np.arange(0, len(vertices), max(1, len(vertices) // _SAMPLES))
        scale = _scale(intensity(some, sensor))
        found["intensity"] = Quantity("predicted intensity, sensor units", intensity, scale, of_sensor=True)
    for name, label, values in (
        ("uncertainty", "uncertainty (standard error), m", surface.uncertainty_m),
        ("confidence", "confidence (probability)", surface.confidence),
        ("height", "height, m", vertices[:, 2]),
    ):
        scale = Colors(0.0, 1.0) if name == "confidence" else _scale(values)
        found[name] = Quantity(label, _looked_up(values), scale)
    if scans is not None:
        edge_m = radar_map.config.leaf_size_m
        observed = functools.cache(lambda: _near_returns(vertices, scans, edge_m))
        names = (f"bridged: no return within {edge_m:g} m", "observed")
        found["observed"] = Quantity("observed by returns", lambda rows, _: observed()[rows], Classes(names))
    return found


def _near_returns(vertices: NDArray[np.float64], scans: Scans, distance_m: float) -> NDArray[np.bool_]:
    """(V,) whether a return is near a vertex (V, 3): elsewhere the surface was continued. Takes seconds of many returns."""
    returns = np.concatenate([scan.world_points for scan in scans])
    workers = resolve_num_threads(0)
    nearest_m, _ = cKDTree(returns).query(vertices, distance_upper_bound=distance_m, workers=workers)
    return np.asarray(np.isfinite(nearest_m))


def _looked_up(values: NDArray[Any]) -> Callable[[_Rows, Position], NDArray[Any]]:
    return lambda rows, _: values[rows]


def _scale(values: NDArray[Any]) -> Colors:
    """The scale from the 2nd to the 98th percentile of values (N,)."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [2, 98]) if len(known) else (0.0, 1.0)
    return Colors(float(low), float(high))
