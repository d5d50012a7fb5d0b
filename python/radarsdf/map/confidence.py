"""Uncertainty and confidence of a surface, from the evidence of the returns near it; and free space in leaf cells."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from radarsdf.arrays import Bools, Bytes, Floats, Floats32, Ints
from radarsdf.core import CellBlocks
from radarsdf.map.queries import MapContents, WholeMap, plane, signed_distance
from radarsdf.returns.evidence import CELLS_OF_SURFACE
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN, lattice_of
from radarsdf.returns.view_statistics import MOST_SCANS
from radarsdf.threads import ThreadPool, resolve_num_threads, start_vector_library

_FEW, _VERTICES = 1 << 13, 1 << 17  # places evaluated without a pool of threads; by one thread at a time

# Clutter ratio from which on a scene counts as fully rough.
# Measured: 0 to 0.07 on simulated scenes without much clutter, with all scans or few, 0.27 to 0.44 on five real drives.
_ROUGH_CLUTTER_RATIO = 0.27
# Floor of the uncertainty, leaf cells, which more returns do not reduce: in smooth scenes, and its increase in rough ones,
# where consistent returns may share an error. Tuned with `python -m bench.paper calibration`: errors are within 95 %
# intervals with 0.00 to 0.03 m on smooth simulated scenes, and with 0.20 to 0.29 m on the drives.
_FLOOR_CELLS = 0.05
_ROUGH_FLOOR_CELLS = 1.1
# Coefficients of `terms` in the logits of the confidence and of the coverage, fitted by
# `python -m bench.paper.one_probability`.
_CONFIDENCE = (3.29, -1.25, -0.87, -3.77, -3.50)
_COVERING = (-0.21, -0.79, -1.47, -2.68, -2.46)
_CROWDED_RETURNS = 4.0  # returns per cell at which crowding has half of its maximal effect
# Share of the usual information at which returns are as likely those of a surface next to them, slope of the log odds over
# the logarithm of the share, and standard errors of a share of few hits. Measured: F-scores of twelve kinds rise by 0.1
# points, with six times as many returns by 0.8, of another simulator's scenes by 0.0 and 1.4, of drives by -0.2 to 0.1.
_EDGE_SHARE, _EDGE_STEEPNESS, _SHARE_ERRORS = 0.25, 3, 4.0
_BEND_CELLS = 2.0  # bending allowed by the smoothness term, leaf cells: a slope turns from -1 to 1
_LEAST_LOGIT = -80.0  # so that the probability of an observed surface does not underflow in float32
# Minimum share of the scans reaching a surface that have a return in a given cell of it.
_DETECTION_RATE = 1 / 36
_SMOOTH = 0.5  # width of the smooth maximum, standard deviations: excess hits are weak evidence


class EvidenceAt(NamedTuple):
    """Evidence of a surface at N points, interpolated between the centres of leaf cells; 0 outside the cells."""

    information: Floats32  # (N,) sum of 1 / variance over the returns near each point, m⁻²
    hits: Floats32  # (N,) number of scans with returns near each point
    visibility: Floats32  # (N,) number of scans with rays reaching it
    usual: Floats32  # (N,) information of most returns in the neighbourhood, m⁻²


def evidence(contents: MapContents, points: Floats32) -> EvidenceAt:
    return interpolated(*contents.evidence_of_cells, contents.config.leaf_size_m, points)


def interpolated(cells: CellBlocks, columns: Floats32, leaf_size_m: float, points: Floats32) -> EvidenceAt:
    """Interpolate the `columns` (C, 4) of the evidence of leaf cells at points (N, 3), local frame, m."""
    # NaN and points beyond the range of keys are clamped to its limit, where there are no cells.
    limit_m = MAX_CELLS_FROM_ORIGIN * leaf_size_m
    near = np.fmax(np.fmin(points, limit_m), -limit_m)
    # Trilinear, because a vertex of a mesh may lie on the face between two cells.
    return EvidenceAt(*cells.interpolate(leaf_size_m, columns, near, resolve_num_threads(0)).T)


def uncertainty(contents: WholeMap, evidence: EvidenceAt) -> Floats32:
    """Return the standard error (N,) of the surface's position, m; NaN where there are no returns."""
    floor_m = floor_cells(contents) * contents.config.leaf_size_m
    known = np.where(evidence.information > 0, evidence.information, np.nan)
    return np.sqrt(1 / known + floor_m**2)


def roughness(contents: WholeMap) -> float:
    """Return the roughness, from 0, where all returns lie on thin surfaces, to 1, that of real drives."""
    return min(contents.clutter_ratio / _ROUGH_CLUTTER_RATIO, 1.0)


def floor_cells(contents: WholeMap) -> float:
    """Return the error of the surface's position that more returns do not reduce, leaf cells."""
    return _FLOOR_CELLS + _ROUGH_FLOOR_CELLS * math.pow(roughness(contents), 1.5)


def confidence(contents: WholeMap, evidence: EvidenceAt) -> Floats32:
    """Return the probability (N,) that a surface is within a leaf cell's edge; 0 where there are no returns."""
    return probabilities(contents, evidence).confidence.astype(np.float32)


class Probabilities(NamedTuple):
    """Probabilities of a surface at N points, float64; (nearly) 0 where there are no returns."""

    confidence: Floats  # (N,) see :func:`confidence`
    covering: Floats  # (N,) true surface newly covered per area, up to a constant factor
    reach: Floats  # (N,) probability of a position error within a leaf cell's edge, normally distributed


def probabilities(contents: WholeMap, evidence: EvidenceAt) -> Probabilities:
    """Evaluate the logistic regression on :func:`terms`, times :func:`own_surface`. `reach` is an upper bound of the confidence."""
    # A mesh of 80,000 vertices is one chunk: waking threads for each of forty operations takes longer than one thread.
    count = len(evidence.hits)
    if count <= _FEW:  # no pool either: it takes longer than a few points
        start_vector_library()
        return _probabilities(contents, evidence)
    firsts = range(0, count, _VERTICES)
    chunks = [EvidenceAt(*(column[i : i + _VERTICES] for column in evidence)) for i in firsts]
    with ThreadPool() as pool:
        found = pool.map(partial(_probabilities, contents), chunks)
        return Probabilities(*map(np.concatenate, zip(*found, strict=True)))


def _probabilities(contents: WholeMap, evidence: EvidenceAt) -> Probabilities:
    columns = terms(contents, evidence)
    logits = torch.tensor([_CONFIDENCE, _COVERING], dtype=torch.float64, device="cpu")
    true, covering = ((columns * logit).sum(1).clamp(min=_LEAST_LOGIT).sigmoid() for logit in logits)
    # For a thin plate with second differences of standard deviation b cells, and returns of information density ρ per cell, the
    # variance is 1 / (8 √(ρ / b²)). Where the returns alone are more precise, the neighbourhood adds nothing.
    error_cells = columns[:, 1].exp()  # of the returns near each place alone
    density = 1 / (CELLS_OF_SURFACE * error_cells.square())
    smoothed_cells = error_cells.minimum((_BEND_CELLS / (8 * density.sqrt())).sqrt())
    reach = torch.erf(math.sqrt(0.5) / smoothed_cells)
    own = own_surface(evidence)
    found = (true * own).minimum(reach), covering * own, reach
    return Probabilities(*(column.numpy() for column in found))


def own_surface(evidence: EvidenceAt) -> Tensor:
    """Return the probability (N,) that the returns at places belong to a surface there, not to one next to them."""
    # Noise spreads returns beyond the edges of surfaces. More data increase their number there and on the surface alike, but not
    # their share, of which few hits determine only an upper limit.
    information, hits, _, usual = _as_tensors(evidence)
    share = information / usual.clamp(min=1e-30)
    at_most = share * (1 + _SHARE_ERRORS / hits.clamp(min=0.1).sqrt())
    return 1 / (1 + (_EDGE_SHARE / at_most.clamp(min=1e-6)).pow(_EDGE_STEEPNESS))


def terms(contents: WholeMap, evidence: EvidenceAt) -> Tensor:
    """Return regressors (N, 5), float64: 1, log of the error in leaf cells, missing returns of a surface in standard
    deviations, and roughness and crowding of the map. Infinite without returns."""
    # The last two are bounded: a rougher or more crowded map than in the training data must not lose all surface.
    information, hits, visibility, _ = _as_tensors(evidence)
    error_cells = information.rsqrt() / contents.config.leaf_size_m
    expected = CELLS_OF_SURFACE * _DETECTION_RATE * visibility
    deviations = (expected - hits) / (expected + 1).sqrt()
    missing = (deviations + deviations.square().add(_SMOOTH**2).sqrt()) / 2  # a smooth max(0, deviations)
    per_cell = contents.returns_per_cell
    cluttered = math.tanh(contents.clutter_ratio / _ROUGH_CLUTTER_RATIO)
    of_map = cluttered, per_cell / (per_cell + _CROWDED_RETURNS)
    rough, crowded = (torch.full_like(error_cells, value) for value in of_map)
    return torch.stack([torch.ones_like(error_cells), error_cells.log(), missing, rough, crowded], 1)


def _as_tensors(evidence: EvidenceAt) -> Iterator[Tensor]:
    """Convert the columns to float64. PyTorch's functions compute several numbers at a time, NumPy's and SciPy's do not."""
    return (torch.from_numpy(column).double() for column in evidence)


_ODDS_CELLS = 50_000  # sample of leaf cells that calibrates the weight of free-space crossings


@dataclass(frozen=True)
class CellsInBox:
    """Free space and returns in the leaf cells of a box, as dense arrays."""

    corner: Floats  # (3,) lower corner of the first cell, world, m
    passed: Bytes  # number of scans with a ray through the cell, at most 7
    returns: Bools  # whether the cell has returns
    observed: Bools  # whether the cell is a leaf cell of the map


def dense_cells(
    contents: MapContents, lower: Ints, shape: tuple[int, int, int]
) -> tuple[Bytes, Bools, Bools]:
    """Return `passed`, `returns` and `observed` of the leaf cells from `lower` (3,) on, relative to the map's origin."""
    passed, returns = contents.free_space().dense(lower, shape)
    cells = lattice_of(contents.field.table.leaf_keys()) - lower
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    observed = np.zeros(shape, bool)
    observed[tuple(cells[inside].T)] = True
    return passed, returns, observed


def free_space_odds(contents: MapContents) -> Floats:
    """Return the odds (8,) that a leaf cell crossed by 0 to 7 or more scans is behind rather than before a surface."""
    # Calibrated on cells clearly on one side of a surface: noise and false returns make rays cross solid cells.
    keys = contents.field.table.leaf_keys()
    keys = keys[:: max(1, len(keys) // _ODDS_CELLS)]
    leaf_m = contents.config.leaf_size_m
    centres = ((lattice_of(keys) + 0.5) * leaf_m).astype(np.float32)
    distances_m = signed_distance(contents, centres)
    # At grazing incidence the field exceeds the distance, and with noisy returns falls below it; so does its gradient.
    edge = leaf_m * np.linalg.norm(plane(contents, centres)[:, 1:], axis=1)
    weights = confidence(contents, evidence(contents, centres)).astype(np.float64)
    passed = contents.free_space().at(keys)

    sides = (distances_m < -edge, distances_m > edge)
    behind, before = (np.bincount(passed[side], weights[side], MOST_SCANS + 1) + 1 for side in sides)
    odds = (behind / behind.sum()) / (before / before.sum())
    # Enforce monotonicity: more crossings never make a cell less free.
    return np.minimum.accumulate(odds)
