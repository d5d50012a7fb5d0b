# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Dense walls: quick fits and live maps have no surface where no returns lie."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig

HALF_M, HEIGHT_M = 3.0, 3.0


def seen_from_an_arc(sides, thickness_m, clutter, scans=40, returns=1500):
    """Scans of a wall along y with its faces at ±thickness_m / 2, in turn from x > 0 and, of two `sides`, from x < 0."""
    rng = np.random.default_rng(0)
    points, poses = [], []
    for i, angle in enumerate(np.linspace(-1, 1, scans)):
        side = 1 - 2 * (i % sides)
        sensor = np.array([side * 8 * np.cos(angle), 8 * np.sin(angle), 1.2])
        face = np.full(returns, side * thickness_m / 2)
        hits = np.column_stack(
            [face, rng.uniform(-HALF_M, HALF_M, returns), rng.uniform(0, HEIGHT_M, returns)]
        )
        rays = hits - sensor
        range_m = np.linalg.norm(rays, axis=1, keepdims=True)
        rays = rays / range_m + rng.normal(0, 0.007, rays.shape)
        range_m += rng.normal(0, 0.05, range_m.shape)
        false = rng.random(returns) < clutter
        range_m[false, 0] = rng.uniform(2.5, 20, false.sum())
        points.append(rays / np.linalg.norm(rays, axis=1, keepdims=True) * range_m)
        poses.append(np.eye(4))
        poses[-1][:3, 3] = sensor
    return points, np.array(poses)


def quick_mesh(points, poses):
    return radarsdf.fit(points, poses, config=FitConfig.quick(), progress=False).mesh(0.1)


def live_mesh(points, poses):
    live = radarsdf.LiveMap()
    for scan, pose in zip(points, poses, strict=True):
        live.integrate(scan, pose)
    return live.mesh()


def off_m(mesh, thickness_m):
    """(V,) distances of vertices from the nearer face, away from the wall's ends."""
    x, y, z = np.asarray(mesh.vertices).T
    inner = (np.abs(y) < HALF_M - 0.3) & (z > 0.3) & (z < HEIGHT_M - 0.3)
    return np.abs(np.abs(x[inner]) - thickness_m / 2)


@pytest.mark.parametrize("mesh_of", [quick_mesh, live_mesh])
def test_smoothing_puts_no_second_sheet_before_or_behind_a_wall(mesh_of):
    found = off_m(mesh_of(*seen_from_an_arc(1, 0.0, 0.01)), 0.0)
    assert len(found) > 300
    assert (found > 0.3).mean() < 0.005


@pytest.mark.parametrize("mesh_of", [quick_mesh, live_mesh])
def test_a_thin_wall_has_two_faces_and_no_more(mesh_of):
    mesh = mesh_of(*seen_from_an_arc(2, 0.2, 0.0, scans=80))
    found = off_m(mesh, 0.2)
    assert len(found) > 600
    assert (found < 0.2).mean() > 0.98
    outwards = mesh.face_normals[:, 0] * np.sign(mesh.triangles_center[:, 0])
    assert mesh.area_faces[outwards > 0.7].sum() > 0.9 * 2 * 2 * HALF_M * HEIGHT_M
