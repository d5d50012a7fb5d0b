# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Moves noisy returns towards the planes that the returns round them lie on."""

from __future__ import annotations

import dataclasses

import numpy as np

from radarsdf._core import move_onto_planes
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import Surfels


def onto_surfels(surfels: Surfels, rays: Rays, noise: SensorNoise, num_threads: int = 0) -> Rays:
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
    num_threads : int
        0: as many as OpenMP uses.
    """
    points, directions, ranges_m = move_onto_planes(
        *rays.in_c_order(),
        np.ascontiguousarray(rays.scans),
        rays.up_of_scan,
        surfels.flat_planes_at(rays.points, num_threads),
        surfels.centres,
        surfels.normals,
        np.ascontiguousarray(surfels.variances[:, 0]),
        noise.variances,
        num_threads,
    )
    return dataclasses.replace(rays, points=points, directions=directions, ranges_m=ranges_m)
