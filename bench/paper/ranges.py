# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Precision and completion of all methods by the distance from the sensor: noise grows with it."""

from __future__ import annotations

import itertools
from pathlib import Path

from scipy.spatial import cKDTree

from .calibration import sampled
from .experiment import Experiment, Options, Row, for_each_peer, groups, panels
from .report import markdown
from .scenes import Scene

NEAR_M = 0.2
"""A point this near to the other surface counts, as for the F-score with nothing discarded."""

_EDGES_M = (2.5, 10.0, 20.0, 30.0, 60.0)


def _rows(scene: Scene, name: str, options: Options) -> list[Row]:
    row: Row = {"scene": scene.name, "method": name}
    if scene.ground_truth is None:
        return [row | {"why_not": "the scene has no ground truth"}]
    result = options.reconstruct(name, scene)
    if result.mesh is None:
        return [row | {"why_not": result.why_not}]
    x, _ = sampled(result.mesh, options.samples, scene.box)
    truth = scene.ground_truth
    if len(x) == 0:
        return [row | {"why_not": "the mesh has no surface in the box"}]
    sensors = cKDTree(scene.poses[:, :3, 3])
    found = cKDTree(truth).query(x, distance_upper_bound=NEAR_M)[0] <= NEAR_M
    covered = cKDTree(x).query(truth, distance_upper_bound=NEAR_M)[0] <= NEAR_M
    range_of_x_m, range_of_truth_m = sensors.query(x)[0], sensors.query(truth)[0]
    rows = []
    for low_m, high_m in itertools.pairwise(_EDGES_M):
        meshed = found[(range_of_x_m >= low_m) & (range_of_x_m < high_m)]
        true = covered[(range_of_truth_m >= low_m) & (range_of_truth_m < high_m)]
        rows.append(
            row
            | {
                "from_m": low_m,
                "to_m": high_m,
                "precision": float(meshed.mean()) if len(meshed) else None,
                "completion": float(true.mean()) if len(true) else None,
                "share_of_area": len(meshed) / len(x),
            }
        )
    return rows


def table(rows: list[Row]) -> str:
    """For each scene a line for each method: precision / completion in each band, in %."""
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        bands = sorted({(row["from_m"], row["to_m"]) for row in own if "from_m" in row})
        lines = []
        for (method,), same in groups(own, "method").items():
            by_band = {(row["from_m"], row["to_m"]): row for row in same if "from_m" in row}
            cells = [_text(by_band.get(band)) for band in bands]
            lines.append([method, *(cells or [same[0]["why_not"]])])
        header = ["precision / completion, %", *(f"{low:g} to {high:g} m" for low, high in bands)]
        parts += [f"### {scene}", markdown(header, lines)]
    return "\n\n".join(parts)


def _text(row: Row | None) -> str:
    if row is None:
        return "–"
    shares = (row["precision"], row["completion"])
    return " / ".join("–" if share is None else f"{100 * share:.0f}" for share in shares)


def plot(rows: list[Row], path: Path) -> None:
    """For each scene, completion over precision in each band."""
    for ax, own in panels(
        path, [row for row in rows if row.get("precision") and row.get("completion")], "scene"
    ):
        for (method,), same in groups(own, "method").items():
            x, y = ([100 * row[key] for row in same] for key in ("precision", "completion"))
            ax.plot(x, y, "o-", ms=4, label=method)
        ax.set(xlabel="precision, %", ylabel="completion, %", xlim=(0, 100), ylim=(0, 100))


EXPERIMENT = Experiment(
    "Precision and completion by range",
    ("hugin", "oculii", "wall"),
    for_each_peer(_rows),
    table,
    plot,
    bases=("default",),
)
