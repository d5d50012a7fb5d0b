# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What errors of poses cost, and what `refine_poses` and `odometry` make of them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from radarsdf.evaluation import intensity_metrics, surface_metrics, trajectory_metrics
from radarsdf.poses.rigid import aligned
from radarsdf.simulate import SCENES, measured_motion

from .broken_poses import BREAKAGES, Poses
from .experiment import Experiment, Options, Row, Task, fit, groups, mean_and_deviation, panels, world_returns
from .report import markdown
from .scenes import Scene, load_scene

_SOURCES = ("returns and Doppler", "returns, Doppler, gyroscope", "returns alone")
_COLUMNS = (
    ("f_given", "F given, %"),
    ("f_found", "F found, %"),
    ("f_true", "F true, %"),
    ("mae_found", "intensity, dB"),
    ("mae_true", "intensity true, dB"),
    ("given_cm", "given, cm"),
    ("found_cm", "found, cm"),
    ("given_deg", "given, °"),
    ("found_deg", "found, °"),
    ("relative_percent", "relative, %"),
    ("deg_per_m", "°/m"),
    ("nees", "NEES / 3"),
    ("taken", "taken"),
    ("pieces", "pieces"),
    ("seconds", "s"),
)


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each repetition, each with another seed of the scene: of a recorded scene, of the breakages."""
    return [Task(f"{scene.name}: {k}", partial(_rows, scene, options, k)) for k in range(options.repetitions)]


def _rows(scene: Scene, options: Options, repetition: int) -> Iterable[Row]:
    seed = repetition
    if scene.simulation is not None:
        seed += scene.simulation.seed
        if repetition:
            scene = load_scene(scene.name, frames=len(scene), seed=seed)
    true = scene.poses
    base = {"scene": scene.name, "seed": seed} | _map_errors(scene, true, "true", options)
    names = ("none", "walk of 0.02 m, 0.1°") if options.quick else tuple(BREAKAGES)
    rows = []
    for name in names:
        given = BREAKAGES[name](true, seed)
        row = base | _trajectory_errors(given, true, "given")
        row |= _map_errors(scene, aligned(given, true), "given", options)
        for source, measured in _measured(scene):
            found = radarsdf.refine_poses(scene.points, given, **measured)
            row |= {
                "poses": name + source,
                "taken": float(found.improved),
                "seconds": found.report["seconds"],
            }
            row |= _trajectory_errors(found.poses, true, "found", found.covariance)
            rows.append(row | _map_errors(scene, aligned(found.poses, true), "found", options))
    return rows + [base | row for row in _odometry_rows(scene, seed, options)]


def _measured(scene: Scene) -> list[tuple[str, dict[str, Any]]]:
    """What refinement is given besides returns, and how the rows are then named: nothing, and what was recorded."""
    if scene.doppler_mps is None or scene.times_s is None:
        return [("", {})]
    return [("", {}), (", Doppler", {"doppler_mps": scene.doppler_mps, "times_s": scene.times_s})]


def _odometry_rows(scene: Scene, seed: int, options: Options) -> Iterable[Row]:
    true = scene.poses
    if scene.simulation is not None:
        motion = measured_motion(scene.simulation, seed=seed)
        times_s, doppler, rates = motion.times_s, motion.doppler_mps, motion.angular_velocity
    elif scene.doppler_mps is not None and scene.times_s is not None and seed == 0:
        times_s, doppler, rates = scene.times_s, scene.doppler_mps, None
    else:
        return
    for name in _SOURCES:
        gyroscope = rates if "gyroscope" in name else None
        if "gyroscope" in name and gyroscope is None:
            continue
        row: Row = {"poses": name}
        begin = time.perf_counter()
        try:
            found = radarsdf.odometry(
                scene.points,
                doppler_mps=None if name == "returns alone" else doppler,
                times_s=times_s,
                angular_velocity=gyroscope,
            )
        except ValueError as error:
            yield row | {"why_not": str(error)}
            continue
        row |= {"seconds": time.perf_counter() - begin, "pieces": float(found.report["pieces"])}
        part = found.longest_piece()
        row |= _trajectory_errors(found.poses[part], true[part], "found", found.covariance[part])
        if found.report["pieces"] == 1:
            row |= _map_errors(scene, aligned(found.poses, true), "found", options)
        yield row


def _trajectory_errors(poses: Poses, true: Poses, name: str, covariance: np.ndarray | None = None) -> Row:
    # Straight drives leave the rotation about them open, if positions alone are brought together.
    metrics = trajectory_metrics(poses, true)
    turns = trajectory_metrics(poses, true, align="poses")
    row: Row = {
        f"{name}_cm": 100 * metrics["absolute_m"],
        f"{name}_deg": float(np.degrees(turns["absolute_rad"])),
    }
    if covariance is not None:
        ratio, rad = metrics["relative_ratio"], metrics["relative_rad_per_m"]
        row |= {
            "relative_percent": None if ratio is None else 100 * ratio,
            "deg_per_m": None if rad is None else float(np.degrees(rad)),
            "nees": _nees(poses, true, covariance),
        }
    return row


def _nees(poses: Poses, true: Poses, covariance: np.ndarray) -> float | None:
    """Mean squared error of positions in its deviations, over 3, relative to the scan in the middle: 1 is honest."""
    middle = len(poses) // 2
    others = np.arange(len(poses)) != middle
    if not np.linalg.det(covariance[others, :3, :3]).all():
        return None
    whole = true[middle] @ np.linalg.inv(poses[middle])
    off = np.einsum("ij,fjk->fik", whole, poses)[:, :3, 3] - true[:, :3, 3]
    off = np.einsum("ji,fj->fi", whole[:3, :3], off)
    squares = np.einsum(
        "fi,fi->f", off[others], np.linalg.solve(covariance[others, :3, :3], off[others, :, None])[..., 0]
    )
    return float(squares.mean() / 3)


def _map_errors(scene: Scene, poses: Poses, name: str, options: Options) -> Row:
    """F-score with nothing discarded, and the error of held-out intensities, of quick maps with these poses."""
    if scene.ground_truth is None:
        return {}
    config = scene.config("quick")
    whole = radarsdf.fit(scene.points, poses, config=config, progress=False)
    metrics = surface_metrics(
        whole.mesh(), scene.ground_truth, box=scene.box, samples=min(options.samples, 1_000_000)
    )
    row: Row = {f"f_{name}": 100 * metrics["f_score_all"]}
    if scene.intensities is None or name == "given":
        return row
    train, test = dataclasses.replace(scene, poses=poses).split()
    points, sensors, measured = world_returns(test)
    predicted = fit(train, config).intensity(points, sensors, extrapolate=True)
    return row | {f"mae_{name}": intensity_metrics(predicted, measured)["mae"]}


def table(rows: list[Row]) -> str:
    """Means and deviations over the seeds, for each scene and each kind of poses."""
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        cells = []
        for (poses,), same in groups(own, "poses").items():
            refused = sum("why_not" in row for row in same)
            name = f"{poses} (refused: {refused} of {len(same)})" if refused else str(poses)
            cells.append([name, *(mean_and_deviation(same, key) for key, _ in _COLUMNS)])
        seeds = len({row["seed"] for row in own})
        parts += [
            f"### {scene}, {seeds} seeds",
            markdown(["poses", *(label for _, label in _COLUMNS)], cells),
        ]
    return "\n\n".join(parts)


def plot(rows: list[Row], path: Path) -> None:
    """F-scores less those of the true poses, as given and as found."""
    for ax, own in panels(path, [row for row in rows if row.get("f_found") is not None], "scene"):
        kinds = groups(own, "poses")
        places = np.arange(len(kinds))
        for key, mark in (("f_given", "x"), ("f_found", "o")):
            values: list[Any] = [
                [row[key] - row["f_true"] for row in same if row.get(key) is not None]
                for same in kinds.values()
            ]
            for place, of_kind in zip(places, values, strict=True):
                ax.plot(
                    of_kind,
                    [place] * len(of_kind),
                    mark,
                    ms=4,
                    color="C1" if mark == "x" else "C0",
                    alpha=0.7,
                )
        ax.set_yticks(places, [str(name) for (name,) in kinds])
        ax.invert_yaxis()
        ax.set(xlabel="F-score less that of true poses, points (x given, o found)")
        ax.grid(alpha=0.3)


EXPERIMENT = Experiment(
    "Poses that are refined, and poses from the radar alone",
    tuple(SCENES),
    tasks,
    table,
    plot,
    repetitions=10,
)
