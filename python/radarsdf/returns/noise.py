# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Estimates the noise of the sensor from its returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import Surfels

_MAX_FLATNESS = 0.1  # smallest variance over the middle one of the surfels that are used
_MAX_RETURNS = 1_000_000  # more do not make the estimate better
_MIN_RETURNS = 100  # with fewer, the result is the guess that the estimate starts from
_SIGMAS2 = 6.0  # variances. A larger squared residual is an outlier
# The variance of a normal distribution is so many times its variance without these outliers.
_TRUNCATION = 1.05


@dataclass(frozen=True)
class BeamNoise:
    """Standard deviations of the noise of a return."""

    range_m: float
    """Along the beam, m."""
    angle_rad: float
    """Across the beam, as an angle, rad."""


def beam_noise(
    surfels: Surfels,
    rays: Rays,
    cell_of_ray: NDArray[np.int32],
    max_returns: int = _MAX_RETURNS,
) -> BeamNoise:
    """Estimates the noise of the sensor from the distances of returns to their surfels.

    At an angle of incidence θ, the variance across the plane is (σ_range · cos θ)² + (σ_angle · range · sin
    θ)². The two deviations are fitted to the squared distances by weighted least squares.

    Parameters
    ----------
    surfels : Surfels
        Surfels of the returns.
    rays : Rays
        N rays.
    cell_of_ray : ndarray
        (N,) row of the surfel cell of each return.
    max_returns : int
        About so many returns are used at most.
    """
    plane_of_cell = surfels.plane_of_cell(np.flatnonzero(surfels.is_flat(_MAX_FLATNESS)))
    plane = plane_of_cell[cell_of_ray]
    used_rays = np.flatnonzero(plane >= 0)
    used_rays = used_rays[:: -(-len(used_rays) // max_returns) or 1]
    sigma2 = np.array([(0.25 * surfels.cell_size_m) ** 2, 0.01**2])
    if len(used_rays) < _MIN_RETURNS:
        return BeamNoise(*np.sqrt(sigma2).tolist())
    plane, range_m = plane[used_rays], rays.ranges_m[used_rays].astype(np.float64)
    offset_m = rays.points[used_rays] - surfels.centres[plane]
    normals = surfels.normals[plane]
    residual2 = np.einsum("ni,ni->n", offset_m, normals) ** 2
    cosine2 = np.einsum("ni,ni->n", rays.directions[used_rays], normals) ** 2
    least = [(0.025 * surfels.cell_size_m) ** 2, 1e-6]
    parts = np.stack([cosine2, range_m**2 * (1 - cosine2)], 1)
    for _ in range(10):  # the weights are the variances of the round before
        variance = parts @ sigma2
        used = residual2 < _SIGMAS2 * variance
        kept = parts[used]
        weighted = kept / variance[used, None] ** 2
        solution = np.linalg.lstsq(weighted.T @ kept, weighted.T @ residual2[used], rcond=None)[0]
        sigma2 = _TRUNCATION * np.maximum(solution, least)
    return BeamNoise(*np.sqrt(sigma2).tolist())
