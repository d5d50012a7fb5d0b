# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A field that averages what the rays say of each vertex, as truncated signed distances do (Curless and Levoy, 1996).

It needs no training, and is where training can start from instead of from noise.
"""

from __future__ import annotations

import numpy as np
import torch

from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.surfels import Surfels


def start_from_average(
    field: Field, rays: MeanRays, surfels: Surfels, config: FitConfig, num_threads: int
) -> None:
    """Makes the field the average over rays, interpolated between the vertices of an octree's leaf cells.

    A ray counts at the vertices of the cells that it goes through, up to `truncation_m` before and behind its end, with
    the distance to the plane through the returns round its end; where they make no plane, to the plane across the ray.
    """
    plane = surfels.flat_plane_of(surfels.cells.cell_of_ray[rays.first])
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
