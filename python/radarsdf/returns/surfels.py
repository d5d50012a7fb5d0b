# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Surfels: planes through the returns of neighbouring cells."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import principal_axes
from radarsdf.returns.cells import ReturnCells
from radarsdf.returns.rays import Rays

# Measured on simulated and real scans; see docs/levers.md.
LEAVES_PER_SURFEL = 2  # leaf cells along an edge of a surfel's cell: 0.4 m
NEIGHBOUR_WEIGHT = 0.7  # of a cell that shares a face. An edge counts its square, a corner its cube.
MAX_FLATNESS = 0.5  # smallest variance over the middle one. More is not a plane.
_MIN_RETURNS = 12.0  # weighted, in the 27 cells of a plane


@dataclass(frozen=True)
class Surfels:
    """Cells twice as large as leaf cells, and the planes through their returns.

    A cell has a plane if it and the 26 cells round it hold enough returns.
    """

    cell_size_m: float
    """Edge of a cell, m."""
    cells: ReturnCells
    """The occupied cells."""
    support: NDArray[np.float64]
    """(C,) returns in a cell and the 26 round it, weighted: far cells count less."""
    cell_of_plane: NDArray[np.int64]
    """(P,) row of each plane's cell, ascending."""
    centres: NDArray[np.float64]
    """(P, 3) local, m."""
    normals: NDArray[np.float64]
    """(P, 3) unit vectors, towards the sensors."""
    variances: NDArray[np.float64]
    """(P, 3) variances of the returns along the principal axes, ascending, m². The first is across the plane."""

    @classmethod
    def of(cls, rays: Rays, leaf_size_m: float, num_threads: int = 0) -> Surfels:
        """Planes through the returns of `rays`."""
        cell_size_m = LEAVES_PER_SURFEL * leaf_size_m
        cells = ReturnCells.of(rays, cell_size_m, num_threads)
        counts = cells.moments[:, :1].copy()
        support = cells.blocks.sum_round(cells.keys, counts, NEIGHBOUR_WEIGHT, num_threads)[:, 0]
        # Many cells have hardly a return. Planes for all of them would be most of the work and of the memory.
        cell_of_plane = np.flatnonzero(support >= _MIN_RETURNS)
        moments = cells.blocks.sum_round(
            cells.keys[cell_of_plane], cells.moments, NEIGHBOUR_WEIGHT, num_threads
        )
        means = moments[:, 1:10] / moments[:, :1]
        centres = means[:, :3].copy()
        upper = [(i, j) for i in range(3) for j in range(i, 3)]
        covariance = np.empty((len(means), 3, 3))  # all nine numbers are written below
        for mean, (i, j) in zip(means[:, 3:].T, upper, strict=True):
            covariance[:, i, j] = covariance[:, j, i] = mean - centres[:, i] * centres[:, j]
        variances, axes = principal_axes(covariance, num_threads)
        normals = axes[:, :, 0]
        normals = np.where(np.einsum("ni,ni->n", normals, moments[:, 10:]) > 0, -1.0, 1.0)[:, None] * normals
        return cls(
            cell_size_m=cell_size_m,
            cells=cells,
            support=support,
            cell_of_plane=cell_of_plane,
            centres=centres,
            normals=normals,
            variances=np.maximum(
                variances, (0.0025 * cell_size_m) ** 2
            ),  # float32 coordinates resolve no less
        )

    def is_flat(self, max_flatness: float = MAX_FLATNESS) -> NDArray[np.bool_]:
        """(P,) whether each plane is thin beside its extent."""
        flat: NDArray[np.bool_] = self.variances[:, 0] < max_flatness * self.variances[:, 1]
        return flat

    def plane_of_cell(self, planes: NDArray[np.int64]) -> NDArray[np.int32]:
        """(C,) row of each cell's plane, where it is one of `planes`; otherwise -1."""
        plane_of_cell = np.full(len(self.cells.keys), -1, np.int32)
        plane_of_cell[self.cell_of_plane[planes]] = planes
        return plane_of_cell

    def flat_plane_of(self, cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Row of the plane of each cell (N,); -1 where there is none, or none that is flat."""
        return self.plane_of_cell(np.flatnonzero(self.is_flat()))[cells]

    def onto_planes(self, rays: Rays, chunk: int = 1 << 17) -> Rays:
        """The rays, with their returns moved onto the plane of their cell where that is flat.

        A return moves along the plane's normal. Dozens of returns know the plane far better than one return knows its
        own distance from it. Along the plane nothing changes.
        """
        plane = self.flat_plane_of(self.cells.cell_of_ray)
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
