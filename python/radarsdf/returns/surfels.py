# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Pieces of plane through neighbouring returns: normals, the sensor's noise, and which returns are ghosts."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, CellSet, SurfelMap, cell_keys, principal_axes, sum_moments
from radarsdf.returns.rays import Rays

# Measured on simulated and real scans; see "What the levers of the surface are worth" in BENCHMARK.md.
SURFEL_LEAVES = 2  # leaf cells along an edge of a surfel's: 0.4 m
_NEIGHBOUR_WEIGHT = 0.7  # of a cell that shares a face; its square over an edge, its cube over a corner
_MIN_RETURNS = 12.0  # weighted, in the 27 cells of a plane
_MAX_FLATNESS = 0.5  # smallest over middle variance: more is no plane
_NOISE_RETURNS = 1_000_000  # tell the noise as well as more of them do
_NOISE_RETURNS_TRIED = 20_000  # to 2 %, where time counts
_GHOST_MARGIN = 0.25  # surfel cells, and
_GHOST_SIGMAS = 2.0  # behind a surface: these two together keep noisy returns of the surface itself
_MIN_OPACITY = 0.5  # of a surface: share of the rays to it that end there; a hedge lets most of them through
_GHOST_SHARE = 0.5  # of the returns in a neighbourhood: ghosts are among ghosts, a noisy return is not


@dataclass(frozen=True)
class BeamNoise:
    """Standard deviations of a return's position."""

    range_m: float
    """Along the beam."""
    angle_rad: float
    """Across the beam, as an angle."""


@dataclass(frozen=True)
class Surfels:
    """Cells twice as large as leaf cells, and a plane for each that has returns enough in it and the 26 cells round it."""

    cell_size_m: float
    keys: NDArray[np.uint64]
    """(C,) Morton keys of the occupied cells, ascending."""
    cells: CellBlocks
    """From these keys to their rows."""
    cell_of_ray: NDArray[np.int32]
    """(N,) row of each return's cell."""
    counts: NDArray[np.float64]
    """(C,) returns in the cell alone."""
    support: NDArray[np.float64]
    """(C,) returns in the cell and those round it, the further ones counting less."""
    cell_of_plane: NDArray[np.int64]
    """(P,) row of each plane's cell, ascending."""
    centres: NDArray[np.float64]
    """(P, 3) local, m."""
    normals: NDArray[np.float64]
    """(P, 3) unit, towards the sensors."""
    variances: NDArray[np.float64]
    """(P, 3) of the returns along the principal axes, ascending: the first is across the plane, m²."""

    @classmethod
    def of(cls, rays: Rays, leaf_size_m: float, num_threads: int = 0) -> Surfels:
        """Planes through returns."""
        cell_size_m = SURFEL_LEAVES * leaf_size_m
        keys, cells, cell_of_ray, moments = cells_of(rays, cell_size_m, num_threads)
        counts = moments[:, :1].copy()
        support = cells.sum_round(keys, counts, _NEIGHBOUR_WEIGHT, num_threads)[:, 0]
        # Many cells have hardly a return: their planes would be most of the work and of the memory.
        cell_of_plane = np.flatnonzero(support >= _MIN_RETURNS)
        moments = cells.sum_round(keys[cell_of_plane], moments, _NEIGHBOUR_WEIGHT, num_threads)
        means = moments[:, 1:10] / moments[:, :1]
        centres = means[:, :3].copy()
        upper = [(i, j) for i in range(3) for j in range(i, 3)]
        covariance = np.empty((len(means), 3, 3))
        for mean, (i, j) in zip(means[:, 3:].T, upper, strict=True):
            covariance[:, i, j] = covariance[:, j, i] = mean - centres[:, i] * centres[:, j]
        variances, axes = principal_axes(covariance, num_threads)
        normals = axes[:, :, 0]
        normals = np.where(np.einsum("ni,ni->n", normals, moments[:, 10:]) > 0, -1.0, 1.0)[:, None] * normals
        return cls(
            cell_size_m,
            keys,
            cells,
            cell_of_ray,
            counts[:, 0],
            support,
            cell_of_plane,
            centres,
            normals,
            np.maximum(variances, (0.0025 * cell_size_m) ** 2),  # below what float32 leaves of coordinates
        )

    def flat_plane_of(self, cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Row of the plane of each cell (N,), -1 where it has none, or none that is flat."""
        flat = np.flatnonzero(self._is_flat(_MAX_FLATNESS))
        return self._plane_of_cell(flat)[cells]

    def _is_flat(self, flatness: float) -> NDArray[np.bool_]:
        result: NDArray[np.bool_] = self.variances[:, 0] < flatness * self.variances[:, 1]
        return result

    def _plane_of_cell(self, planes: NDArray[np.int64]) -> NDArray[np.int32]:
        plane_of_cell = np.full(len(self.keys), -1, np.int32)
        plane_of_cell[self.cell_of_plane[planes]] = planes
        return plane_of_cell

    def onto_planes(self, rays: Rays, chunk: int = 1 << 17) -> Rays:
        """The rays, their returns moved straight onto the plane of their cell where that is flat.

        Across a surface a plane of dozens of returns is known far better than each of them; along it nothing changes.
        """
        plane = self.flat_plane_of(self.cell_of_ray)
        points, directions, ranges_m = rays.points.copy(), rays.directions.copy(), rays.ranges_m.copy()
        moved = np.flatnonzero(plane >= 0)
        for first in range(0, len(moved), chunk):
            row = moved[first : first + chunk]
            point, normal = rays.points[row].astype(np.float64), self.normals[plane[row]]
            offset_m = np.einsum("ni,ni->n", point - self.centres[plane[row]], normal)[:, None] * normal
            ray = rays.directions[row].astype(np.float64) * rays.ranges_m[row, None] - offset_m
            range_m = np.maximum(np.linalg.norm(ray, axis=1), 1e-6)
            points[row] = point - offset_m
            directions[row] = ray / range_m[:, None]
            ranges_m[row] = range_m
        return dataclasses.replace(rays, points=points, directions=directions, ranges_m=ranges_m)

    def noise(self, rays: Rays, cell_of_ray: NDArray[np.int32] | None = None) -> BeamNoise:
        """The sensor's noise: squared distances to the planes, fitted by its two parts.

        Of other rays than those that made the planes, `cell_of_ray` (N,) are the cells' rows.

        At an angle of incidence θ the variance across the plane is (σ_range cosθ)² + (σ_angle range sinθ)².
        """
        flat = np.flatnonzero(self._is_flat(0.1))
        plane = self._plane_of_cell(flat)[self.cell_of_ray if cell_of_ray is None else cell_of_ray]
        used_rays = np.flatnonzero(plane >= 0)
        most = _NOISE_RETURNS if cell_of_ray is None else _NOISE_RETURNS_TRIED
        used_rays = used_rays[:: -(-len(used_rays) // most) or 1]
        sigma2 = np.array([(0.25 * self.cell_size_m) ** 2, 0.01**2])
        if len(used_rays) < 100:
            return BeamNoise(*np.sqrt(sigma2).tolist())
        plane, range_m = plane[used_rays], rays.ranges_m[used_rays].astype(np.float64)
        offset_m = rays.points[used_rays] - self.centres[plane]
        normals = self.normals[plane]
        residual2 = np.einsum("ni,ni->n", offset_m, normals) ** 2
        cosine2 = np.einsum("ni,ni->n", rays.directions[used_rays], normals) ** 2
        least = [(0.025 * self.cell_size_m) ** 2, 1e-6]
        parts = np.stack([cosine2, range_m**2 * (1 - cosine2)], 1)
        for _ in range(10):  # weights of the last round's variances; what is far outside does not count
            variance = parts @ sigma2
            used = residual2 < 6 * variance
            kept = parts[used]
            weighted = kept / variance[used, None] ** 2
            solution = np.linalg.lstsq(weighted.T @ kept, weighted.T @ residual2[used], rcond=None)[0]
            sigma2 = 1.05 * np.maximum(solution, least)  # 1.05: a normal distribution beyond the limit
        return BeamNoise(*np.sqrt(sigma2).tolist())

    def ghosts(
        self,
        rays: Rays,
        num_threads: int = 0,
        *,
        tried: NDArray[np.int64] | None = None,
        counts: NDArray[np.float32] | None = None,
    ) -> NDArray[np.bool_]:
        """(N,) whether a return is among those behind a surface that their own rays passed through.

        A radar sees by way of a mirror, and places what it sees straight on, behind the mirror. Such returns agree
        with each other from every position, so that neither their number nor what other rays passed betrays them.

        For less work, only the rays `tried` (M,) are followed, each of which stands for so many as `counts` (M,) says.
        """
        cell_of_ray, weights, returns = self.cell_of_ray, None, self.counts
        if tried is not None:
            rays, cell_of_ray, weights = rays.select(tried), cell_of_ray[tried], counts
            returns = np.bincount(cell_of_ray, weights, len(self.keys)).astype(np.float64)
        noise = self.noise(rays, None if tried is None else cell_of_ray)
        table = np.concatenate([self.centres, self.normals, np.sqrt(self.variances[:, :1])], 1)
        table = table.astype(np.float32)

        def crossed(planes: NDArray[np.int64], rays: Rays) -> NDArray[np.int32]:
            surfels = SurfelMap(self.keys[self.cell_of_plane[planes]], table[planes], self.cell_size_m)
            return surfels.first_crossings(
                np.ascontiguousarray(rays.points),
                np.ascontiguousarray(rays.directions),
                np.ascontiguousarray(rays.ranges_m),
                noise.range_m,
                noise.angle_rad,
                _GHOST_MARGIN * self.cell_size_m,
                _GHOST_SIGMAS,
                num_threads,
            )

        def count(rows: NDArray[np.int32], of: NDArray[np.bool_], size: int) -> NDArray[np.float64]:
            counted = np.bincount(rows[of], None if weights is None else weights[of], size)
            return counted.astype(np.float64)

        flat = np.flatnonzero(self._is_flat(_MAX_FLATNESS))
        first = crossed(flat, rays)
        passed = np.zeros((len(self.keys), 1))
        passed[self.cell_of_plane[flat], 0] = count(first, first >= 0, len(flat))
        cells = self.cell_of_plane[flat]
        support = self.support[cells]
        passed_round = self.cells.sum_round(self.keys[cells], passed, _NEIGHBOUR_WEIGHT, num_threads)[:, 0]
        opaque = support / (support + passed_round) > _MIN_OPACITY
        # Few rays cross a surface at all, and fewer one that is not opaque: those alone may yet cross another.
        behind = first >= 0
        through = np.flatnonzero(behind)[~opaque[first[behind]]]
        behind[through] = crossed(flat[opaque], rays.select(through)) >= 0
        behind_in_cell = count(cell_of_ray, behind, len(self.keys))
        sums = self.cells.sum_round(self.keys, np.stack([behind_in_cell, returns], 1), 1.0, num_threads)
        result: NDArray[np.bool_] = (sums[:, 0] > _GHOST_SHARE * sums[:, 1])[self.cell_of_ray]
        return result


def cells_of(
    rays: Rays, cell_size_m: float, num_threads: int = 0
) -> tuple[NDArray[np.uint64], CellBlocks, NDArray[np.int32], NDArray[np.float64]]:
    """Cells that hold returns: keys (C,), ascending; from these to their rows; each return's row (N,); ``sum_moments`` (C, 13)."""
    points = np.ascontiguousarray(rays.points)
    occupied = CellSet(cell_size_m)
    occupied.insert(points, num_threads)
    keys = occupied.sorted_keys(num_threads)
    del occupied
    cells = CellBlocks(keys)
    rows = cells.rows(cell_keys(points, cell_size_m, num_threads), num_threads)
    directions = np.ascontiguousarray(rays.directions)
    return keys, cells, rows, sum_moments(points, directions, rows, len(keys), num_threads)


def support_of(
    points: NDArray[np.float32], leaf_keys: NDArray[np.uint64], leaf_size_m: float, num_threads: int = 0
) -> NDArray[np.uint16]:
    """(C,) returns in each leaf cell and the 26 round it; 65535 stands for all that are more."""
    return support_of_cells(
        cell_keys(np.ascontiguousarray(points), leaf_size_m, num_threads), None, leaf_keys, num_threads
    )


def support_of_cells(
    keys: NDArray[np.uint64],
    counts: NDArray[np.float32] | None,
    leaf_keys: NDArray[np.uint64],
    num_threads: int = 0,
) -> NDArray[np.uint16]:
    """:func:`support_of` for `counts` (M,) returns in leaf cells with these `keys` (M,); one in each without `counts`."""
    cells = CellBlocks(leaf_keys)
    rows = cells.rows(keys, num_threads)
    inside = rows >= 0
    returns = np.bincount(rows[inside], None if counts is None else counts[inside], len(leaf_keys))
    sums = cells.sum_round(leaf_keys, returns.astype(np.float64)[:, None], 1.0, num_threads)[:, 0]
    return np.minimum(sums, np.iinfo(np.uint16).max).astype(np.uint16)
