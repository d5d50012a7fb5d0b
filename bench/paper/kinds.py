# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scenes of all kinds, ours and the peers: what is kept of the surface, and whether the confidence in it is right."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from radarsdf.evaluation import confidence_metrics
from radarsdf.simulate import KINDS, SCENES

from bench.peers.interface import PEERS

from .calibration import repeated, sampled
from .experiment import Experiment, Options, Row, Task, fit, groups, panels
from .report import best_in_bold, markdown
from .scenes import Scene
from .truth import truth_of

_OURS = ("radarsdf", "radarsdf, quick")
_MOST_SAMPLES = 40_000
_MEAN = "mean of kinds"


def tasks(scene: Scene, options: Options) -> list[Task]:
    """For each repetition, which has another seed of the scene, one task for each method, and one for our confidence."""
    found = []
    for k in range(options.repetitions):
        for name in options.peers:
            found.append(Task(f"{scene.name}: {name}, {k}", partial(_reconstructed, scene, options, name, k)))
        for name in _OURS:
            found.append(
                Task(f"{scene.name}: confidence, {name}, {k}", partial(_judged, scene, options, name, k))
            )
    return found


def _reconstructed(scene: Scene, options: Options, name: str, repetition: int) -> list[Row]:
    row: Row = {"scene": scene.name, "method": name, "repetition": repetition}
    row |= options.measure(name, repeated(scene, repetition))
    return [row]


def _judged(scene: Scene, options: Options, name: str, repetition: int) -> list[Row]:
    """The confidence at points of the whole surface, whatever a mesh keeps of it, beside the truth."""
    scene = repeated(scene, repetition)
    row: Row = {"scene": scene.name, "method": f"{name}, confidence", "repetition": repetition}
    if scene.simulation is None and scene.ground_truth is None:
        return [row | {"why_not": "the scene has no ground truth"}]
    config = scene.config("quick") if name.endswith("quick") else options.config("default", scene)
    radar_map = fit(scene.without_intensities(), config)
    leaf_m = radar_map.config.leaf_size_m
    mesh = radar_map.mesh(leaf_m, **WHOLE, progress=False)
    x, normals = sampled(mesh, min(options.samples, _MOST_SAMPLES), scene.box)
    if len(x) == 0:
        return [row | {"why_not": "the map has no surface"}]
    is_true = truth_of(scene, x, normals).distance_m <= leaf_m
    return [row | confidence_metrics(radar_map.confidence(x), is_true)]


WHOLE: dict[str, Any] = {
    "min_confidence": 0.0,
    "max_uncertainty": np.inf,
    "min_component_triangles": 0,
}
"""Arguments of a mesh that keeps all surface."""


def _mean(rows: list[Row], key: str) -> float | None:
    values = [row[key] for row in rows if row.get(key) is not None]
    return float(np.mean(values)) if values else None


def table(rows: list[Row]) -> str:
    """F-scores by kind and method, then the calibration by kind. Means over the repetitions."""
    scores = [row for row in rows if "confidence" not in row["method"]]
    scenes, methods = groups(scores, "scene"), [method for (method,) in groups(scores, "method")]
    lines: list[list[float | None]] = [
        [_mean([row for row in own if row["method"] == method], "f_score_all") for method in methods]
        for own in scenes.values()
    ]
    names = [f"{scene}" for (scene,) in scenes]
    complete = [line for line in lines if None not in line]
    if len(complete) > 1:
        names.append(_MEAN)
        lines.append([_mean([{"f": line[i]} for line in complete], "f") for i in range(len(methods))])
    parts = ["F-score with nothing discarded, %."]
    cells = [
        best_in_bold(["–" if v is None else f"{100 * v:.1f}" for v in line], line, highest=True)
        for line in lines
    ]
    parts.append(
        markdown(["kind", *methods], [[name, *line] for name, line in zip(names, cells, strict=True)])
    )
    judged = groups([row for row in rows if "worst_gap" in row], "scene")
    if judged:
        parts.append(
            "Confidence of the whole surface: share of true surface, worst tenth, mean gap, and AUC."
        )
        body = [
            [scene, *(_calibration([r for r in own if r["method"] == f"{n}, confidence"]) for n in _OURS)]
            for (scene,), own in judged.items()
        ]
        parts.append(markdown(["kind", *_OURS], body))
    missing = {f"- {row['scene']}, {row['method']}: {row['why_not']}" for row in rows if row.get("why_not")}
    return "\n\n".join([*parts, *sorted(missing)])


def _calibration(rows: list[Row]) -> str:
    values = [_mean(rows, key) for key in ("true_share", "worst_gap", "mean_gap", "auc")]
    return ", ".join("–" if value is None else f"{value:.2f}" for value in values)


def plot(rows: list[Row], path: Path) -> None:
    """For each kind, the share of true surface over the confidence."""
    for ax, own in panels(path, [row for row in rows if "worst_gap" in row], "scene", size=(3, 3)):
        ax.fill_between([0, 1], [-0.1, 0.9], [0.1, 1.1], color="lightgray")
        for row in own:
            known = [
                (p, share)
                for p, share in zip(row["bin_confidence"], row["bin_true_share"], strict=True)
                if p is not None
            ]
            ax.plot(*zip(*known, strict=True), "o-", ms=3, label=row["method"])
        ax.set(xlabel="confidence", ylabel="share of true surface", xlim=(0, 1), ylim=(0, 1))


EXPERIMENT = Experiment(
    "Kinds of scenes",
    (*SCENES, *KINDS),
    tasks,
    table,
    plot,
    bases=("default",),
    peers=tuple(name for name in PEERS if name in {*_OURS, "VDBFusion"}),
)
