# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""View-dependent intensity of a corner reflector, with and without the viewing direction as input (figure)."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .experiment import Experiment, Options, Row, Task, fit, groups, world_returns
from .report import figure, markdown
from .scenes import Scene

_VARIANTS = {"full": True, "w/o viewing direction": False}
_ANGLES_DEG = np.arange(-90, 91, 15)
_REFLECTOR_M = 0.6  # nearer returns belong to the reflector: edges of 0.3 to 0.4 m, and noise across the beam


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each configuration, with and without the viewing direction."""
    return [
        Task(f"{scene.name}: {base}, {variant}", partial(_rows, scene, options, base, variant))
        for base in options.bases
        for variant in _VARIANTS
    ]


def _rows(scene: Scene, options: Options, base: str, variant: str) -> list[Row]:
    row: Row = {"scene": scene.name, "base": base, "variant": variant}
    if scene.intensities is None:
        return [row | {"why_not": "the scene has no intensities"}]
    train, test = scene.split()
    radar_map = fit(train, options.config(base, scene, networks={"view_direction": _VARIANTS[variant]}))
    x, sensors, measured = world_returns(test)
    reflector = _reflector(scene)
    row |= {"angle_deg": _angle_deg(sensors, reflector), "distance_m": np.linalg.norm(x - reflector, axis=1)}
    row |= {
        "x": x - reflector,
        "measured": measured,
        "predicted": radar_map.intensity(x, sensors, extrapolate=True),
    }
    if test.simulation is not None:
        row["truth"] = _noiseless(test)
    return [row]


def _reflector(scene: Scene) -> np.ndarray:
    """Position (3,) of the reflector, world frame, m.

    It is the centre of the circle that the sensor drove, at the height of the strongest returns there.
    """
    x, y = scene.poses[:, :2, 3].T - scene.poses[:, :2, 3].mean(axis=0)[:, None]
    # |p - c|² = r² is linear in c and r² - |c|².
    a, b, _ = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
    centre = np.array([a, b]) + scene.poses[:, :2, 3].mean(axis=0)
    points, _, measured = world_returns(scene)
    near = np.linalg.norm(points[:, :2] - centre, axis=1) < _REFLECTOR_M
    if not near.any():
        return np.append(centre, scene.poses[:, 2, 3].mean())
    strong = near & (measured >= np.quantile(measured[near], 0.9))
    return np.append(centre, np.median(points[strong, 2]))


def _angle_deg(sensors: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Azimuth (N,), degrees, of the sensor positions (N, 3) as seen from `place`, 0 in the middle of the path."""
    offset = sensors[:, :2] - place[:2]
    azimuth = np.arctan2(offset[:, 1], offset[:, 0])
    middle = np.angle(np.exp(1j * np.unique(azimuth)).mean())  # each scan counts once, not each return
    angle: np.ndarray = np.rad2deg(np.angle(np.exp(1j * (azimuth - middle))))
    return angle


def _noiseless(scene: Scene) -> np.ndarray:
    """Noiseless intensities of the simulated returns within the ranges of the scene; NaN for false returns."""
    assert scene.simulation is not None
    values = enumerate(scene.simulation.noiseless_intensities)
    return np.concatenate([of_scan[scene.is_used(frame)] for frame, of_scan in values])


def _error(row: Row, selected: np.ndarray) -> str:
    """Mean absolute error against the measured and, if it is known, the noiseless intensity."""
    if not selected.any():
        return "–"
    error = np.abs(row["predicted"] - row["measured"])[selected].mean()
    if "truth" not in row:
        return f"{error:.2f}"
    true = selected & np.isfinite(row["truth"])
    against_truth = np.abs(row["predicted"] - row["truth"])[true].mean() if true.any() else np.nan
    return f"{error:.2f} / {against_truth:.2f}"


def table(rows: list[Row]) -> str:
    """Errors over the angle of view, separately for returns at the reflector and for all others."""
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        if why_not := own[0].get("why_not"):
            parts.append(f"### {scene}\n\n{why_not}")
            continue
        for near, heading in ((True, "at the reflector"), (False, "elsewhere")):
            cells = []
            for row in own:
                place = (row["distance_m"] < _REFLECTOR_M) == near
                bins = itertools.pairwise(_ANGLES_DEG)
                by_angle = [
                    _error(row, place & (row["angle_deg"] >= a) & (row["angle_deg"] < b)) for a, b in bins
                ]
                cells.append([row["base"], row["variant"], _error(row, place), *by_angle])
            header = ["configuration", "variant", "all", *(f"{a} to {a + 15}°" for a in _ANGLES_DEG[:-1])]
            note = "MAE against the measured intensity"
            note += " / against the noiseless intensity" if "truth" in own[0] else ""
            parts.append(f"### {scene}, {heading}: {note}\n\n{markdown(header, cells)}")
    return "\n\n".join(parts)


def plot(rows: list[Row], path: Path) -> None:
    """For each configuration: measured intensities, errors of both variants, and intensities over the angle of view."""
    panels = groups([row for row in rows if "predicted" in row], "scene", "base")
    with figure(path, rows=max(1, len(panels)), columns=4) as axes:
        for line, ((scene, base), own) in zip(axes, panels.items(), strict=False):
            _cloud(line[0], own[0], own[0]["measured"], "measured intensity", None)
            line[0].set_title(f"{scene}, {base}: measured")
            largest = float(np.quantile(np.abs(own[-1]["predicted"] - own[-1]["measured"]), 0.98))
            for ax, row in zip(line[1:3], own, strict=False):
                _cloud(ax, row, np.abs(row["predicted"] - row["measured"]), "error", largest)
                ax.set_title(row["variant"])
            _lobe(line[3], own)


def _cloud(ax: Any, row: Row, values: np.ndarray, label: str, largest: float | None) -> None:
    order = np.argsort(values)
    points = ax.scatter(
        row["x"][order, 1],
        row["x"][order, 2],
        3,
        values[order],
        vmax=largest,
        cmap="viridis",
        rasterized=True,
    )
    ax.figure.colorbar(points, ax=ax, label=label)
    ax.set(xlabel="y from the reflector, m", ylabel="z, m", xlim=(-8, 8), ylim=(-2, 4))


def _lobe(ax: Any, rows: list[Row]) -> None:
    at = rows[0]["distance_m"] < _REFLECTOR_M
    ax.plot(rows[0]["angle_deg"][at], rows[0]["measured"][at], ".", ms=3, color="lightgray", label="measured")
    if "truth" in rows[0]:
        ax.plot(rows[0]["angle_deg"][at], rows[0]["truth"][at], ".", ms=3, color="black", label="noiseless")
    for row in rows:
        ax.plot(row["angle_deg"][at], row["predicted"][at], ".", ms=3, label=row["variant"])
    ax.set(title="at the reflector", xlabel="seen from, °", ylabel="intensity")


EXPERIMENT = Experiment("View-dependent intensity of the corner reflector", ("wall",), tasks, table, plot)
