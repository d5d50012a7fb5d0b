# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Returns come nearer to the surface by the planes that they make, and keep its shape."""

import numpy as np
from radarsdf.returns.noise import SensorNoise, onto_surfels
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare

from .walls import a_wall

LEAF_M = 0.2


def test_the_shift_is_the_best_linear_estimate():
    """As in plain NumPy, one return after another."""
    points, poses, _ = a_wall(noise_range_m=0.1, noise_angle_rad=0.01, scans=2)
    noise = SensorNoise(0.1, 0.012, 0.02)
    rays = prepare(points, poses)
    surfels = Surfels.of(rays, LEAF_M)
    plane = surfels.flat_planes_at(rays.points)
    variances, of_plane = {}, {}
    for i in np.flatnonzero(plane >= 0):
        direction, normal = rays.directions[i].astype(float), surfels.normals[plane[i]]
        azimuth = np.cross(rays.up_of_scan[rays.scans[i]], direction)
        azimuth /= np.linalg.norm(azimuth)
        axes = direction, azimuth, np.cross(direction, azimuth)
        sigmas = noise.range_m, noise.azimuth_rad * rays.ranges_m[i], noise.elevation_rad * rays.ranges_m[i]
        variances[i] = sum((sigma * (axis @ normal)) ** 2 for axis, sigma in zip(axes, sigmas, strict=True))
        of_plane.setdefault(plane[i], []).append(variances[i])
    assert len(variances) > 0.2 * len(rays)
    expected = rays.points.astype(float)
    for i, variance in variances.items():
        rough = max(surfels.variances[plane[i], 0] - np.mean(of_plane[plane[i]]), 0)
        normal = surfels.normals[plane[i]]
        off_m = (expected[i] - surfels.centres[plane[i]]) @ normal
        expected[i] -= off_m * variance / (variance + rough) * normal
    np.testing.assert_allclose(onto_surfels(surfels, rays, noise).points, expected, atol=2e-6)


def test_a_rough_surface_keeps_its_shape():
    """A sensor with little noise sees a wall with grooves: the scatter across the plane is shape, not noise."""
    rng = np.random.default_rng(0)
    y, z = rng.uniform(-3, 3, 20_000), rng.uniform(-3, 3, 20_000)
    depth_m = 0.1 * np.sin(2 * np.pi * y / 0.5)
    rays = prepare([np.column_stack([10 + depth_m + rng.normal(0, 0.01, len(y)), y, z])], np.eye(4)[None])
    surfels = Surfels.of(rays, LEAF_M)
    kept = {
        sigma_m: np.std(onto_surfels(surfels, rays, SensorNoise(sigma_m, 1e-4, 1e-4)).points[:, 0])
        / np.std(rays.points[:, 0])
        for sigma_m in (0.01, 0.1)
    }
    assert kept[0.01] > 0.95
    assert kept[0.1] < 0.3  # a sensor with so much noise would not tell the grooves
