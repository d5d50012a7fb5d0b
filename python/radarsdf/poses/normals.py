# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Normals of planes, without the part that only their errors make."""

from __future__ import annotations

import numpy as np

from radarsdf._core import CellBlocks
from radarsdf.poses.rigid import Floats
from radarsdf.returns.planes import NEIGHBOUR_WEIGHT, Surfels
from radarsdf.returns.sums import UPPER, merged_keys

# The edge of a region is 2 to the power of this, in cells. Wide regions have many planes, and know well what is error: with
# 8 cells, the way along simulated walls was told 5 times too surely, with 16 to 64 not.
_DOUBLINGS = 4


def told_normals(surfels: Surfels, num_threads: int) -> Floats:
    """(P, 3) unit normals of the surfels.

    Along a wall, each normal points a little along it by chance, and so all returns would tell where the sensor is. In each
    region, what the normals have of each direction is compared with what their errors would make of it, and reduced to the rest
    (errors in variables, Fuller 1987). Whatever the normals are, scans that move together lose nothing.
    """
    assert surfels.widest is not None
    planes = np.flatnonzero(surfels.is_flat())
    if len(planes) == 0:
        return surfels.normals
    cells = surfels.cell_of_plane[planes]
    normals, widest = surfels.normals[planes], surfels.widest[planes].astype(np.float64)
    across = np.cross(widest, normals)
    thickness, *widths = surfels.variances[planes].T
    weights = surfels.counts[cells] / thickness
    # Of a regression: the variances of the two slopes.
    of_across, of_widest = (weights * thickness / (surfels.support[cells] * width) for width in widths)
    sums = np.empty((len(planes), 12))
    for k, (i, j) in enumerate(UPPER):
        sums[:, k] = weights * normals[:, i] * normals[:, j]
        sums[:, 6 + k] = of_across * across[:, i] * across[:, j] + of_widest * widest[:, i] * widest[:, j]
    keys = surfels.keys[cells]
    for _ in range(_DOUBLINGS):
        keys = merged_keys(keys)
    regions, first, region = np.unique(keys, return_index=True, return_inverse=True)
    of_regions = np.add.reduceat(sums, first)
    of_regions = CellBlocks(regions).sum_round(regions, of_regions, NEIGHBOUR_WEIGHT, num_threads)
    spread, errors = np.empty((2, len(regions), 3, 3))
    for k, (i, j) in enumerate(UPPER):
        spread[:, i, j] = spread[:, j, i] = of_regions[:, k]
        errors[:, i, j] = errors[:, j, i] = of_regions[:, 6 + k]
    found = np.einsum("nij,nj->ni", _reduction(spread, errors)[region], normals)
    lengths = np.sqrt(np.einsum("ni,ni->n", found, found))[:, None]
    # A normal that seems all error stays as it is: in this region, there are hardly any others.
    all_normals = surfels.normals.copy()
    all_normals[planes] = np.where(lengths > 0.5, found / np.maximum(lengths, 0.5), normals)
    return all_normals


def _reduction(spread: Floats, errors: Floats) -> Floats:
    """(R, 3, 3) linear maps after which sums of squares `spread` (R, 3, 3) are without their part `errors`, or 0."""
    values, axes = np.linalg.eigh(spread)
    root = np.sqrt(np.maximum(values, 1e-12 * values[:, 2:]))[:, None]
    white = axes / root
    shares, turned = np.linalg.eigh(np.einsum("rki,rkl,rlj->rij", white, errors, white))
    kept = np.sqrt(np.maximum(1 - shares, 0.0))
    into = np.einsum("rij,rjk->rik", axes * root, turned)
    back = np.einsum("rij,rjk->rik", white, turned)
    found: Floats = np.einsum("rij,rj,rkj->rik", into, kept, back)
    return found
