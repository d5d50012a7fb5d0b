# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Errors of intensities on held-out scans, and of the nearest-neighbour baseline (Table II)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from radarsdf.evaluation import KNNIntensity, intensity_metrics

from .experiment import (
    Experiment,
    Options,
    Row,
    Task,
    fit,
    groups,
    mean_and_deviation,
    rays_of,
    world_returns,
)
from .report import figure, markdown
from .scenes import Scene


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for the baseline, and one for each configuration and seed."""
    if scene.intensities is None:
        why_not = "the scene has no intensities"
        return [Task(scene.name, lambda: [{"scene": scene.name, "method": "all", "why_not": why_not}])]
    found = [Task(f"{scene.name}: kNN", partial(_baseline, scene))]
    for base in options.bases:
        for seed in range(options.repetitions):
            label = f"{scene.name}: {base}, seed {seed}"
            found.append(Task(label, partial(_repetition, scene, options, base, seed)))
    return found


def _baseline(scene: Scene) -> list[Row]:
    train, test = scene.split()
    x, sensors, measured = world_returns(test)
    known = rays_of(train)
    assert known.intensities is not None
    knn = KNNIntensity.chosen(*known.in_world(), known.intensities, known.scans)
    metrics = intensity_metrics(knn.predict(x, sensors), measured)
    row: Row = {"scene": scene.name, "method": "kNN", "k": knn.k, "candidates": knn.candidates, **metrics}
    row["lowest"], row["highest"] = (float(v) for v in (measured.min(), measured.max()))
    if test.simulation is not None:
        row["noise_floor"] = test.simulation.intensity_noise_floor()
    return [row]


def _repetition(scene: Scene, options: Options, base: str, seed: int) -> list[Row]:
    train, test = scene.split()
    radar_map = fit(train, options.config(base, scene, seed=seed))
    x, sensors, measured = world_returns(test)
    metrics = intensity_metrics(radar_map.intensity(x, sensors, extrapolate=True), measured)
    return [{"scene": scene.name, "method": _NAMES[base], "seed": seed, **metrics}]


_NAMES = {"default": "radarsdf", "paper": "3QFPI"}


def table(rows: list[Row]) -> str:
    """Mean and deviation over the repetitions. The noise floor is `Simulation.intensity_noise_floor`."""
    cells = []
    for (scene,), own in groups(rows, "scene").items():
        if why_not := own[0].get("why_not"):
            cells.append([scene, why_not, "–", "–", "–", "–"])
            continue
        for (method,), same in groups(own, "method").items():
            floor = own[0].get("noise_floor")
            cells.append([
                scene, method, mean_and_deviation(same, "mae"), mean_and_deviation(same, "medae"),
                "–" if floor is None else f"{floor:.2f}", f"{own[0]['lowest']:.0f} – {own[0]['highest']:.0f}",
            ])  # fmt: skip
    return markdown(
        ["scene", "method", "MAE", "MedAE", "noise floor of the MAE", "range of the intensities"], cells
    )


def plot(rows: list[Row], path: Path) -> None:
    """MAE of each method, with a group of bars for each scene and the noise floor as a line."""
    scenes = groups([row for row in rows if "mae" in row], "scene")
    methods = list(groups([row for own in scenes.values() for row in own], "method"))
    with figure(path, size=(2 + 1.5 * max(1, len(scenes)), 3.6)) as axes:
        ax = axes[0][0]
        for i, ((_,), own) in enumerate(scenes.items()):
            for j, (method,) in enumerate(methods):
                values = [row["mae"] for row in own if row["method"] == method]
                if values:
                    ax.bar(i + 0.25 * j, np.mean(values), 0.22, yerr=np.std(values), color=f"C{j}",
                           label=method if i == 0 else None)  # fmt: skip
            if (floor := own[0].get("noise_floor")) is not None:
                ax.hlines(
                    floor, i - 0.15, i + 0.65, "black", "dashed", label="noise floor" if i == 0 else None
                )
        ax.set_xticks([i + 0.25 for i in range(len(scenes))], [scene for (scene,) in scenes])
        ax.set_ylabel("held-out MAE, sensor units")


EXPERIMENT = Experiment(
    "Held-out intensity (Table II)", ("hugin", "oculii", "wall"), tasks, table, plot, repetitions=10
)
