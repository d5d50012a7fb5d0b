"""Figures by matplotlib, an extra: views, grids and trajectories. They need no display and do not change its settings."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from radarsdf.arrays import Array, Floats
from radarsdf.checks import AnyPath
from radarsdf.extras import require
from radarsdf.grids.grid import Grid
from radarsdf.io.files import write_whole
from radarsdf.map.colors import Scale
from radarsdf.map.view import View

_UNKNOWN = "#d0d0d0"
_TRAJECTORY_COLORS = ("#d95f02", "#1b6ca8", "#2a7f3f", "#8e44ad")
_MAX_RETURNS = 60_000  # largest number in a picture of trajectories


def new_figure(**options: Any) -> Any:
    """Create a matplotlib figure that needs no display; `options` are those of ``matplotlib.figure.Figure``."""
    require("matplotlib", what="pictures need")
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    return Figure(**options)


def png_of(figure: Any, **options: Any) -> bytes:
    """Encode a figure as PNG; `options` are those of ``Figure.savefig``."""
    file = io.BytesIO()
    figure.savefig(file, format="png", **options)
    return file.getvalue()


def save_view_picture(path: AnyPath, views: Sequence[View], measured: Sequence[Array | None] = ()) -> None:
    """Save a PNG picture of views, one row each.

    The columns are the measured returns, if there are any, and the predicted ones, both as range over azimuth, and the
    range to the first surface along each beam, as elevation over azimuth. Raises an ImportError without matplotlib (the
    extra `plot`), an OSError if the file cannot be written.

    Parameters
    ----------
    path : path-like
        The PNG file. An existing file is replaced once the new one is complete.
    views : sequence of View
        At least one.
    measured : sequence of arrays, optional
        For each view, the returns measured there: (N, 3) sensor frame, m, or (N, 4) with their intensity. None
        if nothing was measured.
    """
    scans = list(measured) or [None] * len(views)
    columns = 3 if any(scan is not None for scan in scans) else 2
    figure = new_figure(figsize=(4.6 * columns, 3.6 * len(views)), dpi=100, layout="constrained")
    rows = figure.subplots(len(views), columns, squeeze=False)
    for axes, view, scan in zip(rows, views, scans, strict=True):
        measured_values = None if scan is None or scan.shape[1] == 3 else scan[:, 3]
        known = [v for v in (view.intensities, measured_values) if v is not None and len(v)]
        limits = np.quantile(np.concatenate(known), [0.02, 0.98]) if known else np.array([0.0, 1.0])
        if scan is not None:
            _draw_returns(axes[0], view, scan[:, :3], measured_values, limits, "measured")
        drawn = _draw_returns(axes[-2], view, view.points, view.intensities, limits, "predicted")
        if view.intensities is not None:
            figure.colorbar(drawn, ax=axes[-2], label="intensity")
        beams = np.rad2deg(view.azimuth_rad), np.rad2deg(view.elevation_rad), view.beam_ranges_m
        image = axes[-1].pcolormesh(*beams, cmap="viridis_r", shading="nearest")
        axes[-1].set(title="first surface", xlabel="azimuth, °", ylabel="elevation, °")
        axes[-1].invert_xaxis()  # as seen by the sensor: left is left
        figure.colorbar(image, ax=axes[-1], label="range, m")
    write_whole(path, png_of(figure, dpi=100))


def _draw_returns(axes: Any, view: View, points: Array, values: Array | None, limits: Any, title: str) -> Any:
    azimuth_deg = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
    range_m = np.linalg.norm(points, axis=1)
    colors = {"color": "tab:blue"} if values is None else {"c": values, "vmin": limits[0], "vmax": limits[1]}
    drawn = axes.scatter(azimuth_deg, range_m, 2, linewidths=0, **colors)
    axes.set(title=f"{title}: {len(points)} returns", xlabel="azimuth, °", ylabel="range, m")
    axes.set(xlim=np.rad2deg(view.sensor.azimuth_rad)[::-1], ylim=(0, view.sensor.range_m[1]))
    return drawn


def save_grid_picture(path: AnyPath, grid: Grid, lower_m: float, upper_m: float) -> None:
    """Save a PNG picture of a grid from above. `lower_m`, `upper_m`: the heights of :meth:`Grid.flat`."""
    x, y, _ = grid.shape
    (x_m, y_m), size_m = grid.origin[:2], grid.voxel_size
    extent = (x_m, x_m + x * size_m, y_m, y_m + y * size_m)
    size_in = (12.0, float(np.clip(12.0 * y / x, 4.0, 14.0)))
    figure = new_figure(figsize=size_in, dpi=110, facecolor="white", layout="constrained")

    def draw(axes: Any, values: Array, title: str, **options: Any) -> None:
        shown = values.T.astype(np.float32)
        image = axes.imshow(shown, origin="lower", extent=extent, interpolation="nearest", **options)
        axes.set_facecolor(_UNKNOWN)
        axes.set_title(title, fontsize=10)
        axes.set(xlabel="x, m", ylabel="y, m")
        figure.colorbar(image, ax=axes, shrink=0.8)

    (ground, cost), (occupancy, clearance) = figure.subplots(2, 2)
    costs, state = grid.costmap(), grid.flat(lower_m, upper_m).state
    scale = Scale.of(costs.height_m)
    draw(ground, costs.height_m, "ground height, m", vmin=scale.low, vmax=scale.high)
    costs_known = np.where(costs.cost >= 0, costs.cost, np.nan)
    draw(cost, costs_known, "cost for wheels, 100: impassable", cmap="inferno", vmin=0, vmax=100)
    title = f"{lower_m:g} to {upper_m:g} m above ground: 0 free, 1 occupied"
    draw(occupancy, np.where(state < 0, np.nan, state), title, cmap="RdYlGn_r", vmin=0, vmax=1)
    level = int(np.argmax(grid.free.sum(axis=(0, 1))))
    distance_m = grid.distances().not_free_m[:, :, level]
    title = f"clearance at z = {grid.origin[2] + (level + 0.5) * size_m:.1f} m, m"
    draw(clearance, np.where(distance_m > 0, distance_m, np.nan), title, cmap="Blues")
    write_whole(path, png_of(figure))


def save_trajectory_picture(
    path: AnyPath, points: Sequence[Array], trajectories: Mapping[str, Floats]
) -> None:
    """Save a PNG picture of trajectories from above, with the returns.

    `points`: (N_i, 3) per scan, sensor frame, m, placed by the last of the `trajectories`: T_world_sensor (F, 4, 4) by name.
    """
    poses = list(trajectories.values())[-1]
    step = max(1, sum(map(len, points)) // _MAX_RETURNS)
    scans = zip((np.asarray(scan[::step], np.float64) for scan in points), poses, strict=True)
    world = np.concatenate([np.einsum("ij,nj->ni", T[:2, :3], scan) + T[:2, 3] for scan, T in scans])
    paths = {name: path[:, :2, 3] for name, path in trajectories.items()}
    positions = np.concatenate(list(paths.values()))
    low, high = np.percentile(world, [1, 99], axis=0)
    low, high = np.minimum(low, positions.min(axis=0)), np.maximum(high, positions.max(axis=0))
    width, height = np.maximum(high - low, 1.0)

    size_in = (8.0, float(np.clip(8.0 * height / width, 3.0, 10.0)))
    figure = new_figure(figsize=size_in, dpi=120, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    axes.scatter(*world.T, s=0.6, c="#b9b9b9", linewidths=0, rasterized=True)
    draw_trajectories(axes, paths)
    axes.set_xlim(low[0] - 0.03 * width, high[0] + 0.03 * width)
    axes.set_ylim(low[1] - 0.03 * height, high[1] + 0.03 * height)
    write_whole(path, png_of(figure))


def draw_trajectories(axes: Any, paths: Mapping[str, Floats]) -> None:
    """Draw positions (F, 2) or (F, 3), m, by name from above, later ones thinner; a circle marks the first scan."""
    widths = np.linspace(1.5, 3.0, len(paths))[::-1]
    for (name, path), color, line_width in zip(paths.items(), _TRAJECTORY_COLORS, widths, strict=False):
        axes.plot(*path[:, :2].T, color=color, linewidth=line_width, label=name)
        axes.plot(*path[0, :2], "o", color=color, markersize=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.legend(loc="best", frameon=True)
