"""The surface without training: smoothed averages of signed distances at the corners of leaf cells."""

from __future__ import annotations

import numpy as np
import torch

from radarsdf._core import VertexTable
from radarsdf.arrays import Floats32, Keys
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import GridField
from radarsdf.returns.evidence import ReturnsOfCells
from radarsdf.returns.planes import Surfels
from radarsdf.returns.sums import MeanRays

BAND_CELLS = 2.0
"""Reach of the average along a ray, before and behind its return, leaf cells."""
TRUNCATION_CELLS = 3.0
"""Truncation distance, and reach of a ray before and behind its return, leaf cells (VDBFusion: 3 voxels). Measured: 4 and 5
are as good on simulated scenes, 0.5 and 1.2 points of F-score worse on real ones."""
# Weights are rounded to this part of that of a return: sums of integers do not depend on their order.
_WEIGHT_OF_RETURN = 16
# Smoothing iterations. Measured: twice as many are 0.0 to 0.1 points of F-score better on whole simulated scenes, half as
# many 0.0 to 0.3 worse.
_SMOOTHINGS = 24
CELLS_SMOOTHED = _SMOOTHINGS * VertexTable.SMOOTHING_REACH
"""Reach of the smoothing in :func:`average_at_corners` along each axis, leaf cells."""


@torch.no_grad()
def average_surface(
    leaf_keys: Keys,
    means: MeanRays,
    returns: ReturnsOfCells,
    surfels: Surfels,
    config: FitConfig,
    num_threads: int,
) -> GridField:
    """Compute the smoothed average of the rays' truncated signed distances (Curless and Levoy, 1996).

    `leaf_keys` (C,): of the field, ascending. `means` and `returns` have the same cells, in the same order.
    """
    field = GridField(leaf_keys, config.leaf_size_m, num_threads)
    normals = normals_at(means, surfels, num_threads)
    distances_m = average_at_corners(field.table, means, returns, normals, config, num_threads)
    field.distances_m.copy_(torch.from_numpy(distances_m))
    return field


def normals_at(rays: MeanRays, surfels: Surfels, num_threads: int) -> Floats32:
    """Return the normals (M, 3) of the planes at the ends of rays: of a flat surfel, else towards the sensor."""
    plane = surfels.flat_planes_of(surfels.cells_of_leaves(rays.keys, num_threads))
    flat, normals = np.flatnonzero(plane >= 0), -rays.directions
    normals[flat] = surfels.normals.take(plane.take(flat), axis=0)
    # A surfel with returns from both sides of a thin wall faces only one side.
    normals[np.einsum("ij,ij->i", normals, rays.directions) > 0] *= -1
    return normals


def average_at_corners(
    table: VertexTable,
    rays: MeanRays,
    returns: ReturnsOfCells,
    normals: Floats32,
    config: FitConfig,
    num_threads: int,
) -> Floats32:
    """Return the smoothed average (V,) of the distances to the planes of rays, at the corners of the cells of `table`, m.

    A ray contributes to the corners of the cells that it crosses, up to `TRUNCATION_CELLS` before and behind its return. Its
    value there is the distance of the corner to the plane through its return with its normal (M, 3). Smoothing (thin plates)
    moves the average towards distances that agree with these planes and bend little. Measured: 1.4 points of F-score more
    than the plain average on simulated scenes, 1.8 on recorded drives; with every sixth scan 3.5 and 0.6.

    Distances depend only on what is within `CELLS_SMOOTHED` of the cells of their rays, to the last bit.
    """
    normals = np.ascontiguousarray(normals, np.float32)
    weights, truncation_m = np.rint(_WEIGHT_OF_RETURN * returns.weights), config.metres(TRUNCATION_CELLS)
    distances_m, sides = table.average_rays(
        rays.points, rays.directions, normals, weights, truncation_m, num_threads, _WEIGHT_OF_RETURN
    )
    of_rays = rays.points, normals, returns.information, sides
    return table.smoothed(distances_m, *of_rays, _SMOOTHINGS, num_threads)
