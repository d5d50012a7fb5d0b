"""Calibration of a map: `uncertainty` against distances to the truth, `confidence` against true surface."""

import argparse
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from radarsdf.evaluation import confidence_metrics, uncertainty_metrics
from scipy.spatial import cKDTree

from bench.paper.surface import measured, sampled, samples_of
from bench.peers.interface import PEERS
from bench.runner import Column, Row, chosen_scenes
from bench.sensor import deviation
from bench.truth import truth_of
from scenes.scene import Scene
from scenes.settings import words_of

Floats = NDArray[np.float64]

TRUE_M = 0.5
"""Points of the mesh within this distance of the truth have an error; others are false."""

_MOST_SAMPLES = 40_000  # more change nothing: neighbours have the same error
_NEAR_M = 0.3  # radius of the returns that give a point's range and number of scans
_RANGES_M = (0.0, 10.0, 20.0, 30.0, np.inf)
_SCANS = (0, 1, 2, 4, 8, 16, 32, np.inf)
_FEWEST = 50  # smallest number of points in a band
_NO_TRUTH = "the scene has no ground truth"

COLUMNS = {
    **{f"coverage_{level}": Column(f"{level} % interval, %", 100, 1) for level in (68, 95)},
    "ence": Column("ENCE"),
    "z_rms": Column("error / predicted"),
    "worst_decile_factor": Column("worst decile, factor"),
    "mean_error_m": Column("bias, cm", 100),
    "rmse_m": Column("RMSE, cm", 100),
    "core_m": Column("core, cm", 100),
    "mean_uncertainty_m": Column("mean predicted, cm", 100),
    "predicted_m": Column("predicted, cm", 100),
    "false_share": Column("false, %", 100, 1),
    "aside_share": Column("no truth along normal, %", 100, 1),
    "unobserved_share": Column("NaN, %", 100, 1),
    "confidence_worst_gap": Column("confidence, worst gap"),
    "confidence_auc": Column("confidence, AUC"),
    "samples": Column("points", digits=0),
    "confidence": Column("mean confidence, %", 100, 1),
    "true_share": Column("true, %", 100, 1),
}


def calibration(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per configuration, `--set` and repetition, then rows by decile, range, scans and confidence."""
    variants = [{}, *options.set]
    for scene, base, changes in itertools.product(list(chosen_scenes(options)), options.base, variants):
        for repetition in range(options.repetitions):
            own = scene.repeated(repetition)
            row: Row = {"scene": scene.name, "base": base, "variant": words_of(changes) or "defaults"}
            if own.simulation is None and own.ground_truth is None:
                yield row | {"why_not": _NO_TRUTH}
                continue
            settings = {name: value for name, value in changes.items() if name != "mesh"}
            radar_map = own.fit(own.config(base, quick=options.quick, seed=repetition, **settings))
            mesh = radar_map.mesh(progress=False, **changes.get("mesh", {}))
            x, normals = sampled(mesh, samples_of(options, _MOST_SAMPLES), own.box)
            if len(x) == 0:
                yield row | {
                    "why_not": "the mesh has no surface" + ("" if own.box is None else " in the box")
                }
                continue
            try:
                answers = radar_map.uncertainty(x), radar_map.confidence(x)
                found = compared(own, x, normals, *answers, radar_map.config.leaf_size_m)
            except ValueError as error:  # too few points of true surface
                yield row | {"why_not": str(error)}
                continue
            yield row | {key: value for key, value in found.items() if np.isscalar(value)}
            for part in _parts(found):
                yield row | part


def _parts(found: Row) -> Iterator[Row]:
    """Yield rows of a result by decile of the uncertainty, range, number of scans, and confidence."""
    for i, (predicted_m, rmse_m) in enumerate(
        zip(found["decile_predicted_m"], found["decile_rmse_m"], strict=True)
    ):
        yield {
            "part": "by uncertainty",
            "bin": f"decile {i + 1}",
            "predicted_m": predicted_m,
            "rmse_m": rmse_m,
        }
    for part in ("by range, m", "by scans"):
        for band in found[part]:
            yield {"part": part, **band}
    bins = found["confidence_bin_count"]
    for i, samples in enumerate(bins):
        share, confidence = found["confidence_bin_true_share"][i], found["confidence_bin_confidence"][i]
        name = f"{i / len(bins):.1f} to {(i + 1) / len(bins):.1f}"
        row = {"part": "by confidence", "bin": name, "samples": samples}
        yield row | ({"confidence": confidence, "true_share": share} if samples else {})


def compared(
    scene: Scene, x: Floats, normals: Floats, uncertainty_m: Floats, confidence: Floats, leaf_size_m: float
) -> Row:
    """Errors of a map at points (N, 3) of its mesh, and their predictions.

    Shares of all points: `false_share` is farther than `TRUE_M` from the truth; `aside_share` is not, but has no surface
    along the normal (beyond an edge, or the truth is not flat); `unobserved_share` is NaN. Figures
    of the uncertainty are those of the other points. The standard error of the truth is added to the prediction in
    quadrature. `core_m` is the deviation of the errors up to `TRUE_M` without a uniform background: points near another
    surface by chance raise the root mean square, but not this. A map that reports surface there has a wrong
    confidence, not a wrong uncertainty. A confidence is right if surface is within `leaf_size_m` for that share of points.

    Raises
    ------
    ValueError
        If there are too few of them, or a prediction of the map is out of range.
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
        "by range, m": _bands(range_m, _RANGES_M, error_m, predicted_m, is_true),
        "by scans": _bands(scans, _SCANS, error_m, predicted_m, is_true),
    }
    metrics = confidence_metrics(confidence, truth.distance_m <= leaf_size_m)
    return row | {f"confidence_{key}": v for key, v in metrics.items()}


def seen_from(scene: Scene, x: Floats) -> tuple[Floats, Floats]:
    """Median range, m, of the returns near each point (N,), and the number of their scans (N,).

    Without returns nearby, the range is that of the nearest one.
    """
    rays = scene.rays()
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
    values: Floats, edges: Sequence[float], error_m: Floats, predicted_m: Floats, is_true: NDArray[np.bool_]
) -> list[Row]:
    """Figures of the points in each band of values."""
    found = []
    for low, high in itertools.pairwise(edges):
        own = (values >= low) & (values < high)
        name = f"{low:g} or more" if high == np.inf else f"from {low:g} to below {high:g}"
        band: Row = {"bin": name, "samples": int(own.sum())}
        band["true_share"] = float(is_true[own].mean()) if own.any() else None
        if np.count_nonzero(own & np.isfinite(error_m) & np.isfinite(predicted_m)) >= _FEWEST:
            metrics = uncertainty_metrics(error_m[own], predicted_m[own])
            band |= {key: metrics[key] for key in ("rmse_m", "mean_error_m", "z_rms", "coverage_95")}
            band["core_m"] = _core(error_m[own & np.isfinite(predicted_m)])
            band["predicted_m"] = float(np.sqrt(np.nanmean(predicted_m[own & np.isfinite(error_m)] ** 2)))
        found.append(band)
    return found


def _core(error_m: Floats) -> float | None:
    """Deviation of a Gaussian in a uniform background of errors (N,), m; None for few. NaN is ignored."""
    sigma_m = deviation(error_m[np.abs(error_m) <= TRUE_M], TRUE_M)
    return sigma_m if np.isfinite(sigma_m) else None


WHOLE: dict[str, Any] = {"min_confidence": 0.0, "max_uncertainty": np.inf, "min_component_triangles": 0}
"""Arguments of a mesh that keeps all surface."""

KINDS_COLUMNS = {
    "f_score_all": Column("F-score, %", 100, 1, "highest"),
    "f_score_without_holes": Column("by a truth without holes, %", 100, 1, "highest"),
    "true_share": Column("true share"),
    "worst_gap": Column("worst gap"),
    "mean_gap": Column("mean gap"),
    "auc": Column("AUC"),
}
KINDS_PEERS = ("VDBFusion", "radarsdf, quick", "radarsdf")


def kinds(options: argparse.Namespace) -> Iterator[Row]:
    """Per scene and repetition with another seed, yield F-scores of all methods, and the confidence of ours.

    The confidence is that of the whole surface, whatever the mesh limits.
    """
    for scene, repetition in itertools.product(list(chosen_scenes(options)), range(options.repetitions)):
        own = scene.repeated(repetition)
        for name in options.peers:
            yield measured(options, PEERS[name], own) | {"part": "F-score with nothing discarded"}
        for name, preset in (("radarsdf", "default"), ("radarsdf, quick", "quick")):
            row: Row = {"scene": scene.name, "method": name, "part": "confidence of the whole surface"}
            if own.simulation is None and own.ground_truth is None:
                yield row | {"why_not": _NO_TRUTH}
                continue
            config = own.config(preset, quick=options.quick and preset == "default")
            radar_map = own.without_intensities().fit(config)
            leaf_m = radar_map.config.leaf_size_m
            mesh = radar_map.mesh(leaf_m, **WHOLE, progress=False)
            x, normals = sampled(mesh, samples_of(options, _MOST_SAMPLES), own.box)
            if len(x) == 0:
                yield row | {"why_not": "the map has no surface"}
                continue
            is_true = truth_of(own, x, normals).distance_m <= leaf_m
            found = confidence_metrics(radar_map.confidence(x), is_true)
            yield row | {key: found[key] for key in ("true_share", "worst_gap", "mean_gap", "auc")}
