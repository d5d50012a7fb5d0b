# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Tries one probability instead of the rules of a mesh, leaving out whole kinds of scenes.

    python -m bench.paper.one_probability [FILE.npz …] [--preset quick] [--seed 31]

Learnt are, for each vertex, the probability that it is true, and how much of the truth it adds that no better vertex
covers. A mesh keeps the probabilities above the threshold at which the F-score that is expected by the two is highest.
FILE are recorded drives with ground truth; each is a kind of its own.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from radarsdf import FitConfig
from radarsdf.evaluation import confidence_metrics, surface_metrics
from radarsdf.map import queries
from radarsdf.map.contents import MapContents
from radarsdf.map.isosurface import mesh_components
from radarsdf.map.meshing import Surface, check_limits
from radarsdf.returns.evidence import CELLS_OF_SURFACE
from radarsdf.simulate import KINDS, SCENES
from scipy.spatial import cKDTree

from .confidence_model import logistic_regression
from .experiment import fit
from .report import markdown
from .scenes import Scene, load_scene
from .truth import truth_of

FloatArray = NDArray[np.float64]

EVERY = (1, 6)
"""All scans of a simulated scene, and every sixth: what few scans tell must not be learnt from many."""

_MIN_ROUGH_SHARE = 0.03  # below it, scenes do not differ
_TRUTH_POINTS = 60_000
_BEST = 0.98  # of the highest probability round a point of the truth: these vertices share it
_LEARNT = 20_000  # vertices of a map
_SAMPLES = 300_000
_VOXEL_M = {"quick": 0.2, "default": 0.1}


@dataclass(frozen=True)
class Example:
    """The whole surface of one map, beside the truth."""

    kind: str
    name: str
    truth: FloatArray  # (G, 3) world, m
    contents: MapContents
    surface: Surface
    columns: FloatArray  # (V, K) regressors
    known: NDArray[np.bool_]  # (V,) whether there are returns
    areas_m2: FloatArray  # (V,)
    is_true: NDArray[np.bool_]  # (V,)
    near: NDArray[np.int64]  # (N,) vertices within a leaf cell's edge of points of the truth, point by point
    points: NDArray[np.int64]  # (N,) ascending from 0 in steps of 1: the point that each of them is near to

    @classmethod
    def of(cls, kind: str, scene: Scene, preset: str) -> Example:
        ranges = {"min_range_m": scene.min_range_m, "max_range_m": scene.max_range_m}
        config = (FitConfig.quick() if preset == "quick" else FitConfig()).override(returns=ranges)
        contents = fit(scene.without_intensities(), config)._contents
        surface = Surface.of(contents, _VOXEL_M[preset])
        mesh = surface.mesh(contents.origin, np.ones(len(surface.faces), bool), 0)
        assert scene.ground_truth is not None
        leaf_m, truth = config.leaf_size_m, scene.ground_truth
        step = max(1, len(truth) // _TRUTH_POINTS)
        found = [rows for rows in cKDTree(mesh.vertices).query_ball_point(truth[::step], leaf_m) if rows]
        thirds = np.repeat(mesh.area_faces / 3, 3)
        normals = np.array(mesh.vertex_normals)
        distance_m = truth_of(scene, np.array(mesh.vertices), normals).distance_m
        return cls(
            kind,
            f"{kind}, {len(scene)} scans",
            truth,
            contents,
            surface,
            columns_of(contents, surface.evidence),
            (surface.evidence.information > 0).numpy(),
            np.bincount(mesh.faces.ravel(), thirds, len(mesh.vertices)).astype(np.float64),
            distance_m <= leaf_m,
            np.concatenate([np.array(rows, np.int64) for rows in found]),
            np.repeat(np.arange(len(found)), [len(rows) for rows in found]),
        )

    def predicted(self, numbers: FloatArray) -> FloatArray:
        """(V,) by the numbers (K,) of a logistic regression."""
        return np.where(self.known, 1 / (1 + np.exp(-(self.columns @ numbers))), 0)

    def added(self, p: FloatArray) -> FloatArray:
        """(V,) truth that each vertex covers best, over its area; in the mean 1 where p is 1. At most 2, over 2."""
        highest = np.zeros(self.points[-1] + 1)
        np.maximum.at(highest, self.points, p[self.near])
        best = p[self.near] >= _BEST * highest[self.points]
        shares = 1 / np.bincount(self.points[best])
        credit = np.bincount(self.near[best], shares[self.points[best]], len(p))
        scale = (p**3 * self.areas_m2).sum() / credit.sum()
        found: FloatArray = np.minimum(scale * credit / np.maximum(self.areas_m2, 1e-9), 2) / 2
        return found

    def f_score(self, kept: NDArray[np.bool_]) -> float:
        """With nothing discarded, %."""
        mesh = self.surface.mesh(self.contents.origin, kept, 0)
        return 100 * surface_metrics(mesh, self.truth, samples=_SAMPLES)["f_score_all"] if kept.any() else 0.0


def columns_of(contents: MapContents, evidence: queries.EvidenceAt) -> FloatArray:
    """(V, 4): 1, log error in leaf cells, detections that are missing in deviations of chance, log rough share."""
    error_cells = 1 / (np.sqrt(evidence.information.double().numpy()) * contents.config.leaf_size_m + 0.03)
    # Of the rate below which a mesh leaves a surface out.
    expected = CELLS_OF_SURFACE * queries.MIN_DETECTION_RATE * evidence.looks.double().numpy()
    missing = np.maximum(0, (expected - evidence.detections.numpy()) / np.sqrt(expected + 1))
    rough = np.full_like(missing, max(contents.rough_share, _MIN_ROUGH_SHARE))
    return np.stack([np.ones_like(missing), np.log(error_cells), missing, np.log(rough)], 1)


def learnt(examples: list[Example], targets: list[FloatArray]) -> FloatArray:
    """The numbers of a logistic regression, in which each kind has the same weight."""
    rng = np.random.default_rng(0)
    rows = [rng.choice(len(e.columns), min(_LEARNT, len(e.columns)), replace=False) for e in examples]
    kinds = [e.kind for e in examples]
    weights = [
        e.areas_m2[r] / e.areas_m2[r].sum() / kinds.count(e.kind) for e, r in zip(examples, rows, strict=True)
    ]
    return logistic_regression(
        np.concatenate([e.columns[r] for e, r in zip(examples, rows, strict=True)]),
        np.concatenate([t[r] for t, r in zip(targets, rows, strict=True)]),
        np.concatenate(weights),
    )


def threshold(p: FloatArray, added: FloatArray, areas_m2: FloatArray) -> float:
    """The probability from which on the expected F-score is highest."""
    order = np.argsort(-p, kind="stable")
    precision = np.cumsum((p * areas_m2)[order]) / np.cumsum(areas_m2[order])
    completion = np.cumsum((added * areas_m2)[order])
    completion /= completion[-1]
    return float(p[order][np.argmax(precision * completion / (precision + completion))])


def judged(example: Example, others: list[Example]) -> list[str]:
    """A row of the table: an example by what is learnt on others."""
    of_truth = learnt(others, [e.is_true.astype(np.float64) for e in others])
    of_added = learnt(others, [e.added(e.predicted(of_truth)) for e in others])
    p, surface = example.predicted(of_truth), example.surface
    limit = threshold(p, example.predicted(of_added), example.areas_m2)
    kept = np.asarray((p >= limit)[surface.faces].all(axis=1), bool)
    pieces = queries.MIN_COMPONENT_TRIANGLES
    now = surface.kept(*check_limits(example.contents, 0.0, None, queries.MIN_DETECTION_RATE), pieces)
    in_pieces = kept.copy()
    labels, sizes = mesh_components(surface.faces[kept], len(p))
    in_pieces[kept] = sizes[labels] >= pieces
    scores = [example.f_score(faces) for faces in (now, kept, in_pieces)]
    rows = np.random.default_rng(0).choice(len(p), _LEARNT, p=example.areas_m2 / example.areas_m2.sum())
    gaps = [
        confidence_metrics(x[rows], example.is_true[rows])["worst_gap"]
        for x in (surface.confidence.astype(np.float64), p)
    ]
    print(example.name, scores, flush=True)
    return [example.name, *(f"{x:.1f}" for x in scores), f"{limit:.2f}", *(f"{x:.2f}" for x in gaps)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", metavar="FILE", help="recorded drives with ground truth")
    parser.add_argument("--preset", choices=_VOXEL_M, default="quick")
    parser.add_argument("--seed", type=int, default=31, help="of the simulated scenes")
    parser.add_argument(
        "--kinds", nargs="+", default=[*SCENES, *KINDS], help="simulated scenes; default: all"
    )
    options = parser.parse_args()
    torch.set_num_threads(min(2, torch.get_num_threads()))
    examples = []
    for kind in options.kinds:
        scene = load_scene(kind, seed=options.seed)
        examples += [Example.of(kind, scene.every_nth(n), options.preset) for n in EVERY]
    examples += [Example.of(Path(file).stem, load_scene(file), options.preset) for file in options.files]
    body = [judged(e, [other for other in examples if other.kind != e.kind]) for e in examples]
    print(
        markdown(["map", "F-all now", "learnt", "and pieces", "threshold", "worst tenth now", "learnt"], body)
    )


if __name__ == "__main__":
    main()
