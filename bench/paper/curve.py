# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Run time against error, for methods, training budgets and settings.

Each method gets the scans that are not held out, and runs in its own process. Its time is from returns in memory to
triangles in memory. The intensities of the held-out scans are predicted afterwards.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from radarsdf.config.fit_config import flat_settings

from bench.peers.interface import PEERS, Peer
from bench.settings import Changes

from . import surface
from .experiment import Experiment, Options, Row, Task, groups
from .report import Column, figure, metric_table
from .scenes import Scene

# Training budgets, relative to the default.
_FACTORS = {"1/16": 1 / 16, "1/8": 1 / 8, "1/4": 1 / 4, "1/2": 1 / 2, "1": 1.0, "2": 2.0, "4": 4.0}
_QUICK_FACTORS = ("1/16",)
_OURS = ("radarsdf", "radarsdf, intensities")
# Settings that differ from the default, measured one by one, with intensities.
_LEVERS: tuple[Changes, ...] = (
    {"returns": {"drop_ghosts": False}},
    {"mesh": {"min_confidence": 0.0}},
    {"encoding": {"bridge_cells": 0}},
    {"training": {"row_updates": False}},
    {"training": {"optimiser": "adam", "intensity_learning_rate": 6e-3}},
    {"training": {"joint": False}},
    {"encoding": {"fourier_count": 16}},
    {"networks": {"normals": True}},
    {"networks": {"geometry_feature_dim": 15}},
    {"encoding": {"kind": "octree"}},
    {"networks": {"dropout": False}},
    {"training": {"cross_range_noise_rad": 0.0}},
    {"networks": {"intensity_hidden": (64, 64)}},
    {"training": {"batch_size": 8192}},
)
_SURFACE = {column[0]: column for column in surface.COLUMNS}
_COLUMNS: tuple[Column, ...] = (
    ("seconds", "time, s", 1, 2, None),
    ("fit_seconds", "fit, s", 1, 2, None),
    ("mesh_seconds", "mesh, s", 1, 2, None),
    ("peak_bytes", "peak, MB", 1e-6, 0, None),
    *(_SURFACE[key] for key in ("f_score", "f_score_all", "accuracy_error_m", "outlier_ratio")),
    *(_SURFACE[key] for key in ("completion_error_m", "completion_ratio")),
    ("mae", "held-out MAE", 1, 3, False),
)
_LABELS = {"lever": "other settings", "peer": "peers"}
_PANELS = (
    ("f_score_all", "F-score, nothing discarded, %", 100),
    ("f_score", "F-score, %", 100),
    ("mae", "held-out MAE, sensor units", 1),
)


def budget(factor: float) -> Changes:
    """Settings of a fit that trains `factor` times as long as the default."""
    return {"effort": factor}


def _methods(options: Options) -> list[tuple[str, str, Peer]]:
    """Kind (a line of the plot, "lever" or "peer"), name and peer of each method."""
    found = []
    for line in _OURS:
        for factor in _QUICK_FACTORS if options.quick else _FACTORS:
            peer = PEERS[line].with_changes(**budget(_FACTORS[factor]))
            found.append((line, f"{line}, × {factor}", peer))
    for changes in (*(_LEVERS[:1] if options.quick else _LEVERS), *options.levers):
        name = ", ".join(f"{key}={value}" for key, value in flat_settings(changes).items())
        found.append(("lever", name, PEERS[_OURS[1]].with_changes(**changes)))
    # The fits of this package are in the lines already, with a budget of 1.
    found += [("peer", name, PEERS[name]) for name in options.peers if name not in _OURS]
    return found


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each repetition and method. The methods take turns, so a slow phase of the machine affects all."""
    return [
        Task(f"{scene.name}: {name}, seed {seed}", partial(_row, scene, options, kind, name, peer, seed))
        for seed in range(options.repetitions)
        for kind, name, peer in _methods(options)
    ]


def _row(scene: Scene, options: Options, kind: str, name: str, peer: Peer, seed: int) -> list[Row]:
    train, test = scene.split()
    row: Row = {"scene": scene.name, "kind": kind, "method": name, "repetition": seed}
    row["returns"] = sum(map(len, train.points))
    row["settings"] = peer.options
    held_out = test if scene.intensities is not None else None
    row |= options.measure(peer.with_changes(seed=seed), train, held_out)
    if "report" in row:
        row["mesh_seconds"] = row["report"]["mesh_s"]
        row["fit_seconds"] = row["seconds"] - row["mesh_seconds"]
    if test.simulation is not None and held_out is not None:
        row["noise_floor"] = test.simulation.intensity_noise_floor()
    return [row]


def medians(rows: list[Row]) -> list[Row]:
    """One row for each method: the median of each number over the repetitions."""
    found = []
    for same in groups(rows, "method").values():
        row = dict(same[0])
        for key in {key for other in same for key in other}:
            values = [float(v) for other in same if isinstance(v := other.get(key), (int, float))]
            if values:
                row[key] = float(np.median(values))
        row["why_not"] = next((other["why_not"] for other in same if other.get("why_not")), "")
        found.append(row)
    return found


def table(rows: list[Row]) -> str:
    """A table of medians for each scene, with the best value of each column in bold."""
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        methods = medians(own)
        floor = own[0].get("noise_floor")
        heading = (
            f"### {scene}, {own[0]['returns']:,} returns, medians of {1 + max(r['repetition'] for r in own)}"
        )
        if floor is not None:
            heading += f", noise floor of the MAE {floor:.2f}"
        missing = [f"- {row['method']}: {row['why_not']}" for row in methods if row["why_not"]]
        parts.append("\n".join([heading, "", metric_table(methods, _COLUMNS), *missing]))
    return "\n\n".join(parts)


def plot(rows: list[Row], path: Path) -> None:
    """Each error over time, with budgets as lines, and settings and peers as points."""
    scenes = groups([row for row in rows if row.get("seconds") is not None], "scene")
    with figure(path, rows=len(_PANELS), columns=max(1, len(scenes)), size=(6, 4)) as axes:
        for column, ((scene,), own) in zip(axes.T, scenes.items(), strict=False):
            for ax, (key, label, factor) in zip(column, _PANELS, strict=True):
                _panel(ax, [row for row in medians(own) if row.get(key) is not None], key, factor)
                ax.set(title=scene, xscale="log", xlabel="time, s", ylabel=label)
                ax.grid(alpha=0.3)


def _panel(ax: Any, rows: list[Row], key: str, factor: float) -> None:
    for (kind,), same in groups(rows, "kind").items():
        x, y = [row["seconds"] for row in same], [factor * row[key] for row in same]
        if kind in _OURS:
            ax.plot(x, y, "o-", ms=4, label=kind)
            continue
        ax.plot(x, y, "x" if kind == "lever" else "s", ms=4, label=_LABELS[kind])
        for row, *at in zip(same, x, y, strict=True):
            ax.annotate(row["method"], at, xytext=(3, 3), textcoords="offset points", fontsize=5)


EXPERIMENT = Experiment(
    "Run time against error", ("hugin", "oculii", "wall"), tasks, table, plot, repetitions=3
)
