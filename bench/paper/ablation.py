# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Error of the intensity without one of the inputs of its network (Table III)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from radarsdf.evaluation import intensity_metrics

from bench.settings import Changes, merged

from .experiment import Experiment, Options, Row, Task, fit, groups, mean_and_deviation, panels, world_returns
from .report import markdown
from .scenes import Scene

# All inputs of the paper, also those that the default configuration does not use.
_FULL: Changes = {
    "networks": {"normals": True, "geometry_feature_dim": 15, "sdf_input": True, "view_direction": True}
}
_VARIANTS: dict[str, Changes] = {
    "full": {},
    # Without the SDF loss, features and intensity network learn from the intensities alone: our reading of the paper's
    # "training only the intensity network".
    "w/o SDF": {
        "networks": {"sdf_input": False, "normals": False, "geometry_feature_dim": 0},
        "training": {"sdf_loss_weight": 0.0},
    },
    "w/o SDF normals": {"networks": {"normals": False}},
    "w/o geometry feature": {"networks": {"geometry_feature_dim": 0}},
    "w/o viewing direction": {"networks": {"view_direction": False}},
}


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each configuration, variant and repetition."""
    if scene.intensities is None:
        why_not = "the scene has no intensities"
        return [
            Task(
                scene.name, lambda: [{"scene": scene.name, "base": "", "variant": "all", "why_not": why_not}]
            )
        ]
    return [
        Task(
            f"{scene.name}: {base}, {variant}, seed {seed}",
            partial(_repetition, scene, options, base, variant, seed),
        )
        for base in options.bases
        for variant in _VARIANTS
        for seed in range(options.repetitions)
    ]


def _repetition(scene: Scene, options: Options, base: str, variant: str, seed: int) -> list[Row]:
    train, test = scene.split()
    config = options.config(base, scene, seed=seed, **merged(_FULL, _VARIANTS[variant]))
    x, sensors, measured = world_returns(test)
    metrics = intensity_metrics(fit(train, config).intensity(x, sensors, extrapolate=True), measured)
    return [{"scene": scene.name, "base": base, "variant": variant, "seed": seed, **metrics}]


def table(rows: list[Row]) -> str:
    """One row for each scene and configuration, one column for each variant."""
    cells = []
    for (scene, base), own in groups(rows, "scene", "base").items():
        if why_not := own[0].get("why_not"):
            cells.append([scene, why_not, *["–"] * len(_VARIANTS)])
            continue
        by_variant = groups(own, "variant")
        pairs = [
            f"{mean_and_deviation(by_variant.get((v,), []), 'mae')} / "
            f"{mean_and_deviation(by_variant.get((v,), []), 'medae')}"
            for v in _VARIANTS
        ]
        cells.append([scene, base, *pairs])
    return markdown(["scene", "configuration", *(f"{name}, MAE / MedAE" for name in _VARIANTS)], cells)


def plot(rows: list[Row], path: Path) -> None:
    """MAE of each variant."""
    for ax, own in panels(path, [row for row in rows if "mae" in row], "scene", "base"):
        for i, ((variant,), same) in enumerate(groups(own, "variant").items()):
            values = [row["mae"] for row in same]
            ax.barh(i, np.mean(values), xerr=np.std(values), color="tab:gray" if variant == "full" else "C0")
        ax.set_yticks(range(len(_VARIANTS)), list(_VARIANTS))
        ax.invert_yaxis()
        ax.set(xlabel="held-out MAE, sensor units")


EXPERIMENT = Experiment(
    "Inputs of the intensity network (Table III)",
    ("wall",),
    tasks,
    table,
    plot,
    repetitions=10,
    bases=("paper",),
)
