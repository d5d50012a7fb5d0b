# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Surface errors, time and memory of all methods (Table I)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .experiment import Experiment, Options, Row, for_each_peer, groups, panels
from .report import Column, metric_table
from .scenes import Scene

COLUMNS: tuple[Column, ...] = (
    ("accuracy_error_m", "acc. error, cm", 100, 2, False),
    ("accuracy_ratio", "acc. ratio, %", 100, 2, True),
    ("outlier_ratio", "outliers, %", 100, 2, False),
    ("completion_error_m", "compl. error, cm", 100, 2, False),
    ("completion_ratio", "compl. ratio, %", 100, 2, True),
    ("f_score", "F-score, %", 100, 2, True),
    ("f_score_all", "F-score, nothing discarded, %", 100, 2, True),
    ("gamma_shape", "Gamma shape", 1, 2, None),
    ("gamma_mean", "mean, rad", 1, 3, False),
    ("gamma_variance", "variance", 1, 3, False),
    ("seconds", "time, s", 1, 1, False),
    ("peak_bytes", "peak memory, MB", 1e-6, 0, False),
)


def _rows(scene: Scene, name: str, options: Options) -> list[Row]:
    row = {"scene": scene.name, "method": name, "returns": sum(map(len, scene.points))}
    return [row | options.measure(name, scene)]


def table(rows: list[Row]) -> str:
    """A table for each scene, with the best value of each column in bold."""
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        text = metric_table(own, COLUMNS)
        missing = [f"- {row['method']} is missing: {row['why_not']}" for row in own if row.get("why_not")]
        parts.append("\n".join([f"### {scene}, {own[0]['returns']:,} returns", "", text, *missing]))
    return "\n\n".join(parts)


def plot(rows: list[Row], path: Path) -> None:
    """F-score with nothing discarded over time."""
    for ax, own in panels(path, [row for row in rows if "f_score_all" in row], "scene"):
        _scatter(ax, own)
        ax.set(xscale="log", xlabel="time, s", ylabel="F-score, nothing discarded, %")


def _scatter(ax: Any, rows: list[Row]) -> None:
    for row in rows:
        ours = row["method"].startswith("radarsdf")
        x, y = row["seconds"], 100 * row["f_score_all"]
        ax.plot(x, y, "*" if ours else "o", color="tab:red" if ours else "tab:blue")
        ax.annotate(row["method"], (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7)
    ax.grid(alpha=0.3)


EXPERIMENT = Experiment(
    "Surface quality (Table I)", ("hugin", "oculii", "wall"), for_each_peer(_rows), table, plot
)
