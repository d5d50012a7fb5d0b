# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Pictures of trajectories from above, with the returns that they put in place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.files import write_whole
from radarsdf.render.figures import new_figure, png_of

_MOST_RETURNS = 60_000  # that are drawn, of all scans
_COLORS = ("#d95f02", "#1b6ca8", "#2a7f3f", "#8e44ad")
_WIDTH_IN, _DPI = 8.0, 120


def trajectory_picture(
    points: Sequence[NDArray[Any]], trajectories: Mapping[str, NDArray[np.float64]]
) -> bytes:
    """The bytes of a PNG picture.

    Parameters
    ----------
    points : sequence of F arrays
        (N_i, 3) each, sensor frame, m. They are drawn where the last trajectory puts them.
    trajectories : mapping
        Name and poses (F, 4, 4) T_world_sensor of each, all in one world.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    """
    poses = list(trajectories.values())[-1]
    step = max(1, sum(map(len, points)) // _MOST_RETURNS)
    world = np.concatenate(
        [
            np.einsum("ij,nj->ni", T[:2, :3], np.asarray(scan[::step], np.float64)) + T[:2, 3]
            for scan, T in zip(points, poses, strict=True)
        ]
    )
    shown = np.concatenate([world, *(path[:, :2, 3] for path in trajectories.values())])
    low, high = np.percentile(shown, [1, 99], axis=0)
    low = np.minimum(low, np.min([path[:, :2, 3].min(axis=0) for path in trajectories.values()], axis=0))
    high = np.maximum(high, np.max([path[:, :2, 3].max(axis=0) for path in trajectories.values()], axis=0))
    width, height = np.maximum(high - low, 1.0)
    size = (_WIDTH_IN, float(np.clip(_WIDTH_IN * height / width, 3.0, 10.0)))
    figure = new_figure(figsize=size, dpi=_DPI, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    axes.scatter(*world.T, s=0.6, c="#b9b9b9", linewidths=0, rasterized=True)
    widths = np.linspace(3.5, 1.5, len(trajectories)) if len(trajectories) > 1 else [1.8]
    for (name, path), color, width_pt in zip(trajectories.items(), _COLORS, widths, strict=False):
        axes.plot(*path[:, :2, 3].T, color=color, linewidth=width_pt, label=name)
        axes.plot(*path[0, :2, 3], "o", color=color, markersize=5)
    axes.set_xlim(low[0] - 0.03 * width, high[0] + 0.03 * width)
    axes.set_ylim(low[1] - 0.03 * height, high[1] + 0.03 * height)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.legend(loc="best", frameon=True)
    return png_of(figure)


def save_trajectory_picture(
    path: str | PathLike[str],
    points: Sequence[NDArray[Any]],
    trajectories: Mapping[str, NDArray[np.float64]],
) -> None:
    """Write :func:`trajectory_picture`, whole or not at all."""
    write_whole(path, trajectory_picture(points, trajectories))
