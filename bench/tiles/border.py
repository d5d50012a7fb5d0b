# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A picture of a border between tiles from close by: sections across it, and the reflectance along it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from radarsdf import RadarMap, TiledMap

from bench.paper.report import figure

_HALF_M = 3.0  # of what is drawn, along the section and in height
_STEP_M = 0.02

_Floats = NDArray[np.float64]


def draw(city: TiledMap, one: RadarMap, mesh: Any, positions: _Floats, path: Path) -> None:
    """Draws where the surface of the tiles, and that of one fit, cut a vertical plane across a border.

    Parameters
    ----------
    city, one : TiledMap, RadarMap
        Of the same scans.
    mesh : trimesh.Trimesh
        Of the tiles. The border is drawn where most of it crosses one.
    positions : (F, 3) ndarray
        Of the sensor, world, m. The intensities are for the nearest.
    path : Path
        A PNG file.
    """
    centre, across = _busiest(city, mesh)
    sensor = positions[np.linalg.norm(positions - centre, axis=1).argmin()]
    s = np.arange(-_HALF_M, _HALF_M, _STEP_M)
    along, height = np.meshgrid(s, s, indexing="ij")
    grid = np.tile(centre, (along.size, 1))
    grid[:, across] += along.ravel()
    grid[:, 2] += height.ravel()
    with figure(path, columns=2, size=(5.5, 4)) as ((left, right),):
        for map_, color, width, label in ((one, "#c0392b", 2.5, "one fit"), (city, "#2c3e50", 1.2, "tiles")):
            unknown = ~map_.observed(grid)
            distance_m: Any = np.where(unknown, np.nan, map_.sdf(grid)).reshape(along.shape)
            left.contour(s, s, distance_m.T, [0.0], colors=color, linewidths=width)
            left.plot([], [], color=color, lw=width, label=label)
            if city.has_intensity:
                size_m = np.abs(np.nan_to_num(distance_m, nan=np.inf))
                rows = np.arange(len(s)), size_m.argmin(axis=1)
                values = map_.intensity(grid.reshape(*along.shape, 3)[rows], sensor)
                values[size_m[rows] > 2 * _STEP_M] = np.nan  # no surface is there
                right.plot(s, values, color=color, lw=width, label=label)
        for axes in (left, right):
            axes.axvline(0, color="#888888", lw=0.8, ls="--")
            axes.set_xlabel("across the border, m")
            axes.grid(alpha=0.3)
        left.set(title="where the signed distance is zero", ylabel="height, m", aspect="equal")
        right.set(title="intensity of that surface", ylabel="dB")


def _busiest(city: TiledMap, mesh: Any) -> tuple[_Floats, int]:
    """(3,) the place on a border, world, m, where most surface crosses it, and the axis across the border."""
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    way_m = vertices[:, :2] - city.plan.grid.corner_m
    way_m -= np.round(way_m / city.plan.tile_m) * city.plan.tile_m
    crosses = (np.abs(way_m) < 0.5) & (np.abs(normals[:, :2]) < 0.3)
    across = int(crosses.sum(axis=0).argmax())
    near = vertices[crosses[:, across]]
    cells, counts = np.unique(np.round(near), axis=0, return_counts=True)
    centre = cells[counts.argmax()]
    own = near[np.abs(near - centre).max(axis=1) < 1]
    place = np.median(own, axis=0)
    offset = place[across] - city.plan.grid.corner_m
    place[across] = (
        city.plan.grid.corner_m + np.round(offset / city.plan.tile_m) * city.plan.tile_m
    )  # on the border
    return place, across
