# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Whether a map knows its errors: `uncertainty` against distances to the truth, `confidence` against true surface."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from radarsdf.config.fit_config import flat_settings
from radarsdf.evaluation import confidence_metrics, uncertainty_metrics
from scipy.spatial import cKDTree

from bench.sensor.figures import deviation
from bench.settings import Changes

from .experiment import Experiment, Options, Row, Task, fit, groups, mean_and_deviation, rays_of
from .report import figure, markdown
from .scenes import Scene, load_scene
from .truth import truth_of

FloatArray = NDArray[np.float64]

TRUE_M = 0.5
"""A point of the mesh this near to the truth has an error. Farther ones are false."""

_MOST_SAMPLES = 40_000  # more change nothing: neighbours have the same error
_NEAR_M = 0.3  # returns this near tell the range of a point, and how many scans saw it
_RANGES_M = (0.0, 10.0, 20.0, 30.0, np.inf)
_SCANS = (0, 1, 2, 4, 8, 16, 32, np.inf)
_FEWEST = 50  # points for the figures of a band
_COVERAGES = {"coverage_50": 50, "coverage_68": 68, "coverage_90": 90, "coverage_95": 95}
_BANDS = {"by_range": "range, m", "by_scans": "scans"}

# Key in the rows, heading, and factor to the unit of the heading.
_COLUMNS: tuple[tuple[str, str, float], ...] = (
    *((key, f"{level} % interval, %", 100) for key, level in _COVERAGES.items()),
    ("ence", "ENCE", 1),
    ("nll", "NLL", 1),
    ("z_rms", "error / predicted", 1),
    ("worst_decile_factor", "worst decile, factor", 1),
    ("mean_error_m", "bias, cm", 100),
    ("rmse_m", "RMSE, cm", 100),
    ("core_m", "core, cm", 100),
    ("mean_uncertainty_m", "mean predicted, cm", 100),
    ("false_share", "false, %", 100),
    ("aside_share", "aside, %", 100),
    ("unobserved_share", "NaN, %", 100),
    ("confidence_worst_gap", "confidence, worst gap", 1),
    ("confidence_auc", "confidence, AUC", 1),
)


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each configuration, repetition, and `--set` with the defaults first."""
    return [
        Task(f"{scene.name}: {base}, {_name(changes)}, {k}", partial(_rows, scene, options, base, changes, k))
        for base in options.bases
        for changes in ({}, *options.levers)
        for k in range(options.repetitions)
    ]


def _name(changes: Changes) -> str:
    return ", ".join(f"{key}={value}" for key, value in flat_settings(changes).items()) or "defaults"


def _rows(scene: Scene, options: Options, base: str, changes: Changes, repetition: int) -> list[Row]:
    scene = repeated(scene, repetition)
    row: Row = {"scene": scene.name, "base": base, "variant": _name(changes), "repetition": repetition}
    if scene.simulation is None and scene.ground_truth is None:
        return [row | {"why_not": "the scene has no ground truth"}]
    settings = {name: value for name, value in changes.items() if name != "mesh"}
    radar_map = fit(scene, options.config(base, scene, seed=repetition, **settings))
    mesh = radar_map.mesh(progress=False, **changes.get("mesh", {}))
    x, normals = sampled(mesh, min(options.samples, _MOST_SAMPLES), scene.box)
    if len(x) == 0:
        return [row | {"why_not": "the mesh has no surface" + ("" if scene.box is None else " in the box")}]
    try:
        answers = radar_map.uncertainty(x), radar_map.confidence(x)
        return [row | compared(scene, x, normals, *answers, radar_map.config.leaf_size_m)]
    except ValueError as error:  # too few points of true surface
        return [row | {"why_not": str(error)}]


def repeated(scene: Scene, repetition: int) -> Scene:
    """The simulated scene of another seed, since a fit of another seed repeats most errors. A recorded one as it is."""
    if scene.simulation is None or repetition == 0:
        return scene
    other = load_scene(scene.name, frames=len(scene), seed=scene.simulation.seed + repetition)
    return dataclasses.replace(other, box=scene.box)


def sampled(mesh: trimesh.Trimesh, count: int, box: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Points drawn uniformly by area on a mesh, and the normals of its vertices interpolated there: (N, 3) each.

    Only those in the box remain. The normal of a single triangle is not used: its tilt would lengthen the errors.
    """
    if len(mesh.faces) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rng = np.random.default_rng(0)
    area = mesh.area_faces
    chosen = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count))
    weights = np.stack([1 - np.sqrt(u), np.sqrt(u) * (1 - v), np.sqrt(u) * v], axis=1)
    corners = mesh.faces[chosen]
    x = np.einsum("nk,nki->ni", weights, np.asarray(mesh.vertices, np.float64)[corners])
    normals = np.einsum("nk,nki->ni", weights, np.asarray(mesh.vertex_normals, np.float64)[corners])
    length = np.linalg.norm(normals, axis=1)
    kept = length > 0  # opposite normals of a fold have no mean
    if box is not None:
        kept &= ((x >= box[0]) & (x <= box[1])).all(axis=1)
    return x[kept], normals[kept] / length[kept, None]


def compared(
    scene: Scene,
    x: FloatArray,
    normals: FloatArray,
    uncertainty_m: FloatArray,
    confidence: FloatArray,
    leaf_size_m: float,
) -> Row:
    """What a map says of the points (N, 3) of its mesh, beside the truth.

    Shares of all points: `false_share` is farther than `TRUE_M` from the truth, `aside_share` is not, but no surface is
    met along the normal (beyond an edge, or the truth is not flat), `unobserved_share` is the share of NaN. The figures
    of the uncertainty are those of the other points. The standard error of the truth is added to the prediction in
    quadrature. `core_m` is the deviation of the errors up to `TRUE_M` without a uniform background: points that by
    chance are near another surface raise the root mean square, but not this. A map that calls them surface is wrong in
    its confidence, not in its uncertainty. A confidence is right if a surface is within `leaf_size_m` of so many points.

    Raises
    ------
    ValueError
        If there are too few of them, or an answer of the map is out of range.
    """
    truth = truth_of(scene, x, normals)
    is_true = truth.distance_m <= TRUE_M
    error_m = np.where(is_true, truth.error_m, np.nan)
    predicted_m = np.hypot(uncertainty_m, truth.sigma_m)
    range_m, scans = seen_from(scene, x)
    row: Row = {
        "false_share": float(np.mean(~is_true)),
        "aside_share": float(np.mean(is_true & np.isnan(error_m))),
        "unobserved_share": float(np.mean(np.isnan(uncertainty_m))),
        "truth_sigma_m": float(truth.sigma_m[0]),
        **uncertainty_metrics(error_m, predicted_m),
        "core_m": _core(error_m[np.isfinite(predicted_m)]),
        "by_range": _bands(range_m, _RANGES_M, error_m, predicted_m, is_true),
        "by_scans": _bands(scans, _SCANS, error_m, predicted_m, is_true),
    }
    metrics = confidence_metrics(confidence, truth.distance_m <= leaf_size_m)
    return row | {f"confidence_{key}": v for key, v in metrics.items()}


def seen_from(scene: Scene, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Median range, m, of the returns near each point (N,), and the number of scans that they are from (N,).

    Without returns near a point, the range is that of the nearest one.
    """
    rays = rays_of(scene)
    tree = cKDTree(rays.points)
    local = x - rays.origin
    range_m = rays.ranges_m[tree.query(local)[1]].astype(np.float64)
    scans = np.zeros(len(x))
    for i, near in enumerate(tree.query_ball_point(local, _NEAR_M)):
        if near:
            range_m[i] = np.median(rays.ranges_m[near])
            scans[i] = len(np.unique(rays.scans[near]))
    return range_m, scans


def _bands(
    values: FloatArray,
    edges: Sequence[float],
    error_m: FloatArray,
    predicted_m: FloatArray,
    is_true: NDArray[np.bool_],
) -> list[Row]:
    """Figures of the points whose value is from one edge up to the next."""
    found = []
    for low, high in itertools.pairwise(edges):
        own = (values >= low) & (values < high)
        band: Row = {"from": low, "to": high, "samples": int(own.sum())}
        band["true_share"] = float(is_true[own].mean()) if own.any() else None
        if np.count_nonzero(own & np.isfinite(error_m) & np.isfinite(predicted_m)) >= _FEWEST:
            metrics = uncertainty_metrics(error_m[own], predicted_m[own], bins=1)
            band |= {key: metrics[key] for key in ("rmse_m", "mean_error_m", "z_rms", "coverage_95")}
            band["core_m"] = _core(error_m[own & np.isfinite(predicted_m)])
            band["predicted_m"] = metrics["bin_predicted_m"][0]
        found.append(band)
    return found


def _core(error_m: FloatArray) -> float | None:
    """Deviation of the Gaussian in a uniform background of errors (N,), m; None of few. NaN does not count."""
    sigma_m = deviation(error_m[np.abs(error_m) <= TRUE_M], TRUE_M)
    return sigma_m if np.isfinite(sigma_m) else None


def table(rows: list[Row]) -> str:
    """For each scene the figures of all points, then those by decile, range, number of scans, and confidence.

    Means over the repetitions, with deviations where there are several.
    """
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        lines, details = [], []
        for (base, variant), same in groups(own, "base", "variant").items():
            done = [row for row in same if "ence" in row]
            name = f"{base}, {variant}"
            lines.append([name, *(_text(done, key, factor) for key, _, factor in _COLUMNS), _order(done)])
            details += [
                f"- {name}, repetition {row['repetition']}: {row['why_not']}"
                for row in same
                if row.get("why_not")
            ]
            if done:
                details += _details(f"{scene}, {name}", done)
        header = ["configuration", *(heading for _, heading, _ in _COLUMNS), "deciles in order"]
        parts += [f"### {scene}", markdown(header, lines), *details]
    return "\n\n".join(parts)


def _text(rows: list[Row], key: str, factor: float) -> str:
    return mean_and_deviation([{key: factor * row[key]} for row in rows if row.get(key) is not None], key)


def _order(rows: list[Row]) -> str:
    return f"{sum(row['deciles_in_order'] for row in rows)} of {len(rows)}"


def _details(name: str, rows: list[Row]) -> list[str]:
    deciles = [
        [label, *(f"{100 * value:.1f}" for value in np.mean([row[key] for row in rows], axis=0))]
        for label, key in (("predicted", "decile_predicted_m"), ("measured", "decile_rmse_m"))
    ]
    header = ["root mean square, cm", *(f"decile {i}" for i in range(1, 11))]
    parts = [f"#### {name}: by uncertainty", markdown(header, deciles)]
    for key, heading in _BANDS.items():
        lines = []
        for i, band in enumerate(rows[0][key]):
            own = [row[key][i] for row in rows]
            lines.append([
                _interval(band, key), str(sum(b["samples"] for b in own)), _text(own, "predicted_m", 100),
                _text(own, "rmse_m", 100), _text(own, "core_m", 100), _text(own, "mean_error_m", 100), _text(own, "coverage_95", 100),
                _text(own, "true_share", 100),
            ])  # fmt: skip
        header = [
            heading,
            "points",
            "predicted, cm",
            "RMSE, cm",
            "core, cm",
            "bias, cm",
            "95 % interval, %",
            "true, %",
        ]
        parts += [f"#### {name}: by {heading}", markdown(header, lines)]
    header, lines = ["confidence", "points", "mean confidence, %", "true, %"], []
    bins = len(rows[0]["confidence_bin_count"])
    for i in range(bins):
        keys = ("count", "confidence", "true_share")
        own = [{key: row[f"confidence_bin_{key}"][i] for key in keys} for row in rows]
        lines.append([
            f"{i / bins:.1f} to {(i + 1) / bins:.1f}", str(sum(b["count"] for b in own)),
            _text(own, "confidence", 100), _text(own, "true_share", 100),
        ])  # fmt: skip
    return [*parts, f"#### {name}: by confidence", markdown(header, lines)]


def _interval(band: Row, key: str = "by_range") -> str:
    if key == "by_scans" and band["to"] - band["from"] == 1:
        return str(band["from"])
    return (
        f"{band['from']:g} or more"
        if band["to"] == np.inf
        else f"{band['from']:g} to {band['to'] - (key == 'by_scans'):g}"
    )


def plot(rows: list[Row], path: Path) -> None:
    """For each scene and configuration: errors over uncertainty, coverages, errors by range, and true share."""
    panels = groups([row for row in rows if "ence" in row], "scene", "base", "variant")
    with figure(path, rows=max(1, len(panels)), columns=4) as axes:
        for line, ((scene, base, variant), own) in zip(axes, panels.items(), strict=False):
            _draw_bins(line[0], own)
            line[0].set_title(f"{scene}, {base}, {variant}", fontsize=9)
            _draw_coverages(line[1], own)
            _draw_ranges(line[2], own)
            _draw_confidence(line[3], own)


def _draw_bins(ax: Any, rows: list[Row]) -> None:
    predicted, measured = (
        [100 * v for row in rows for v in row[key]] for key in ("bin_predicted_m", "bin_rmse_m")
    )
    ends = np.array([min(predicted + measured), max(predicted + measured)])
    ax.fill_between(ends, ends / 1.5, ends * 1.5, color="lightgray", label="a factor of 1.5")
    ax.plot(ends, ends, color="gray", lw=1)
    ax.plot(predicted, measured, ".", label="bins")
    ax.set(xscale="log", yscale="log", xlabel="predicted, cm", ylabel="root mean square error, cm")


def _draw_coverages(ax: Any, rows: list[Row]) -> None:
    levels = list(_COVERAGES.values())
    ax.plot([0, 100], [0, 100], color="gray", lw=1)
    for row in rows:
        ax.plot(levels, [100 * row[key] for key in _COVERAGES], "o-", ms=3, color="C0", alpha=0.6)
    ax.set(xlabel="interval, %", ylabel="errors within, %", xlim=(40, 100), ylim=(0, 100))


def _draw_ranges(ax: Any, rows: list[Row]) -> None:
    names = [_interval(band) for band in rows[0]["by_range"]]
    for key, label, offset in (("predicted_m", "predicted", -0.1), ("rmse_m", "measured", 0.1)):
        points = [
            (i + offset, 100 * band[key])
            for row in rows
            for i, band in enumerate(row["by_range"])
            if key in band
        ]
        if points:
            ax.plot(*zip(*points, strict=True), "o", ms=4, label=label)
    ax.set_xticks(range(len(names)), names, fontsize=7)
    ax.set(xlabel="range, m", ylabel="root mean square, cm", ylim=(0, None))


def _draw_confidence(ax: Any, rows: list[Row]) -> None:
    ax.fill_between([0, 1], [-0.1, 0.9], [0.1, 1.1], color="lightgray", label="within 0.1")
    for row in rows:
        known = [
            (p, share)
            for p, share in zip(
                row["confidence_bin_confidence"], row["confidence_bin_true_share"], strict=True
            )
            if p is not None
        ]
        ax.plot(*zip(*known, strict=True), "o-", ms=3, color="C0", alpha=0.6)
    ax.set(xlabel="confidence", ylabel="share of true surface", xlim=(0, 1), ylim=(0, 1))


EXPERIMENT = Experiment(
    "Uncertainty and confidence against the truth",
    ("hugin", "oculii", "wall"),
    tasks,
    table,
    plot,
    bases=("default",),
)
