# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Makes a grid of a map: occupied where a surface probably is, free only where rays passed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import MAX_POSITION_M, check_box, positive
from radarsdf.grids.grid import FREE, OCCUPIED, UNKNOWN, Grid
from radarsdf.map import queries
from radarsdf.map.contents import MapContents
from radarsdf.returns.free_space import MOST_SCANS
from radarsdf.returns.sums import lattice_of

if TYPE_CHECKING:
    from radarsdf.map.map import Map

_MAX_VOXELS = 2**28  # 15 bytes each
# Half of what a cube covers across a plane through its centre, in edges: the mean over all directions of the plane.
_HALF_WIDTH = 0.75
_SIGMAS_95 = 1.96
_ODDS_CELLS = 50_000  # of a map are asked, evenly spread: how often rays pass what is solid


@dataclass(frozen=True)
class CellsInBox:
    """What rays and returns tell of the leaf cells in a box, arrays of leaf cells."""

    corner: NDArray[np.float64]
    """(3,) lower corner of the first cell, world, m."""
    passed: NDArray[np.uint8]
    """Number of scans with a ray through the cell, up to 7."""
    returns: NDArray[np.bool_]
    """Whether there are returns in it."""
    observed: NDArray[np.bool_]
    """Whether it is a leaf cell of the map."""


def dense_cells(
    contents: MapContents, lower: NDArray[np.int64], shape: tuple[int, int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]:
    """Passed, returns and observed of leaf cells from `lower` on, counted from the origin of a map."""
    passed, returns = contents.passages.dense(lower, shape)
    cells = lattice_of(contents.field.table.leaf_keys()) - lower
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    observed = np.zeros(shape, bool)
    observed[tuple(cells[inside].T)] = True
    return passed, returns, observed


def passage_odds(contents: MapContents) -> NDArray[np.float64]:
    """(8,) how much more often so many scans pass a leaf cell behind a surface than one before it.

    By the map itself: cells of which the returns say on which side of a surface they are. Rays pass solid cells by their
    noise, and on the way to false returns.
    """
    cells = lattice_of(contents.field.table.leaf_keys())
    cells = cells[:: max(1, len(cells) // _ODDS_CELLS)]
    leaf_m = contents.config.leaf_size_m
    centres = torch.from_numpy(((cells + 0.5) * leaf_m).astype(np.float32))
    distances_m = queries.signed_distance(contents, centres).numpy()
    # Along flat rays the field is longer than the distance, and where returns are noisy it is shorter; so is its gradient.
    edge = leaf_m * np.linalg.norm(queries.gradient(contents, centres).numpy(), axis=1)
    confidence = queries.confidence(contents, queries.evidence(contents, centres)).numpy()
    passed = contents.passages.at(cells)

    def shares(side: NDArray[np.bool_]) -> NDArray[np.float64]:
        counts = np.bincount(passed[side], confidence[side].astype(np.float64), MOST_SCANS + 1) + 1
        found: NDArray[np.float64] = counts / counts.sum()
        return found

    # More scans that passed never make a cell less free: chance is smoothed away from the end on.
    odds = shares(distances_m < -edge) / shares(distances_m > edge)
    falling: NDArray[np.float64] = np.minimum.accumulate(odds)
    return falling


def check_passages(radar_map: Map, name: str) -> None:
    """Raises a ValueError if a map does not keep what rays passed. `name`: by which the message calls it."""
    if not radar_map.config.returns.passages:
        msg = f"{name} does not keep what rays passed: fit it with returns.passages, which FitConfig() has and quick() has not"
        raise ValueError(msg)


def plane_at(radar_map: Map, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The surface round positions (N, 3), world, m, as planes: signed distances (N,), m, and normals (N, 3), towards free space.

    Along flat rays the field is longer than the distance, and its gradient is as much longer than 1.
    """
    sdf, gradient = (values.double().numpy() for values in radar_map.plane_at(torch.from_numpy(x)))
    length = np.linalg.norm(gradient, axis=1)
    return sdf / np.maximum(length, 1), gradient / length[:, None].clip(1e-9)


def make_grid(
    radar_map: Map,
    box: ArrayLike,
    voxel_size: float,
    occupied_from: float,
    free_to: float,
) -> Grid:
    """See :meth:`Map.grid`."""
    check_passages(radar_map, "this map")
    corners = check_box(box)
    size = positive(voxel_size, "voxel_size")
    if not 0 < free_to < occupied_from < 1:
        msg = f"free_to and occupied_from must be ascending and in (0, 1), not {free_to} and {occupied_from}"
        raise ValueError(msg)
    # A voxel is at most as large as a leaf cell, or is made of parts that are.
    parts = max(1, math.ceil(size / radar_map.config.leaf_size_m - 1e-6)) if size <= MAX_POSITION_M else 1
    # Whole multiples of the voxel, as octrees have them; 1e-6 voxels are rounding.
    first = np.floor(corners[0] / size + 1e-6)
    counts = np.maximum(1, np.ceil(corners[1] / size - 1e-6) - first)
    if np.prod(counts) * parts**3 > _MAX_VOXELS:
        msg = f"the box has {np.prod(counts) * parts**3:.3g} voxels: at most {_MAX_VOXELS} fit; take a smaller one, or larger voxels"
        raise MemoryError(msg)
    shape = tuple((counts.astype(np.int64) * parts).tolist())
    fine = _fine_grid(radar_map, first * size, size / parts, shape, occupied_from, free_to)
    return fine if parts == 1 else _coarser(fine, parts)


def _fine_grid(
    radar_map: Map, lower: NDArray[np.float64], size: float, shape: tuple[int, ...],
    occupied_from: float, free_to: float,
) -> Grid:  # fmt: skip
    leaf_m = radar_map.config.leaf_size_m
    upper = lower + np.array(shape) * size
    cells = radar_map.cells_round(lower - leaf_m, upper + leaf_m)
    known = (cells.passed > 0) | cells.returns
    centres = [lower[axis] + (np.arange(shape[axis]) + 0.5) * size for axis in range(3)]
    places = np.ix_(
        *(np.floor((x - cells.corner[axis]) / leaf_m).astype(np.int64) for axis, x in enumerate(centres))
    )
    passed, observed = cells.passed[places], cells.observed[places]
    # An unseen surface lies where what rays passed ends. So next to the unknown, nothing is free.
    enclosed = _eroded(known)[places] & ~cells.returns[places]
    odds = radar_map.passage_odds
    probability = np.where(passed > 0, (odds / (1 + odds)).astype(np.float32)[passed], np.float32(np.nan))
    free = enclosed & (passed > 0) & (probability <= free_to)
    distance_m = np.full(shape, np.nan, np.float32)
    occupied = np.zeros(shape, bool)
    rows = np.nonzero(observed)
    position_error_m = 0.0
    if len(rows[0]):
        x = np.stack([centres[axis][rows[axis]] for axis in range(3)], 1)
        surface = _Planes.of(radar_map, x)
        distance_m[rows] = surface.distance_m
        # Where the map has it: how far it may be off is said by `position_error_m`, or rough surfaces would be nowhere.
        of_surface = np.where(_crossed(distance_m, _HALF_WIDTH * size)[rows], surface.confidence, 0)
        is_there = of_surface >= occupied_from
        occupied[rows] = is_there
        # Behind a surface, rays passed by mistake: nothing is free there.
        free[rows] &= surface.before(_HALF_WIDTH * size) <= free_to
        free &= surface.touch(np.stack(rows, 1), shape, size, max(1, round(leaf_m / size))) <= free_to
        of_rays = np.where(free[rows], probability[rows], 0)
        probability[rows] = 1 - (1 - of_surface) * (1 - of_rays)
        if is_there.any():
            errors_m = np.nan_to_num(radar_map.uncertainty(x[is_there]), nan=0)
            position_error_m = _SIGMAS_95 * float(np.quantile(errors_m, 0.95))
    state = np.full(shape, UNKNOWN, np.int8)
    state[free], state[occupied] = FREE, OCCUPIED
    return Grid(lower, size, state, probability, distance_m, position_error_m)


@dataclass(frozen=True)
class _Planes:
    """The surface as the map has it round N positions: a plane each, of which the distance is known with an error."""

    distance_m: NDArray[np.float32]
    """(N,) signed distance of the position from the surface, m. NaN: unknown."""
    normals: NDArray[np.float64]
    """(N, 3) unit vectors to where distances grow."""
    sigma_m: NDArray[np.float64]
    """(N,) standard error of the distance, m."""
    confidence: NDArray[np.float64]
    """(N,) probability that there is a surface."""

    @classmethod
    def of(cls, radar_map: Map, x: NDArray[np.float64]) -> _Planes:
        """The planes at positions (N, 3), world, m."""
        distance_m, normals = plane_at(radar_map, x)
        unknown = np.isnan(distance_m)
        sigma_m = np.nan_to_num(radar_map.uncertainty(x), nan=radar_map.config.leaf_size_m).astype(np.float64)
        return cls(
            distance_m.astype(np.float32),
            normals,
            sigma_m,
            np.where(unknown, 0, radar_map.confidence(x)).astype(np.float64),
        )

    def before(self, limit_m: float) -> NDArray[np.float64]:
        """(N,) probability that the surface is there, and nearer than a limit or that the position is behind it."""
        return np.nan_to_num(self.confidence * _below((limit_m - self.distance_m) / self.sigma_m))

    def touch(
        self, voxels: NDArray[np.int64], shape: tuple[int, ...], size: float, step: int
    ) -> NDArray[np.float32]:
        """Largest probability, in each voxel of a grid, that one of these planes, from `step` voxels away, is in it.

        A cell without a return may still be cut by the surface of its neighbour.
        """
        found = np.zeros(shape, np.float32)
        rows = np.flatnonzero(self.confidence > 0)
        for offset in np.ndindex(3, 3, 3):
            moved = (np.array(offset) - 1) * step
            targets = voxels[rows] + moved
            inside = ((targets >= 0) & (targets < shape)).all(axis=1)
            near, at = rows[inside], tuple(targets[inside].T)
            distance_m = self.distance_m[near] + np.einsum("ni,i->n", self.normals[near], moved * size)
            half_m = 0.5 * size * np.abs(self.normals[near]).sum(axis=1)
            sigma_m = self.sigma_m[near]
            share = _below((half_m - distance_m) / sigma_m) - _below((-half_m - distance_m) / sigma_m)
            found[at] = np.maximum(found[at], (self.confidence[near] * share).astype(np.float32))
        return found


def _below(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of a standard normal distribution below t."""
    share: NDArray[np.float64] = torch.special.ndtr(torch.from_numpy(np.asarray(t, np.float64))).numpy()
    return share


def _crossed(distance_m: NDArray[np.float32], reach_m: float) -> NDArray[np.bool_]:
    """Voxels next to one on the other side of a surface, if the surface is in reach or nearer to them than to that one.

    What is only near zero may be the end of what the field knows.
    """
    away_m = np.abs(distance_m)
    before, behind = distance_m > 0, distance_m <= 0  # NaN is neither
    found = np.zeros(distance_m.shape, bool)
    for axis in range(3):
        for here, other in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            a, b = ((*(slice(None),) * axis, part) for part in (here, other))
            crossed = (before[a] & behind[b]) | (behind[a] & before[b])
            found[a] |= crossed & ((away_m[a] <= reach_m) | (away_m[a] <= away_m[b]))
    return found


def _eroded(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells that are known and whose 26 neighbours are. Those on the border of the array are not."""
    found = known.copy()
    for axis in range(3):
        along = np.moveaxis(found, axis, 0)
        both = along[1:-1] & along[2:] & along[:-2]
        along[0], along[-1] = False, False
        along[1:-1] = both
    return found


def _coarser(fine: Grid, parts: int) -> Grid:
    """Voxels of so many of the grid's an edge: occupied if one is, free if all are."""
    shape = [n // parts for n in fine.shape]
    split = [n for length in shape for n in (length, parts)]

    def blocks(values: NDArray) -> NDArray:  # type: ignore[type-arg]
        return values.reshape(split).transpose(0, 2, 4, 1, 3, 5).reshape(*shape, parts**3)

    state = blocks(fine.state)
    coarse = np.full(shape, UNKNOWN, np.int8)
    coarse[(state == FREE).all(axis=-1)] = FREE
    coarse[(state == OCCUPIED).any(axis=-1)] = OCCUPIED
    middle = (slice(parts // 2, None, parts),) * 3
    return Grid(
        fine.origin,
        fine.voxel_size * parts,
        coarse,
        np.fmax.reduce(blocks(fine.probability), axis=-1),
        np.ascontiguousarray(fine.distance_m[middle]),
        fine.position_error_m,
    )
