# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Pieces of plane through neighbouring returns: normals, the sensor's noise, and which returns are ghosts."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import SurfelMap, cell_keys
from radarsdf.scans import Rays

# Measured on simulated and real scans; see "What the levers of the surface are worth" in BENCHMARK.md.
_CELL_M = 0.4
_NEIGHBOUR_WEIGHT = 0.7  # of a cell that shares a face; its square over an edge, its cube over a corner
_MIN_RETURNS = 12.0  # weighted, in the 27 cells of a plane
_MAX_FLATNESS = 0.5  # smallest over middle variance: more is no plane
_GHOST_MARGIN_M = 0.1  # and
_GHOST_SIGMAS = 2.0  # behind a surface: these two together keep noisy returns of the surface itself
_MIN_OPACITY = 0.5  # of a surface: share of the rays to it that end there; a hedge lets most of them through
_GHOST_SHARE = 0.5  # of the returns in a neighbourhood: ghosts are among ghosts, a noisy return is not

_MORTON_AXIS = 0x1249249249249249
_AXIS_BIAS = 1 << 20


@dataclass(frozen=True)
class BeamNoise:
    """Standard deviations of a return's position."""

    range_m: float
    """Along the beam."""
    angle_rad: float
    """Across the beam, as an angle."""


@dataclass(frozen=True)
class Surfels:
    """A plane for every occupied cell of 0.4 m, through the returns in it and the 26 round it."""

    keys: NDArray[np.uint64]
    """(C,) Morton keys of the cells, ascending."""
    cell_of_ray: NDArray[np.int64]
    """(N,) row of each return's cell."""
    counts: NDArray[np.float64]
    """(C,) returns in the cell alone."""
    support: NDArray[np.float64]
    """(C,) returns that the plane goes through, the further ones counting less."""
    centres: NDArray[np.float64]
    """(C, 3) local, m."""
    normals: NDArray[np.float64]
    """(C, 3) unit, towards the sensors."""
    variances: NDArray[np.float64]
    """(C, 3) of the returns along the principal axes, ascending: the first is across the plane, m²."""
    neighbours: list[tuple[float, NDArray[np.int64], NDArray[np.int64]]]
    """For each of the 27 offsets its weight, the cells that have such a neighbour, and these neighbours."""

    @classmethod
    def of(cls, rays: Rays) -> Surfels:
        """Planes through returns."""
        all_keys = cell_keys(np.ascontiguousarray(rays.points), _CELL_M)
        keys, cell_of_ray = np.unique(all_keys, return_inverse=True)
        neighbours = _neighbours(_lattice(keys))
        points = rays.points.astype(np.float64)
        upper = [(i, j) for i in range(3) for j in range(i, 3)]
        columns = itertools.chain(  # one at a time: all at once are a gigabyte for ten million returns
            (np.ones(len(points)),),
            points.T,
            (points[:, i] * points[:, j] for i, j in upper),
            rays.directions.T,
        )
        moments = np.stack(
            [np.bincount(cell_of_ray, column, len(keys)).astype(np.float64) for column in columns], 1
        )
        counts = moments[:, 0]
        moments = _sum_round(moments, neighbours, weighted=True)
        support = moments[:, 0]
        centres = moments[:, 1:4] / support[:, None]
        covariance = np.empty((len(keys), 3, 3))
        for column, (i, j) in enumerate(upper, start=4):
            covariance[:, i, j] = covariance[:, j, i] = (
                moments[:, column] / support - centres[:, i] * centres[:, j]
            )
        variances, axes = np.linalg.eigh(covariance)
        normals = axes[:, :, 0]
        normals = np.where(np.einsum("ni,ni->n", normals, moments[:, 10:]) > 0, -1.0, 1.0)[:, None] * normals
        return cls(
            keys,
            cell_of_ray,
            counts,
            support,
            centres,
            normals,
            np.maximum(variances, 1e-6),  # below what float32 leaves of coordinates
            neighbours,
        )

    @property
    def flat(self) -> NDArray[np.bool_]:
        """(C,) whether there are returns enough for a plane, and they lie in one."""
        return (self.support >= _MIN_RETURNS) & (self.variances[:, 0] < _MAX_FLATNESS * self.variances[:, 1])

    def noise(self, rays: Rays) -> BeamNoise:
        """The sensor's noise: squared distances to the planes, fitted by its two parts.

        At an angle of incidence θ the variance across the plane is (σ_range cosθ)² + (σ_angle range sinθ)².
        """
        flat = ((self.support >= _MIN_RETURNS) & (self.variances[:, 0] < 0.1 * self.variances[:, 1]))[
            self.cell_of_ray
        ]
        sigma2 = np.array([0.1**2, 0.01**2])
        if np.count_nonzero(flat) < 100:
            return BeamNoise(*np.sqrt(sigma2).tolist())
        cell, range_m = self.cell_of_ray[flat], rays.ranges_m[flat].astype(np.float64)
        residual2 = np.einsum("ni,ni->n", rays.points[flat] - self.centres[cell], self.normals[cell]) ** 2
        cosine2 = np.einsum("ni,ni->n", rays.directions[flat], self.normals[cell]) ** 2
        parts = np.stack([cosine2, range_m**2 * (1 - cosine2)], 1)
        for _ in range(10):  # weights of the last round's variances; what is far outside does not count
            variance = parts @ sigma2
            used = residual2 < 6 * variance
            weighted = parts[used] / variance[used, None] ** 2
            solution = np.linalg.lstsq(weighted.T @ parts[used], weighted.T @ residual2[used], rcond=None)[0]
            sigma2 = 1.05 * np.maximum(solution, [1e-4, 1e-6])  # 1.05: a normal distribution beyond the limit
        return BeamNoise(*np.sqrt(sigma2).tolist())

    def ghosts(self, rays: Rays, num_threads: int = 0) -> NDArray[np.bool_]:
        """(N,) whether a return is among those behind a surface that their own rays passed through.

        A radar sees by way of a mirror, and places what it sees straight on, behind the mirror. Such returns agree
        with each other from every position, so that neither their number nor what other rays passed betrays them.
        """
        noise = self.noise(rays)
        table = np.concatenate([self.centres, self.normals, np.sqrt(self.variances[:, :1])], 1)
        table = table.astype(np.float32)

        def crossed(cells: NDArray[np.int64]) -> NDArray[np.int32]:
            surfels = SurfelMap(self.keys[cells], np.ascontiguousarray(table[cells]), _CELL_M)
            return surfels.first_crossings(
                np.ascontiguousarray(rays.points),
                np.ascontiguousarray(rays.directions),
                np.ascontiguousarray(rays.ranges_m),
                noise.range_m,
                noise.angle_rad,
                _GHOST_MARGIN_M,
                _GHOST_SIGMAS,
                num_threads,
            )

        cells = np.flatnonzero(self.flat)
        first = crossed(cells)
        passed = np.zeros(len(self.keys))
        passed[cells] = np.bincount(first[first >= 0], minlength=len(cells))
        passed = _sum_round(passed[:, None], self.neighbours, weighted=True)[:, 0]
        opacity = self.support / (self.support + passed)
        behind = crossed(cells[opacity[cells] > _MIN_OPACITY]) >= 0
        behind_in_cell = np.bincount(self.cell_of_ray, behind, len(self.keys))
        sums = _sum_round(np.stack([behind_in_cell, self.counts], 1), self.neighbours, weighted=False)
        result: NDArray[np.bool_] = (sums[:, 0] > _GHOST_SHARE * sums[:, 1])[self.cell_of_ray]
        return result


def support_of(
    points: NDArray[np.float32], leaf_keys: NDArray[np.uint64], leaf_size_m: float
) -> NDArray[np.uint16]:
    """(C,) returns in each leaf cell and the 26 round it; 65535 stands for all that are more."""
    keys, counts = np.unique(cell_keys(np.ascontiguousarray(points), leaf_size_m), return_counts=True)
    own = np.zeros(len(leaf_keys))
    row = np.minimum(np.searchsorted(leaf_keys, keys), len(leaf_keys) - 1)
    known = leaf_keys[row] == keys
    own[row[known]] = counts[known]
    sums = _sum_round(own[:, None], _neighbours(_lattice(leaf_keys)), weighted=False)[:, 0]
    return np.minimum(sums, np.iinfo(np.uint16).max).astype(np.uint16)


def _lattice(keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Lattice coordinates (C, 3) of Morton keys: the inverse of ``csrc/morton.hpp``."""
    coordinates = []
    for axis in range(3):
        v = (keys >> np.uint64(axis)) & np.uint64(_MORTON_AXIS)
        for shift, mask in (
            (2, 0x10C30C30C30C30C3),
            (4, 0x100F00F00F00F00F),
            (8, 0x001F0000FF0000FF),
            (16, 0x001F00000000FFFF),
            (32, 0x1FFFFF),
        ):
            v = (v | (v >> np.uint64(shift))) & np.uint64(mask)
        coordinates.append(v.astype(np.int64) - _AXIS_BIAS)
    return np.stack(coordinates, 1)


def _neighbours(cells: NDArray[np.int64]) -> list[tuple[float, NDArray[np.int64], NDArray[np.int64]]]:
    numbers = (cells + _AXIS_BIAS) @ np.array([1 << 42, 1 << 21, 1])
    order = np.argsort(numbers)
    ascending = numbers[order]
    found = []
    for dx, dy, dz in np.ndindex(3, 3, 3):
        wanted = numbers + ((dx - 1) * (1 << 42) + (dy - 1) * (1 << 21) + (dz - 1))
        at = np.minimum(np.searchsorted(ascending, wanted), len(order) - 1)
        there = ascending[at] == wanted
        weight = _NEIGHBOUR_WEIGHT ** (abs(dx - 1) + abs(dy - 1) + abs(dz - 1))
        found.append((weight, np.flatnonzero(there), order[at[there]]))
    return found


def _sum_round(
    values: NDArray[np.float64],
    neighbours: list[tuple[float, NDArray[np.int64], NDArray[np.int64]]],
    *,
    weighted: bool,
) -> NDArray[np.float64]:
    """Sums (C, K) over each cell and the 26 round it."""
    sums = np.zeros_like(values)
    for weight, cells, others in neighbours:
        sums[cells] += (weight if weighted else 1.0) * values[others]
    return sums
