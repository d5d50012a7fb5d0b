# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Completion with only every n-th scan (figure)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from .experiment import Experiment, Options, Row, Task, groups, panels
from .report import markdown
from .scenes import Scene


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each n and peer."""
    steps = (1, 2) if options.quick else range(1, 11)
    return [
        Task(f"{scene.name}: {name}, n = {n}", partial(_rows, scene, name, n, options))
        for n in steps
        for name in options.peers
    ]


def _rows(scene: Scene, name: str, n: int, options: Options) -> list[Row]:
    row = {"scene": scene.name, "method": name, "n": n}
    return [row | options.measure(name, scene.every_nth(n))]


def table(rows: list[Row]) -> str:
    """Completion ratio and its decrease from n = 1 to the largest n; and outliers, which a high completion can cost."""
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        steps = sorted({row["n"] for row in own})
        for key, heading in (("completion_ratio", "completion ratio, %"), ("outlier_ratio", "outliers, %")):
            cells = []
            for (method,), same in groups(own, "method").items():
                values = {row["n"]: row.get(key) for row in same}
                numbers = ["–" if value is None else f"{100 * value:.1f}" for value in values.values()]
                first, last = values[steps[0]], values[steps[-1]]
                fall = f"{100 * (1 - last / first):.1f}" if first and last is not None else "–"
                why_not = next((row["why_not"] for row in same if row.get("why_not")), "")
                cells.append([f"{method}: {why_not}" if why_not else method, *numbers, fall])
            header = [heading, *(f"n = {n}" for n in steps), f"1 → {steps[-1]}, relative decrease, %"]
            parts += [f"### {scene}: {heading}", markdown(header, cells)]
    return "\n\n".join(parts)


def plot(rows: list[Row], path: Path) -> None:
    """Completion ratio over n."""
    for ax, own in panels(path, [row for row in rows if "completion_ratio" in row], "scene"):
        for (method,), same in groups(own, "method").items():
            ax.plot(
                [r["n"] for r in same],
                [100 * r["completion_ratio"] for r in same],
                "o-",
                ms=3,
                label=method,
            )
        ax.set(xlabel="every n-th scan", ylabel="completion ratio, %")
        ax.grid(alpha=0.3)


EXPERIMENT = Experiment("Completion with every n-th scan", ("hugin", "oculii"), tasks, table, plot)
