"""Fit the coefficients of `Map.confidence` and of the coverage of the truth, with cross-validation over kinds of scenes.

    python -m bench.paper.one_probability [FILE.npz …] [--presets quick default] [--seed 141] [--judge 391]

Two models predict, per vertex, the probability that it is true, and how much of the truth it covers that no better vertex
does. FILE are recorded drives with ground truth; each is a kind of its own. Scenes of the seed `--judge` are evaluated with
models fitted without their kind.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from radarsdf._core import vertex_areas
from radarsdf.evaluation import confidence_metrics, surface_metrics
from radarsdf.map.confidence import EvidenceAt, evidence, own_surface, probabilities, terms
from radarsdf.map.mesh import Surface
from radarsdf.map.queries import MapContents, to_local
from radarsdf.map.threshold import Limits, Tally
from radarsdf.simulate import SCENES
from scipy.spatial import cKDTree
from scipy.special import expit

from bench.runner import markdown
from bench.truth import truth_of
from scenes.kinds import KINDS
from scenes.scene import VOXEL_M, Scene, load_scene

FloatArray = NDArray[np.float64]

EVERY = 6
"""Every scene contributes all scans, every sixth, and its beginning, so that sparse data do not rely on models of dense data."""

_BEGINNING = 1 / 10
_BEGINNING_OF_DRIVE = 1 / 3  # those with lidar are short

_TRUTH_POINTS = 60_000
_BEST = 0.98  # vertices above this share of the highest probability near a point share the point
_LEARNT = 20_000  # vertices per map to fit
_SAMPLES = 300_000
_STEPS = 50
_ACCURATE = 1e-9


@dataclass(frozen=True)
class Example:
    """The whole surface of one map with its ground truth."""

    kind: str
    name: str
    truth: FloatArray  # (G, 3) world, m
    contents: MapContents
    voxel_m: float
    surface: Surface
    columns: FloatArray  # (V, K) regressors
    own: FloatArray  # (V,) factor of the probability, see radarsdf.map.confidence.own_surface
    reach: FloatArray  # (V,) upper limit of a probability; 0 without returns
    areas_m2: FloatArray  # (V,)
    is_true: NDArray[np.bool_]  # (V,)
    near: NDArray[np.int64]  # (N,) vertices within a leaf cell's edge of points of the truth, point by point
    points: NDArray[np.int64]  # (N,) index of that point, ascending from 0 in steps of 1

    @classmethod
    def of(cls, kind: str, scene: Scene, preset: str, part: str) -> "Example":
        config = scene.config(preset)
        contents = scene.without_intensities().fit(config)._contents
        surface = Surface.of(contents, VOXEL_M[preset])
        mesh = surface.part(contents.origin, np.ones(len(surface.faces), bool))
        assert scene.ground_truth is not None
        leaf_m, truth = config.leaf_size_m, scene.ground_truth
        step = max(1, len(truth) // _TRUTH_POINTS)
        found = [rows for rows in cKDTree(mesh.vertices).query_ball_point(truth[::step], leaf_m) if rows]
        normals = np.array(mesh.vertex_normals)
        distance_m = truth_of(scene, np.array(mesh.vertices), normals).distance_m
        return cls(
            kind,
            f"{kind}, {part}, {preset}",
            truth,
            contents,
            VOXEL_M[preset],
            surface,
            terms(contents, evidence_of(contents, surface)).numpy(),
            own_surface(evidence_of(contents, surface)).numpy(),
            probabilities(contents, evidence_of(contents, surface)).reach,
            vertex_areas(surface.vertices, surface.faces),
            distance_m <= leaf_m,
            np.concatenate([np.array(rows, np.int64) for rows in found]),
            np.repeat(np.arange(len(found)), [len(rows) for rows in found]),
        )

    def predicted(self, numbers: FloatArray) -> FloatArray:
        """(V,) logistic regression with coefficients (K,), times `own`; 0 without returns."""
        known = self.reach > 0
        predicted = np.zeros(len(known))
        predicted[known] = expit(self.columns[known] @ numbers) * self.own[known]
        return predicted

    def added(self, p: FloatArray) -> FloatArray:
        """(V,) truth that each vertex covers best, over its area; mean 1 where p is 1. At most 2, over 2."""
        highest = np.zeros(self.points[-1] + 1)
        np.maximum.at(highest, self.points, p[self.near])
        best = p[self.near] >= _BEST * highest[self.points]
        shares = 1 / np.bincount(self.points[best])
        credit = np.bincount(self.near[best], shares[self.points[best]], len(p))
        scale = (p**3 * self.areas_m2).sum() / credit.sum()
        found: FloatArray = np.minimum(scale * credit / np.maximum(self.areas_m2, 1e-9), 2) / 2
        return found

    def f_score(self, kept: NDArray[np.bool_]) -> float:
        """F-score with nothing discarded, %."""
        mesh = self.surface.part(self.contents.origin, kept)
        return 100 * surface_metrics(mesh, self.truth, samples=_SAMPLES)["f_score_all"] if kept.any() else 0.0


def learnt(examples: list[Example], targets: list[FloatArray]) -> FloatArray:
    """Fit a logistic regression in which each kind has the same weight, and places as far as their returns are their own."""
    rng = np.random.default_rng(0)
    known = [np.flatnonzero(e.reach > 0) for e in examples]
    rows = [rng.choice(own, min(_LEARNT, len(own)), replace=False) for own in known]
    kinds = [e.kind for e in examples]
    weights = [
        e.areas_m2[r] * e.own[r] / e.areas_m2[r].sum() / kinds.count(e.kind)
        for e, r in zip(examples, rows, strict=True)
    ]
    return logistic_regression(
        np.concatenate([e.columns[r] for e, r in zip(examples, rows, strict=True)]),
        np.concatenate([t[r] for t, r in zip(targets, rows, strict=True)]),
        np.concatenate(weights),
    )


def models(examples: list[Example]) -> tuple[FloatArray, FloatArray]:
    """Coefficients of the confidence, and of the coverage."""
    of_truth = learnt(examples, [e.is_true.astype(np.float64) for e in examples])
    return of_truth, learnt(examples, [e.added(confidence(e, of_truth)) for e in examples])


def confidence(example: Example, numbers: FloatArray) -> FloatArray:
    """(V,) confidence as by :func:`radarsdf.map.confidence.probabilities`, with these coefficients."""
    return np.minimum(example.predicted(numbers), example.reach)


def evidence_of(contents: MapContents, surface: Surface) -> EvidenceAt:
    """Evidence at the vertices of a surface."""
    return evidence(contents, to_local(contents, surface.vertices + contents.origin))


def judged(example: Example, others: list[Example]) -> list[str]:
    """Row of the table: the current mesh, and that of models fitted to the others."""
    of_truth, of_added = models(others)
    surface, p = example.surface, confidence(example, of_truth)
    hits = evidence_of(example.contents, surface).hits.astype(np.float64)
    tally = Tally.of(example.areas_m2, p, example.predicted(of_added), example.reach, hits)
    learnt_surface = replace(surface, confidence=p.astype(np.float32), tally=tally)
    limits = Limits.of(example.voxel_m)
    scores = [example.f_score(s.kept(limits)) for s in (surface, learnt_surface)]
    rows = np.random.default_rng(0).choice(len(p), _LEARNT, p=example.areas_m2 / example.areas_m2.sum())
    gaps = [
        confidence_metrics(s.confidence[rows].astype(np.float64), example.is_true[rows])["worst_gap"]
        for s in (surface, learnt_surface)
    ]
    print(example.name, scores, flush=True)
    least = tally.threshold().min_confidence
    return [example.name, *(f"{x:.1f}" for x in scores), f"{least:.2f}", *(f"{x:.2f}" for x in gaps)]


def logistic_regression(columns: FloatArray, shares: FloatArray, weights: FloatArray) -> FloatArray:
    """Coefficients (K,) of regressors (N, K) for shares (N,) in [0, 1]: weighted maximum likelihood, by Newton's method."""
    numbers = np.zeros(columns.shape[1])
    for _ in range(_STEPS):
        p = expit(columns @ numbers)
        gradient = columns.T @ (weights * (shares - p))
        hessian = (columns * (weights * p * (1 - p))[:, None]).T @ columns
        step = np.linalg.solve(hessian, gradient)
        numbers += step
        if np.abs(step).max() < _ACCURATE:
            break
    return numbers


def examples_of(specs: list[str], seed: int, presets: list[str]) -> list[Example]:
    """Build examples of all scans, every sixth, and the beginning of each scene."""
    found = []
    for spec in specs:
        scene, kind = load_scene(spec, seed=seed), Path(spec).stem
        beginning = _BEGINNING if scene.simulation else _BEGINNING_OF_DRIVE
        parts = {
            "all": scene,
            "every sixth": scene.every_nth(EVERY),
            "beginning": scene.first(max(2, round(beginning * len(scene)))),
        }
        found += [Example.of(kind, own, preset, name) for name, own in parts.items() for preset in presets]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", metavar="FILE", help="recorded drives with ground truth")
    parser.add_argument("--presets", nargs="+", choices=VOXEL_M, default=["quick"])
    parser.add_argument("--seed", type=int, default=141, help="seed of the simulated scenes to fit")
    parser.add_argument("--judge", type=int, default=391, help="seed of the scenes to evaluate")
    parser.add_argument(
        "--kinds", nargs="+", default=[*SCENES, *KINDS], help="simulated scenes; default: all"
    )
    options = parser.parse_args()
    torch.set_num_threads(min(2, torch.get_num_threads()))
    drives = examples_of(options.files, options.seed, options.presets)
    examples = examples_of(options.kinds, options.seed, options.presets) + drives
    for name, numbers in zip(("confidence", "covering"), models(examples), strict=True):
        print(name, ", ".join(f"{x:.2f}" for x in numbers), flush=True)
    body = [
        judged(e, [other for other in examples if other.kind != e.kind])
        for e in examples_of(options.kinds, options.judge, options.presets) + drives
    ]
    print(markdown(["map", "F-all now", "refitted", "threshold", "worst tenth now", "refitted"], body))


if __name__ == "__main__":
    main()
