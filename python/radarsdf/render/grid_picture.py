# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A picture of a grid from above: heights of the ground, costs for wheels, what is free, and room round a robot."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.grids.grid import Grid
from radarsdf.io.files import write_whole
from radarsdf.render.figures import new_figure, png_of

_WIDTH_IN, _DPI = 12.0, 110


def save_grid_picture(path: str | PathLike[str], grid: Grid, lower_m: float, upper_m: float) -> None:
    """Draws a grid as PNG. `lower_m`, `upper_m`: see :meth:`Grid.flat`.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    OSError
        If the file cannot be written.
    """
    x, y, _ = grid.shape
    height_in = float(np.clip(_WIDTH_IN * y / x, 4.0, 14.0))
    figure = new_figure(figsize=(_WIDTH_IN, height_in), dpi=_DPI, facecolor="white", layout="constrained")
    axes = figure.subplots(2, 2)
    costs, flat = grid.costmap(), grid.flat(lower_m, upper_m)
    middle = int(np.argmax(grid.free.sum(axis=(0, 1))))
    room = grid.distances().not_free_m[:, :, middle]
    level_m = grid.origin[2] + (middle + 0.5) * grid.voxel_size
    low, high = np.nanpercentile(costs.height_m, [2, 98]) if np.isfinite(costs.height_m).any() else (0, 1)
    cost = np.where(costs.cost >= 0, costs.cost, np.nan).astype(np.float32)
    _draw(figure, axes[0, 0], grid, costs.height_m, "height of the ground, m", vmin=low, vmax=high)
    _draw(figure, axes[0, 1], grid, cost, "cost for wheels, 100: too much", cmap="inferno", vmin=0, vmax=100)
    state = np.where(flat.state < 0, np.nan, flat.state).astype(np.float32)
    title = f"{lower_m:g} to {upper_m:g} m above ground: 0 free, 1 occupied"
    _draw(figure, axes[1, 0], grid, state, title, cmap="RdYlGn_r", vmin=0, vmax=1)
    room = np.where(room > 0, room, np.nan)
    _draw(figure, axes[1, 1], grid, room, f"free all round at z = {level_m:.1f} m, m", cmap="Blues")
    write_whole(path, png_of(figure))


def _draw(figure: Any, axes: Any, grid: Grid, values: NDArray[Any], title: str, **options: Any) -> None:
    x, y, _ = grid.shape
    corner, size = grid.origin, grid.voxel_size
    extent = (corner[0], corner[0] + x * size, corner[1], corner[1] + y * size)
    image = axes.imshow(values.T, origin="lower", extent=extent, interpolation="nearest", **options)
    axes.set_facecolor("#d0d0d0")  # what is unknown
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    figure.colorbar(image, ax=axes, shrink=0.8)
