# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A field that averages what the rays say of each vertex, as truncated signed distances do (Curless and Levoy, 1996).

It needs no training, and is where training can start from instead of from noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from radarsdf._core import CellSet
from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import Surfels, cells_of


@dataclass(frozen=True)
class CellRays:
    """One ray for each cell that holds returns: their mean (measured: as good as all of them, which are 2 to 3 times as many)."""

    keys: NDArray[np.uint64]
    """(M,) Morton keys of the cells, ascending."""
    first: NDArray[np.int64]
    """(M,) the first return in each."""
    points: NDArray[np.float32]
    """(M, 3) mean of the returns in each, local, m."""
    directions: NDArray[np.float32]
    """(M, 3) of their rays, unit."""
    counts: NDArray[np.float32]
    """(M,) how many they are."""

    @classmethod
    def of(cls, rays: Rays, cell_size_m: float, num_threads: int = 0) -> CellRays:
        """The rays of cells of this size."""
        keys, _, rows, moments = cells_of(rays, cell_size_m, num_threads)
        first = np.empty(len(keys), np.int64)
        first[rows[::-1]] = np.arange(len(rows) - 1, -1, -1)  # of several, the last one written counts
        # Of rays that cancel each other, the first.
        lengths = np.linalg.norm(moments[:, 10:], axis=1)[:, None]
        directions = np.where(
            lengths > 1e-3, moments[:, 10:] / np.maximum(lengths, 1e-3), rays.directions[first]
        )
        return cls(
            keys=keys,
            first=first,
            points=(moments[:, 1:4] / moments[:, :1]).astype(np.float32),
            directions=directions.astype(np.float32),
            counts=moments[:, 0].astype(np.float32),
        )

    def select(self, part: NDArray[np.bool_]) -> CellRays:
        """Some of them."""
        return CellRays(
            self.keys[part], self.first[part], self.points[part], self.directions[part], self.counts[part]
        )

    def leaf_keys(self, config: FitConfig, num_threads: int = 0) -> NDArray[np.uint64]:
        """Leaf cells that the rays go through within ``config.near_band_m`` of their ends: Morton keys, ascending."""
        cells = CellSet(config.leaf_size_m)
        cells.insert_rays(self.points, self.directions, config.near_band_m, num_threads)
        return cells.sorted_keys(num_threads)


def start_from_average(
    field: Field, rays: CellRays, surfels: Surfels, config: FitConfig, num_threads: int
) -> None:
    """Makes the field the average over rays, interpolated between the vertices of an octree's leaf cells.

    A ray counts at the vertices of the cells that it goes through, up to `truncation_m` before and behind its end, with
    the distance to the plane through the returns round its end; where they make no plane, to the plane across the ray.
    """
    plane = surfels.flat_plane_of(surfels.cell_of_ray[rays.first])
    normals = np.where(
        plane[:, None] >= 0,
        surfels.normals[plane].astype(np.float32) if len(surfels.normals) else 0,
        -rays.directions,
    )
    distances_m = field.cells.table.average_rays(
        rays.points,
        rays.directions,
        np.ascontiguousarray(normals, np.float32),
        rays.counts,
        config.truncation_m,
        num_threads,
    )
    with torch.no_grad():
        field.cells.features[:, 0] = torch.from_numpy(distances_m) / config.sigma_m
    field.sdf_network.start_as_input(0)
