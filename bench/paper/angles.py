# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Histograms of the angles between adjacent triangles of all methods (figure)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from radarsdf.evaluation import adjacent_angles, gamma_from_moments

from .experiment import Experiment, Options, Row, for_each_peer, panels
from .report import markdown
from .scenes import Scene

_BINS = np.linspace(0, np.pi, 181)


def _rows(scene: Scene, name: str, options: Options) -> list[Row]:
    row: Row = {"scene": scene.name, "method": name}
    result = options.reconstruct(name, scene)
    if result.mesh is None:
        return [row | {"why_not": result.why_not}]
    angles = adjacent_angles(result.mesh, box=scene.box)
    if len(angles) == 0:
        return [row | {"why_not": "no two triangles in the box share an edge"}]
    shape, mean, variance = gamma_from_moments(angles)
    row |= {"gamma_shape": shape, "gamma_mean": mean, "gamma_variance": variance}
    row["below_5_degrees"] = float(np.mean(angles < np.deg2rad(5)))
    return [row | {"histogram": np.histogram(angles, _BINS)[0] / len(angles)}]


def table(rows: list[Row]) -> str:
    """Parameters of the Gamma distributions, and the share of edges where the surface is almost plane."""
    cells = [
        [row["scene"], row["method"], *_numbers(row)] if not row.get("why_not")
        else [row["scene"], f"{row['method']}: {row['why_not']}", "–", "–", "–", "–"]
        for row in rows
    ]  # fmt: skip
    return markdown(["scene", "method", "below 5°, %", "Gamma shape", "mean, rad", "variance"], cells)


def _numbers(row: Row) -> list[str]:
    shape = "–" if row["gamma_shape"] is None else f"{row['gamma_shape']:.2f}"
    below = f"{100 * row['below_5_degrees']:.1f}"
    return [below, shape, f"{row['gamma_mean']:.3f}", f"{row['gamma_variance']:.3f}"]


def plot(rows: list[Row], path: Path) -> None:
    """Outlines of the histograms."""
    for ax, own in panels(path, [row for row in rows if "histogram" in row], "scene"):
        for row in own:
            ax.stairs(100 * np.asarray(row["histogram"]), np.rad2deg(_BINS), label=row["method"])
        ax.set(xlim=(0, 90), xlabel="angle between triangles, °", ylabel="share of edges, %")
        ax.set_yscale("log")


EXPERIMENT = Experiment(
    "Angles between adjacent triangles", ("hugin", "oculii", "wall"), for_each_peer(_rows), table, plot
)
