# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A field that averages what the rays say of each vertex, as truncated signed distances do (Curless and Levoy, 1996).

It needs no training, and is where training can start from instead of from noise.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from radarsdf import kernels
from radarsdf.config import FitConfig
from radarsdf.field import Field
from radarsdf.scans import Rays


def start_from_average(field: Field, rays: Rays, config: FitConfig, num_threads: int) -> None:
    """Makes the field the average over rays, interpolated between the vertices of an octree's leaf cells.

    Samples lie a leaf cell apart along each ray, up to `near_band_m` before and behind its return, and at random in the
    free space before that, where most fall into no cell; distances are cut at the same band. A sample counts at
    the vertices of its cell with the weights that it is interpolated by.
    """
    sums = torch.zeros(len(field.cells.features), kernels.FEATURE_DIM)
    points, directions, ranges_m = (
        torch.from_numpy(a) for a in (rays.points, rays.directions, rays.ranges_m)
    )
    generator = torch.Generator().manual_seed(config.seed)

    def add(sdf_m: Tensor) -> None:
        x = points - sdf_m[:, None] * directions
        labels = torch.zeros(len(x), kernels.FEATURE_DIM * field.cells.table.num_levels)
        labels[:, 0] = sdf_m.clamp(-config.near_band_m, config.near_band_m)
        labels[:, 1] = 1
        kernels.add_transposed(sums, x, labels, field.cells.table, num_threads)

    steps = math.ceil(2 * config.near_band_m / config.leaf_size_m)
    for sdf_m in np.linspace(-config.near_band_m, config.near_band_m, steps + 1):
        add(torch.full_like(ranges_m, float(sdf_m)))
    for _ in range(config.free_samples):
        share = torch.rand(len(ranges_m), generator=generator)
        farthest_m = (1 - config.free_from) * ranges_m
        add(config.near_band_m + share * (farthest_m - config.near_band_m).clamp_min(0))
    with torch.no_grad():
        weights = sums[:, 1]
        average_m = torch.where(weights > 0, sums[:, 0] / weights.clamp_min(1e-12), 0.0)
        field.cells.features[:, 0] = average_m / config.sigma_m
    field.sdf_network.start_as_input(0)
