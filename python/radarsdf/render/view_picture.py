# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Pictures of scans, measured and predicted: range against azimuth, elevation against azimuth."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.files import write_whole
from radarsdf.map.view import View
from radarsdf.render.figures import new_figure, png_of

_DPI = 100
_ROW_INCHES, _COLUMN_INCHES = 3.6, 4.6


def save_view_picture(
    path: str | PathLike[str], views: Sequence[View], measured: Sequence[NDArray[Any] | None] = ()
) -> None:
    """Save a PNG picture of views, a row for each.

    From left to right: the measured returns if there are any, the returns of the view, both range against azimuth, and
    the range to the first surface along each beam, elevation against azimuth.

    Parameters
    ----------
    path : path-like
        The PNG file. An old file is replaced once the new one is complete.
    views : sequence of View
        At least one.
    measured : sequence of arrays, optional
        (N, 3) or (N, 4) for each view: what was measured from there, sensor frame, m, and intensity. None: nothing was.

    Raises
    ------
    ImportError
        If matplotlib is not installed. It comes with the extra `plot`.
    OSError
        If the file cannot be written.
    """
    scans = list(measured) or [None] * len(views)
    columns = 3 if any(scan is not None for scan in scans) else 2
    figure = new_figure(
        figsize=(_COLUMN_INCHES * columns, _ROW_INCHES * len(views)), dpi=_DPI, layout="constrained"
    )
    rows = figure.subplots(len(views), columns, squeeze=False)
    for axes, view, scan in zip(rows, views, scans, strict=True):
        values = None if view.intensities is None else view.intensities
        limits = _limits([values, scan[:, 3] if scan is not None and scan.shape[1] > 3 else None])
        if scan is not None:
            _scatter(
                axes[0], view, scan[:, :3], scan[:, 3] if scan.shape[1] > 3 else None, limits, "measured"
            )
        points = _scatter(axes[columns - 2], view, view.points, values, limits, "predicted")
        if values is not None:
            figure.colorbar(points, ax=axes[columns - 2], label="intensity")
        elevation, azimuth = np.rad2deg(view.elevation_rad), np.rad2deg(view.azimuth_rad)
        image = axes[-1].pcolormesh(
            azimuth, elevation, view.beam_ranges_m, cmap="viridis_r", shading="nearest"
        )
        axes[-1].set(title="first surface", xlabel="azimuth, °", ylabel="elevation, °")
        axes[-1].invert_xaxis()  # as seen from the sensor: left is left
        figure.colorbar(image, ax=axes[-1], label="range, m")
    write_whole(path, png_of(figure, dpi=_DPI))


def _scatter(
    axes: Any,
    view: View,
    points: NDArray[Any],
    values: NDArray[Any] | None,
    limits: tuple[float, float],
    title: str,
) -> Any:
    azimuth = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
    ranges_m = np.linalg.norm(points, axis=1)
    drawn = axes.scatter(
        azimuth,
        ranges_m,
        2,
        "tab:blue" if values is None else values,
        vmin=limits[0],
        vmax=limits[1],
        linewidths=0,
    )
    axes.set(
        title=f"{title}: {len(points)} returns",
        xlabel="azimuth, °",
        ylabel="range, m",
        xlim=np.rad2deg(view.sensor.azimuth_rad)[::-1],
        ylim=(0, view.sensor.range_m[1]),
    )
    return drawn


def _limits(values: list[NDArray[Any] | None]) -> tuple[float, float]:
    known = [value for value in values if value is not None and len(value)]
    if not known:
        return 0.0, 1.0
    low, high = np.quantile(np.concatenate(known), [0.02, 0.98])
    return float(low), float(high)
