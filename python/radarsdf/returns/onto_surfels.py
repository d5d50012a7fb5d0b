# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Moves noisy returns towards the planes that the returns round them lie on."""

from __future__ import annotations

import dataclasses

import numpy as np

from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import Surfels


def onto_surfels(surfels: Surfels, rays: Rays, noise: SensorNoise, chunk: int = 1 << 17) -> Rays:
    """The rays with each return moved towards the surfel of its cell, if there is a flat one.

    A plane through dozens of returns has much less noise than one return. But a surface is no plane: where
    the returns scatter more than their noise explains, the rest is the shape of the surface. So a return keeps
    the share τ² / (τ² + σ²) of its distance from the plane, with the variance σ² of its noise across the plane
    and the variance τ² of the surface, which is that of the returns less their mean σ². This is the best linear
    estimate of its true distance (Wiener, 1949). Along the plane, the return keeps its position.

    Parameters
    ----------
    surfels : Surfels
        Surfels of the returns of `rays`.
    rays : Rays
        N rays.
    noise : SensorNoise
        Noise of the returns.
    chunk : int
        Returns that are moved at a time.
    """
    plane = surfels.flat_plane_of(surfels.cells.cell_of_ray)
    moved = np.flatnonzero(plane >= 0)
    chunks = [moved[first : first + chunk] for first in range(0, len(moved), chunk)]
    variances = np.concatenate(
        [
            np.empty(0),
            *(noise.variances_across_m2(rays, rows, surfels.normals[plane[rows]]) for rows in chunks),
        ]
    )
    counts = np.bincount(plane[moved], minlength=len(surfels.normals))
    sums = np.bincount(plane[moved], variances, len(surfels.normals))
    roughness = np.maximum(surfels.variances[:, 0] - sums / np.maximum(counts, 1), 0.0)
    points, directions, ranges_m = rays.points.copy(), rays.directions.copy(), rays.ranges_m.copy()
    done = 0
    for rows in chunks:
        variance = variances[done : done + len(rows)]
        done += len(rows)
        point, normal = rays.points[rows].astype(np.float64), surfels.normals[plane[rows]]
        offset_m = np.einsum("ni,ni->n", point - surfels.centres[plane[rows]], normal)
        offset_m *= variance / (variance + roughness[plane[rows]])
        step_m = offset_m[:, None] * normal
        ray = rays.directions[rows].astype(np.float64) * rays.ranges_m[rows, None] - step_m
        range_m = np.maximum(np.linalg.norm(ray, axis=1), 1e-6)
        points[rows] = point - step_m
        directions[rows] = ray / range_m[:, None]
        ranges_m[rows] = range_m
    return dataclasses.replace(rays, points=points, directions=directions, ranges_m=ranges_m)
