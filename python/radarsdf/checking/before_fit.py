# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a fit will meet: returns below the ground, the noise of sensor and poses, memory and time."""

from __future__ import annotations

import numpy as np

from radarsdf.checking.common_surfaces import check_poses_by_noise
from radarsdf.checking.finding import Finding
from radarsdf.checking.recording import Recording
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.estimate import check_extent, estimate_rays
from radarsdf.returns.noise import sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare

_CLOSE_M = 25.0  # farther returns are below the ground by their noise in elevation
_BIN_M = 0.25
_DEPTH_M, _DEPTH_PER_M = 1.0, 0.1  # below the ground by this, and by this share of the range
_SOME, _MANY = 0.01, 0.1  # share of the close returns. Six real drives have up to 0.063
_FEW_RETURNS = 100
_FLAT = 1e-5  # thickness of the plane of the returns over its extent: float32 rounds to 1e-7


def check_elevation(recording: Recording) -> list[Finding]:
    """Tells whether the sensor measures no elevation: then all returns lie in one plane of its frame."""
    scans = [np.asarray(recording.points[i], np.float64) for i in recording.some_scans().tolist()]
    points = np.concatenate(scans)
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) < _FEW_RETURNS or spread[2] > _FLAT * spread[0]:
        return []
    return [
        Finding(
            "no_elevation",
            "warning",
            f"All {len(points)} returns that were compared lie in one plane of the sensor's frame: the radar measures no elevation.",
            "Read the map from above only: heights of its surface are those of the sensor, not of what it sees.",
        )
    ]


def check_ground(recording: Recording) -> list[Finding]:
    """Tells how many returns lie below the ground, as reflections in it do. The z axis of the world must be up.

    The ground is where most close returns below the sensor lie.
    """
    heights, ranges = [], []
    for i in recording.some_scans().tolist():
        scan = np.asarray(recording.points[i], np.float64)
        distance = np.linalg.norm(scan, axis=1)
        close = distance < _CLOSE_M
        heights.append(scan[close] @ recording.poses[i, 2, :3])
        ranges.append(distance[close])
    height, distance = np.concatenate(heights), np.concatenate(ranges)
    below = height[height < -_BIN_M]
    if len(below) < _FEW_RETURNS:
        return []
    counts, edges = np.histogram(below, np.arange(-5, 0, _BIN_M))
    ground = float(edges[np.argmax(counts)]) + _BIN_M / 2
    share = float((height < ground - _DEPTH_M - _DEPTH_PER_M * distance).mean())
    if share < _SOME:
        return []
    return [
        Finding(
            "below_ground",
            "warning" if share > _MANY else "note",
            f"{share:.1%} of the returns closer than {_CLOSE_M:g} m lie clearly below the ground, which is {-ground:.1f} m "
            "below the sensor.",
            "Leave them out if they are reflections in the ground.",
        )
    ]


def check_noise_and_cost(recording: Recording, config: FitConfig) -> list[Finding]:
    """Tells the noise of the sensor, and what a fit will cost, or why it would refuse."""
    try:
        rays = prepare(recording.points, recording.poses, recording.intensities, **config.preparation)
        check_extent(rays, config)
    except ValueError as error:
        return [
            Finding("fit_refuses", "error", f"A fit would refuse these scans: {error}.", "See the message.")
        ]
    cost = estimate_rays(rays, config)
    surfels = Surfels.of(rays, config.leaf_size_m)
    noise = sensor_noise(surfels, rays, config.returns)
    return [
        *check_poses_by_noise(rays, surfels, noise),
        Finding(
            "noise",
            "note",
            f"The noise of the sensor is about {noise.range_m:.3f} m along the beam, {np.degrees(noise.azimuth_rad):.2f} "
            f"degrees in azimuth and {np.degrees(noise.elevation_rad):.2f} degrees in elevation.",
            "Nothing needs to be done: a fit finds it anew.",
        ),
        Finding("cost", "note", f"A fit has {cost}.", "Lower effort if that is too much."),
    ]
