"""Queries of a map at positions (N, 3) float32, local frame, m: the one place that evaluates the field."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from radarsdf._core import CellBlocks
from radarsdf.checks import hides_bar
from radarsdf.map.contents import MapContents, WholeMap
from radarsdf.returns.evidence import CELLS_OF_SURFACE, Evidence, usual_information
from radarsdf.returns.free_space import MOST_SCANS
from radarsdf.returns.response import RANGE_MARGIN
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN, lattice_of
from radarsdf.threads import ThreadPool, resolve_num_threads, start_vector_library

VOXEL_M = 0.1
"""Default edge of a mesh's voxels, m."""
INWARD = 1e-3
"""Shift of points on the border of a map into it, edges of a cell."""
_CHUNK = 1 << 13  # points per evaluation, so that hidden layers fit the second-level cache
_VERTICES = 1 << 17  # vertices per evaluation of their probabilities
_MIN_RANGE_M = 1e-6  # lower bound of the norm of a direction, for points at the sensor

# Clutter ratio from which on a scene counts as fully rough.
# Measured: 0 to 0.07 on simulated scenes without much clutter, 0.27 to 0.44 on five real drives.
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
_ODDS_CELLS = 50_000  # sample of leaf cells that calibrates the weight of free-space crossings


@torch.inference_mode(mode=False)  # gradients, for normals, need ordinary tensors
def to_local(contents: WholeMap, world: Tensor) -> Tensor:
    """Convert world positions (N, 3), m, to the local frame, float32. The origin is subtracted in float64."""
    return (world.double() - torch.from_numpy(contents.origin)).float()


def signed_distance(
    contents: MapContents, points: Tensor, *, description: str = "", progress: bool | None = False
) -> Tensor:
    return evaluate(contents.field.sdf, points, description=description, progress=progress)


def gradient(contents: MapContents, points: Tensor) -> Tensor:
    return evaluate(contents.field.gradient, points)


@torch.inference_mode(mode=False)
def intensity(contents: MapContents, points: Tensor, sensors: Tensor, *, extrapolate: bool = False) -> Tensor:
    """Predict intensities (N,), sensor units, of returns from points to sensors (N, 3), local frame, m.

    NaN for ranges and elevations unlike those of all returns, unless `extrapolate`.
    """
    scale, field = contents.intensity_scale, contents.field
    assert scale is not None

    def of_chunk(chunk: Tensor) -> Tensor:
        positions, rays = chunk[:, :3], chunk[:, :3] - chunk[:, 3:]
        ranges_m = rays.norm(dim=1)
        directions = rays / ranges_m.clamp_min(_MIN_RANGE_M)[:, None]
        # Clip to the ranges of the fit: the regression would extrapolate.
        nearest_m, farthest_m = contents.sensor.range_m
        found = scale.to_sensor(field.intensity(positions, directions, ranges_m.clamp(nearest_m, farthest_m)))
        if extrapolate:
            return found
        measured = (ranges_m >= nearest_m / RANGE_MARGIN) & (ranges_m <= farthest_m * RANGE_MARGIN)
        if field.reflectance is not None:
            measured &= torch.from_numpy(field.reflectance.measured(directions.numpy(), ranges_m.numpy()))
        return found.where(measured, torch.nan)

    return evaluate(of_chunk, torch.cat([points, sensors], 1))


def occupied(contents: MapContents, points: Tensor) -> Tensor:
    return evaluate(contents.field.occupied, points)


@torch.inference_mode(mode=False)
def evaluate(
    function: Callable[[Tensor], Tensor],
    points: Tensor,
    *,
    description: str = "",
    progress: bool | None = False,
) -> Tensor:
    """Evaluate function(points) without gradients, in chunks, on the number of threads of PyTorch."""
    without_gradients = torch.no_grad()(function)
    chunks = torch.split(points, _CHUNK)
    if len(chunks) <= 1:
        start_vector_library()  # the first queries may be concurrent
        return without_gradients(points)
    with ThreadPool() as pool:
        results = pool.map(without_gradients, chunks)
        bar = tqdm(results, description, len(chunks), unit="chunk", disable=hides_bar(progress))
        return torch.cat(list(bar))


# Observed region


@torch.inference_mode(mode=False)
def into_cells(contents: MapContents, points: Tensor, size_m: float | None = None) -> tuple[Tensor, Tensor]:
    """Shift points on the border of occupied leaf cells slightly into one; return the points, and a mask of those inside.

    A point on a face, such as a vertex of a mesh, belongs to the cell above it, which may be empty.
    """
    leaf_m = contents.config.leaf_size_m
    step_m = INWARD * (leaf_m if size_m is None else size_m)
    inside = occupied(contents, points)
    left = torch.nonzero(~inside)[:, 0]
    place = points[left] / leaf_m
    left = left[((place - place.round()).abs() * leaf_m <= step_m).any(dim=1)]
    if len(left) == 0:
        return points, inside
    points, inside = points.clone(), inside.clone()
    for shift in itertools.product((-step_m, step_m), repeat=3):
        moved = points[left] + torch.tensor(shift, dtype=torch.float32, device="cpu")
        found = occupied(contents, moved)
        points[left[found]] = moved[found]
        inside[left[found]] = True
        left = left[~found]
    return points, inside


def where_observed(
    contents: MapContents, function: Callable[..., Tensor], points: Tensor, *others: Tensor, extrapolate: bool
) -> Tensor:
    """Evaluate function(contents, points, *others) at observed (`extrapolate`: finite) points and finite others; else NaN."""
    points, known = into_cells(contents, points)
    if extrapolate:
        known = points.isfinite().all(dim=1)
    for other in others:
        known = known & other.isfinite().all(dim=1)
    return where(known, points, *others, function=partial(function, contents))


@torch.inference_mode(mode=False)
def where(known: Tensor, *inputs: Tensor, function: Callable[..., Tensor]) -> Tensor:
    """Evaluate function(*inputs) for the rows in the mask `known` (N,); NaN for the others."""
    if bool(known.all()):
        return function(*inputs)
    found = function(*(rows[known] for rows in inputs))
    result = found.new_full((len(known), *found.shape[1:]), torch.nan)
    result[known] = found
    return result


# Evidence of a surface


class EvidenceAt(NamedTuple):
    """Evidence of a surface at N points, interpolated between the centres of leaf cells; 0 outside the cells."""

    information: Tensor  # (N,) sum of 1 / variance over the returns near each point, m⁻²
    hits: Tensor  # (N,) number of scans with returns near each point
    visibility: Tensor  # (N,) number of scans with rays reaching it
    usual: Tensor  # (N,) information of most returns in the neighbourhood, m⁻²


def evidence(contents: MapContents, points: Tensor) -> EvidenceAt:
    keys, usual = contents.field.table.leaf_keys(), contents.usual_information
    return interpolated(contents.evidence, keys, contents.config.leaf_size_m, points, usual)


def interpolated(
    found: Evidence,
    leaf_keys: NDArray[np.uint64],
    leaf_size_m: float,
    points: Tensor,
    usual: NDArray[np.float32] | None = None,
) -> EvidenceAt:
    """Interpolate the evidence of leaf cells with ascending keys (C,) at points (N, 3), local frame, m. `usual` (C,), if known."""
    num_threads = resolve_num_threads(0)
    usual = usual_information(found.information, leaf_keys, num_threads) if usual is None else usual
    of_cells = np.stack([found.information, found.hits, found.visibility, usual], 1, dtype=np.float32)
    # Points beyond the range of keys are clamped to its limit, where there are no cells.
    limit_m = MAX_CELLS_FROM_ORIGIN * leaf_size_m
    near = points.nan_to_num(nan=limit_m).clamp(-limit_m, limit_m).contiguous()
    # Trilinear, because a vertex of a mesh may lie on the face between two cells.
    at_points = CellBlocks(leaf_keys).interpolate(leaf_size_m, of_cells, near.numpy(), num_threads)
    return EvidenceAt(*torch.from_numpy(at_points).unbind(1))


def uncertainty(contents: WholeMap, evidence: EvidenceAt) -> Tensor:
    """Return the standard error (N,) of the surface's position, m; NaN where there are no returns."""
    variance_m2 = 1 / evidence.information + _floor_m(contents) ** 2
    return variance_m2.sqrt().masked_fill(evidence.information <= 0, torch.nan)


def roughness(contents: WholeMap) -> float:
    """Return the roughness, from 0, where all returns lie on thin surfaces, to 1, that of real drives."""
    return min(contents.clutter_ratio / _ROUGH_CLUTTER_RATIO, 1.0)


def _floor_m(contents: WholeMap) -> float:
    cells: float = _FLOOR_CELLS + _ROUGH_FLOOR_CELLS * roughness(contents) ** 1.5
    return cells * contents.config.leaf_size_m


def confidence(contents: WholeMap, evidence: EvidenceAt) -> Tensor:
    """Return the probability (N,) that a surface is within a leaf cell's edge; 0 where there are no returns."""
    return probabilities(contents, evidence).confidence.float()


class Probabilities(NamedTuple):
    """Probabilities of a surface at N points, float64; (nearly) 0 where there are no returns."""

    confidence: Tensor  # (N,) see :func:`confidence`
    covering: Tensor  # (N,) true surface newly covered per area, up to a constant factor
    reach: Tensor  # (N,) probability of a position error within a leaf cell's edge, normally distributed


def probabilities(contents: WholeMap, evidence: EvidenceAt) -> Probabilities:
    """Evaluate the logistic regression on :func:`terms`, times :func:`own_surface`. `reach` is an upper bound of the confidence."""
    # A mesh of 80,000 vertices is one chunk: waking threads for each of forty operations takes longer than one thread.
    chunks = list(zip(*(torch.split(column, _VERTICES) for column in evidence), strict=True))
    with ThreadPool() as pool:
        found = pool.map(lambda chunk: _probabilities(contents, EvidenceAt(*chunk)), chunks)
        return Probabilities(*map(torch.cat, zip(*found, strict=True)))


def _probabilities(contents: WholeMap, evidence: EvidenceAt) -> Probabilities:
    columns = terms(contents, evidence)
    logits = torch.tensor([_CONFIDENCE, _COVERING], dtype=torch.float64, device="cpu")
    true, covering = ((columns * logit).sum(1).clamp(min=_LEAST_LOGIT).sigmoid() for logit in logits)
    reach = torch.erf(math.sqrt(0.5) / _smoothed(columns[:, 1].exp()))
    own = own_surface(evidence)
    return Probabilities((true * own).minimum(reach), covering * own, reach)


def own_surface(evidence: EvidenceAt) -> Tensor:
    """Return the probability (N,) that the returns at places belong to a surface there, not to one next to them."""
    # Noise spreads returns beyond the edges of surfaces. More data increase their number there and on the surface alike, but not
    # their share, of which few hits determine only an upper limit.
    share = evidence.information.double() / evidence.usual.double().clamp(min=1e-30)
    at_most = share * (1 + _SHARE_ERRORS / evidence.hits.double().clamp(min=0.1).sqrt())
    return 1 / (1 + (_EDGE_SHARE / at_most.clamp(min=1e-6)).pow(_EDGE_STEEPNESS))


def terms(contents: WholeMap, evidence: EvidenceAt) -> Tensor:
    """Return regressors (N, 5), float64: 1, log of the error in leaf cells, missing returns of a surface in standard
    deviations, and roughness and crowding of the map. Infinite without returns."""
    # The last two are bounded: a rougher or more crowded map than in the training data must not lose all surface.
    error_cells = evidence.information.double().rsqrt() / contents.config.leaf_size_m
    expected = CELLS_OF_SURFACE * _DETECTION_RATE * evidence.visibility.double()
    deviations = (expected - evidence.hits.double()) / (expected + 1).sqrt()
    missing = (deviations + deviations.square().add(_SMOOTH**2).sqrt()) / 2  # a smooth max(0, deviations)
    of_map = (
        math.tanh(contents.clutter_ratio / _ROUGH_CLUTTER_RATIO),
        contents.returns_per_cell / (contents.returns_per_cell + _CROWDED_RETURNS),
    )
    rough, crowded = (torch.full_like(error_cells, value) for value in of_map)
    return torch.stack([torch.ones_like(error_cells), error_cells.log(), missing, rough, crowded], 1)


def _smoothed(error_cells: Tensor) -> Tensor:
    """Return standard errors (N,) of a smooth surface, leaf cells, from `error_cells` of the returns near each place alone."""
    # For a thin plate with second differences of standard deviation b cells, and returns of information density ρ per cell, the
    # variance is 1 / (8 √(ρ / b²)). Where the returns alone are more precise, the neighbourhood adds nothing.
    density = 1 / (CELLS_OF_SURFACE * error_cells.square())
    return error_cells.minimum((_BEND_CELLS / (8 * density.sqrt())).sqrt())


# Free space


@dataclass(frozen=True)
class CellsInBox:
    """Free space and returns in the leaf cells of a box, as dense arrays."""

    corner: NDArray[np.float64]  # (3,) lower corner of the first cell, world, m
    passed: NDArray[np.uint8]  # number of scans with a ray through the cell, at most 7
    returns: NDArray[np.bool_]  # whether the cell has returns
    observed: NDArray[np.bool_]  # whether the cell is a leaf cell of the map


def dense_cells(
    contents: MapContents, lower: NDArray[np.int64], shape: tuple[int, int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return `passed`, `returns` and `observed` of the leaf cells from `lower` (3,) on, relative to the map's origin."""
    passed, returns = contents.free_space().dense(lower, shape)
    cells = lattice_of(contents.field.table.leaf_keys()) - lower
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    observed = np.zeros(shape, bool)
    observed[tuple(cells[inside].T)] = True
    return passed, returns, observed


def free_space_odds(contents: MapContents) -> NDArray[np.float64]:
    """Return the odds (8,) that a leaf cell crossed by 0 to 7 or more scans is behind rather than before a surface."""
    # Calibrated on the map's own cells that are clearly on one side of a surface: rays cross solid cells because of noise,
    # and on the way to false returns.
    keys = contents.field.table.leaf_keys()
    keys = keys[:: max(1, len(keys) // _ODDS_CELLS)]
    leaf_m = contents.config.leaf_size_m
    centres = torch.from_numpy(((lattice_of(keys) + 0.5) * leaf_m).astype(np.float32))
    distances_m = signed_distance(contents, centres).numpy()
    # At grazing incidence the field exceeds the distance, and with noisy returns falls below it; so does its gradient.
    edge = leaf_m * np.linalg.norm(gradient(contents, centres).numpy(), axis=1)
    weights = confidence(contents, evidence(contents, centres)).numpy().astype(np.float64)
    passed = contents.free_space().at(keys)

    sides = (distances_m < -edge, distances_m > edge)
    behind, before = (np.bincount(passed[side], weights[side], MOST_SCANS + 1) + 1 for side in sides)
    odds = (behind / behind.sum()) / (before / before.sum())
    # Enforce monotonicity: more crossings never make a cell less free.
    falling: NDArray[np.float64] = np.minimum.accumulate(odds)
    return falling
