# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Queries of a map at points (N, 3) float32, local frame, m."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from radarsdf._core import CellBlocks
from radarsdf.map.contents import MapContents
from radarsdf.progress import hides_bar
from radarsdf.returns.cells import MAX_CELLS_FROM_ORIGIN
from radarsdf.threads import Workers, resolve_num_threads, start_vector_library

_HALF_SUPPORT = 10.0  # returns round a point that give a confidence of one half
# Of the uncertainty, leaf cells: the field does not resolve less, however many returns there are. Measured: 0.6 to 3 cm
# on simulated scenes with cells of 0.2 m.
_FLOOR_CELLS = 0.1
_CHUNK = 1 << 13  # points evaluated at a time, so that hidden layers stay in the second-level cache
_MIN_RANGE_M = 1e-6  # smallest divisor of a direction, for points at the sensor itself


@torch.inference_mode(mode=False)  # gradients, of which normals are made, need ordinary tensors
def to_local(contents: MapContents, world: Tensor) -> Tensor:
    """World positions (N, 3), m, in the local frame, float32. The origin is subtracted in float64."""
    return (world.double() - torch.from_numpy(contents.origin)).float()


def signed_distance(
    contents: MapContents, points: Tensor, *, description: str = "", progress: bool | None = False
) -> Tensor:
    """(N,) signed distance, m, positive in free space."""
    return evaluate(contents.field.signed_distance, points, description=description, progress=progress)


def gradient(contents: MapContents, points: Tensor) -> Tensor:
    """(N, 3) gradient of the signed distance, towards free space."""
    field = contents.field

    def of_chunk(chunk: Tensor) -> Tensor:
        with torch.enable_grad():
            chunk = chunk.detach().requires_grad_()
            return torch.autograd.grad(field.signed_distance(chunk).sum(), chunk)[0]

    return evaluate(of_chunk, points)


def occupied(contents: MapContents, points: Tensor) -> Tensor:
    """(N,) bool, whether each point lies in an occupied leaf cell."""
    return evaluate(contents.field.cells.occupied, points)


def confidence(contents: MapContents, points: Tensor) -> Tensor:
    """(N,) n / (n + 10) for the interpolated number n of returns in the 27 leaf cells round each point."""
    returns = _interpolated(contents, contents.support.astype(np.float32), points)
    return _confidence_of(returns)


def uncertainty(contents: MapContents, points: Tensor) -> Tensor:
    """(N,) standard error of the surface's position at each point, m. NaN where there are no returns round it."""
    information = _interpolated(contents, contents.information, points)
    floor_m = _FLOOR_CELLS * contents.config.leaf_size_m
    return torch.where(information > 0, (1 / information + floor_m**2).sqrt(), torch.nan)


def confidence_of_median(contents: MapContents, share: float) -> float:
    """The confidence of a support of `share` times the median over the leaf cells that have any."""
    observed = contents.support[contents.support > 0]
    if len(observed) == 0:
        return 0.0
    returns = share * float(np.median(observed))
    return returns / (returns + _HALF_SUPPORT)


@torch.inference_mode(mode=False)
def intensity(contents: MapContents, points: Tensor, sensors: Tensor) -> Tensor:
    """(N,) intensity, sensor units, of the return that each sensor gets from its point.

    `sensors` (N, 3): sensor positions, local frame, m.
    """
    scale, field = contents.intensity_scale, contents.field
    assert scale is not None

    def of_chunk(chunk: Tensor) -> Tensor:
        positions, rays = chunk[:, :3], chunk[:, :3] - chunk[:, 3:]
        ranges_m = rays.norm(dim=1)
        directions = rays / ranges_m.clamp_min(_MIN_RANGE_M)[:, None]
        return scale.to_sensor(field.intensity(field.geometry(positions), directions, ranges_m))

    return evaluate(of_chunk, torch.cat([points, sensors], 1))


@torch.inference_mode(mode=False)
def evaluate(
    function: Callable[[Tensor], Tensor],
    points: Tensor,
    *,
    description: str = "",
    progress: bool | None = False,
) -> Tensor:
    """function(points) without gradients, in chunks, on as many threads as PyTorch uses.

    `progress`: whether to show a progress bar with this `description`. None: only on a terminal.
    """

    def without_gradients(chunk: Tensor) -> Tensor:
        with torch.no_grad():
            return function(chunk)

    chunks = torch.split(points, _CHUNK) if len(points) > _CHUNK else (points,)
    if len(chunks) == 1:
        start_vector_library()  # the first queries may come from several threads at once
        return without_gradients(points)
    with Workers() as workers:
        results = workers.map(without_gradients, chunks)
        return torch.cat(
            list(tqdm(results, description, len(chunks), unit="chunk", disable=hides_bar(progress)))
        )


def _confidence_of(returns: Tensor) -> Tensor:
    return returns / (returns + _HALF_SUPPORT)


def _interpolated(contents: MapContents, of_cells: NDArray[np.float32], points: Tensor) -> Tensor:
    """(N,) values of leaf cells (C,), interpolated between the centres of the cells. 0 where there are none."""
    # Trilinearly, because a vertex of a mesh may be on the face of two cells.
    table = contents.field.cells.table
    # Points that are too far away for a key are moved to the limit, where there are no cells.
    limit_m = MAX_CELLS_FROM_ORIGIN * table.leaf_size_m
    near = points.nan_to_num(nan=limit_m).clamp(-limit_m, limit_m).contiguous()
    cells = CellBlocks(table.leaf_keys())
    return torch.from_numpy(
        cells.interpolate(table.leaf_size_m, of_cells, near.numpy(), resolve_num_threads(0))
    )
