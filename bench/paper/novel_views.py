# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Held-out scans beside what the map predicts from their poses, and beside the nearest training scan, replayed.

The replay is the training scan from the nearest position, moved by the known poses. Returns outside the ranges of the
scene do not count. A view has as many returns as the sensor gives, or a multiple.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from radarsdf.render.figures import save_view_picture
from scipy.spatial import cKDTree

from .experiment import Experiment, Options, Row, Task, fit, groups
from .report import figure, markdown
from .scenes import Scene

EXPLAINED_M = 0.3
_MULTIPLES = (1, 2, 4)
_METHODS = ("replay", *(f"view × {n}" for n in _MULTIPLES))

Floats = NDArray[np.float64]
Returns = tuple[Floats, Floats]
"""Points (N, 3), sensor frame, m, and intensities (N,), NaN without any."""


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each configuration."""
    return [Task(f"{scene.name}: {base}", partial(_rows, scene, options, base)) for base in options.bases]


def _rows(scene: Scene, options: Options, base: str) -> list[Row]:
    train, test = scene.split()
    radar_map = fit(train, options.config(base, scene))
    found: dict[str, list[Row]] = {method: [] for method in _METHODS}
    example: Row = {}
    for frame in range(len(test)):
        measured = returns_of(test, frame)
        if len(measured[0]) == 0:
            continue
        found["replay"].append(errors(replayed(train, test.poses[frame]), measured))
        for multiple, method in zip(_MULTIPLES, _METHODS[1:], strict=True):
            view = radar_map.render(test.poses[frame], returns=multiple * radar_map.sensor.returns_per_scan)
            found[method].append(errors(_predicted(view), measured))
            if multiple == 1 and frame == len(test) // 2:
                example = {"_view": view, "_measured": np.column_stack(measured)}
    shared = {"scene": scene.name, "base": base}
    rows = [shared | {"method": method} | _mean(own) for method, own in found.items() if own]
    if options.meshes is not None and example:
        save_view_picture(
            f"{options.meshes / scene.name}, {base}, view.png", [example["_view"]], [example["_measured"]]
        )
    return rows or [shared | {"why_not": "no held-out scan has a return within the ranges"}]


def returns_of(scene: Scene, frame: int) -> Returns:
    """The returns of a scan within the ranges of its scene."""
    points = np.asarray(scene.points[frame], np.float64)
    kept = scene.is_used(frame)
    values = np.full(len(points), np.nan) if scene.intensities is None else scene.intensities[frame]
    return points[kept], np.asarray(values, np.float64)[kept]


def replayed(train: Scene, T_world_sensor: Floats) -> Returns:
    """The training scan taken nearest to a pose, seen from that pose."""
    positions = train.poses[:, :3, 3]
    nearest = int(np.linalg.norm(positions - T_world_sensor[:3, 3], axis=1).argmin())
    points, values = returns_of(train, nearest)
    world = points @ train.poses[nearest, :3, :3].T + positions[nearest]
    return (world - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3], values


def _predicted(view: Any) -> Returns:
    values = np.full(len(view), np.nan) if view.intensities is None else view.intensities
    return view.points.astype(np.float64), np.asarray(values, np.float64)


def errors(predicted: Returns, measured: Returns) -> Row:
    """How far a predicted scan is from a measured one.

    `chamfer_m`: mean of the two mean distances to the nearest return of the other scan. `explained`: share of the
    measured returns with a predicted one within 0.3 m. `confirmed`: the reverse. `intensity`: mean absolute error of
    the nearest predicted return of each that is explained.
    """
    (points, values), (true, true_values) = predicted, measured
    if len(points) == 0:
        return {"returns": 0, "chamfer_m": np.nan, "explained": 0.0, "confirmed": np.nan, "intensity": np.nan}
    to_predicted_m, nearest = cKDTree(points).query(true)
    to_measured_m, _ = cKDTree(true).query(points)
    explained = to_predicted_m <= EXPLAINED_M
    differences = np.abs(values[nearest] - true_values)[explained]
    return {
        "returns": len(points),
        "chamfer_m": (to_predicted_m.mean() + to_measured_m.mean()) / 2,
        "explained": explained.mean(),
        "confirmed": (to_measured_m <= EXPLAINED_M).mean(),
        "intensity": differences.mean() if len(differences) else np.nan,
    }


def _mean(rows: list[Row]) -> Row:
    """Over the scans of a scene. NaN: none of them has a value."""
    means = {}
    for key in rows[0]:
        known = [row[key] for row in rows if not np.isnan(row[key])]
        means[key] = float(np.mean(known)) if known else np.nan
    return means


def table(rows: list[Row]) -> str:
    """A line for each scene and method."""
    cells = []
    for (scene, base), own in groups(rows, "scene", "base").items():
        for row in own:
            if "why_not" in row:
                cells.append([scene, base, row["why_not"], *["–"] * 5])
                continue
            cells.append(
                [
                    scene,
                    base,
                    row["method"],
                    f"{row['returns']:.0f}",
                    f"{row['chamfer_m']:.2f}",
                    f"{100 * row['explained']:.1f}",
                    f"{100 * row['confirmed']:.1f}",
                    f"{row['intensity']:.2f}",
                ]
            )
    header = [
        "scene",
        "configuration",
        "method",
        "returns",
        "Chamfer, m",
        "explained, %",
        "confirmed, %",
        "intensity",
    ]
    return markdown(header, cells)


def plot(rows: list[Row], path: Path) -> None:
    """Explained and confirmed shares of each method."""
    measured = [row for row in rows if "method" in row]
    with figure(path, rows=1, columns=1) as axes:
        for (method,), own in groups(measured, "method").items():
            axes[0][0].plot(
                [100 * row["explained"] for row in own],
                [100 * row["confirmed"] for row in own],
                "o",
                label=method,
            )
        axes[0][0].set(xlabel="measured returns explained, %", ylabel="predicted returns confirmed, %")


EXPERIMENT = Experiment(
    "Held-out scans: predicted, and replayed",
    ("hugin", "oculii", "wall", "astyx"),
    tasks,
    table,
    plot,
    bases=("default",),
)
