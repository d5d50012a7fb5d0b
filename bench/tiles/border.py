# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A picture of a border between tiles from close by: sections across it, and the reflectance along it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from radarsdf import RadarMap, TiledMap

_HALF_M = 3.0  # of what is drawn, along the section and in height
_STEP_M = 0.02

_Floats = NDArray[np.float64]


def draw(city: TiledMap, one: RadarMap, vertices: _Floats, path: Path) -> None:
    """Draws where the surface of the tiles, and that of one fit, cut a vertical plane across a border.

    Parameters
    ----------
    city, one : TiledMap, RadarMap
        Of the same scans.
    vertices : (V, 3) ndarray
        Of the mesh of the tiles, world, m. The border is drawn where most of them are.
    path : Path
        A PNG file.
    """
    centre, across = _busiest(city, vertices)
    s = np.arange(-_HALF_M, _HALF_M, _STEP_M)
    along, height = np.meshgrid(s, s, indexing="ij")
    grid = np.tile(centre, (along.size, 1))
    grid[:, across] += along.ravel()
    grid[:, 2] += height.ravel()
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for map_, color, width, label in ((one, "#c0392b", 2.5, "one fit"), (city, "#2c3e50", 1.2, "tiles")):
        unknown = ~map_.observed(grid)
        distance_m: Any = np.where(unknown, np.nan, map_.sdf(grid)).reshape(along.shape)
        left.contour(s, s, distance_m.T, [0.0], colors=color, linewidths=width)
        left.plot([], [], color=color, lw=width, label=label)
        if city.has_intensity:
            sensor = city.config.lattice.position(city.tiles[0].origin_cells)
            near = np.abs(np.nan_to_num(distance_m, nan=np.inf)).argmin(axis=1)
            points = grid.reshape(*along.shape, 3)[np.arange(len(s)), near]
            right.plot(s, map_.intensity(points, sensor), color=color, lw=width, label=label)
    for axes in (left, right):
        axes.axvline(0, color="#888888", lw=0.8, ls="--")
        axes.set_xlabel("across the border, m")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    left.set(title="where the signed distance is zero", ylabel="height, m", aspect="equal")
    right.set(title="intensity of that surface", ylabel="dB")
    figure.savefig(path, dpi=110)


def _busiest(city: TiledMap, vertices: _Floats) -> tuple[_Floats, int]:
    """(3,) the place on a border, world, m, with most vertices within a metre, and the axis across the border."""
    way_m = vertices[:, :2] - city.plan.grid.corner_m
    way_m -= np.round(way_m / city.plan.tile_m) * city.plan.tile_m
    across = int(np.abs(way_m).min(axis=0).argmin())
    near = vertices[np.abs(way_m[:, across]) < 0.5]
    cells, counts = np.unique(np.round(near), axis=0, return_counts=True)
    centre = cells[counts.argmax()]
    own = near[np.abs(near - centre).max(axis=1) < 1]
    place = np.median(own, axis=0)
    offset = place[across] - city.plan.grid.corner_m
    place[across] = (
        city.plan.grid.corner_m + np.round(offset / city.plan.tile_m) * city.plan.tile_m
    )  # on the border
    return place, across
