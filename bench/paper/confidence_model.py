# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Fits the numbers of `RadarMap.confidence` anew: a logistic regression of true surface on the evidence.

    python -m bench.paper.confidence_model [FILE.npz …]

The simulated scenes are those of seed 1 and a street of seed 7; FILE are recorded drives with ground truth. Each scene
has the same weight. What was left out, other seeds and drives, is for `python -m bench.paper calibration`.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import torch
from numpy.typing import NDArray
from radarsdf import FitConfig
from radarsdf.map import queries

from .calibration import sampled
from .experiment import fit
from .report import markdown
from .scenes import Scene, load_scene
from .truth import truth_of

FloatArray = NDArray[np.float64]

_SAMPLES = 40_000
_STEPS = 50
_ACCURATE = 1e-9


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", metavar="FILE", help="recorded drives with ground truth")
    options = parser.parse_args()
    scenes = [load_scene(name, seed=1) for name in ("hugin", "oculii", "wall")]
    scenes += [
        load_scene("hugin", seed=1).every_nth(10),
        load_scene("hugin", seed=1, frames=5 * len(scenes[0])),
    ]
    scenes += [load_scene("astyx", seed=7), *(load_scene(file) for file in options.files)]
    found = [evidence_and_truth(scene) for scene in scenes]
    columns = np.concatenate([columns for columns, _ in found])
    is_true = np.concatenate([is_true for _, is_true in found])
    weights = np.concatenate([np.full(len(is_true), 1 / len(is_true)) for _, is_true in found])
    numbers = logistic_regression(columns, is_true.astype(np.float64), weights)
    names = ("constant", "log error in leaf cells", "log detection rate", "log rough share")
    print(markdown(["of", "number"], [[name, f"{x:.2f}"] for name, x in zip(names, numbers, strict=True)]))


def evidence_and_truth(scene: Scene) -> tuple[FloatArray, NDArray[np.bool_]]:
    """For points of the whole mesh, what the confidence is made of (N, 4), and whether a surface is there (N,)."""
    config = FitConfig().override(
        returns={"min_range_m": scene.min_range_m, "max_range_m": scene.max_range_m}
    )
    radar_map = fit(scene, config)
    mesh = radar_map.mesh(
        min_detection_rate=0, max_uncertainty=math.inf, min_component_triangles=0, progress=False
    )
    x, normals = sampled(mesh, _SAMPLES, scene.box)
    contents = radar_map._contents
    evidence = queries.evidence(contents, queries.to_local(contents, torch.from_numpy(x)))
    is_true = truth_of(scene, x, normals).distance_m <= radar_map.config.leaf_size_m
    known = (evidence.information > 0).numpy()
    return queries.confidence_terms(contents, evidence).numpy()[known], is_true[known]


def logistic_regression(columns: FloatArray, shares: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted maximum likelihood, by Newton's method.

    Parameters
    ----------
    columns : (N, K) float64
        Regressors. One of them is constant.
    shares : (N,) float64
        What is to be predicted, in [0, 1].
    weights : (N,) float64
        Weight of each row.

    Returns
    -------
    (K,) float64
        Numbers whose sum, times the columns, is the logit of the probability.
    """
    numbers = np.zeros(columns.shape[1])
    for _ in range(_STEPS):
        p = 1 / (1 + np.exp(-(columns @ numbers)))
        gradient = columns.T @ (weights * (shares - p))
        hessian = (columns * (weights * p * (1 - p))[:, None]).T @ columns
        step = np.linalg.solve(hessian, gradient)
        numbers += step
        if np.abs(step).max() < _ACCURATE:
            break
    return numbers


if __name__ == "__main__":
    main()
