# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Stage 1: exact where rays agree, the mean where they do not, smooth where the surface is."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.field.grid_field import GridField
from radarsdf.fitting.average import SurfaceReturns
from radarsdf.returns.rays import prepare
from scipy.spatial import cKDTree

from ..conftest import ground_and_wall


def rays_down(heights, half_m=3.0, spacing_m=0.05):
    """A sensor high above a grid of returns, so far that its rays are parallel to 1 %; its heights alternate."""
    x, y = np.meshgrid(*[np.arange(-half_m, half_m, spacing_m)] * 2, indexing="ij")
    z = np.resize(heights, x.shape)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel() - 300.0])
    pose = np.eye(4)
    pose[2, 3] = 300.0
    return [points], pose[None]


def fit(points, poses):
    config = FitConfig.quick(returns={"drop_ghosts": False})
    return radarsdf.fit(points, poses, config=config, progress=False)


def inner_points(count=500):
    rng = np.random.default_rng(0)
    return rng.uniform([-1.5, -1.5, -0.2], [1.5, 1.5, 0.2], (count, 3))


def test_a_plane_is_its_own_average():
    x = inner_points()
    np.testing.assert_allclose(fit(*rays_down([0.0])).sdf(x), x[:, 2], atol=0.01)


def test_rays_that_differ_are_averaged():
    x = inner_points()
    expected = x[:, 2] - (0.0 + 0.12 + 0.12) / 3
    np.testing.assert_allclose(fit(*rays_down([0.0, 0.12, 0.12])).sdf(x), expected, atol=0.02)


def test_smoothing_brings_it_nearer_to_a_surface_that_bends_little(monkeypatch):
    rng = np.random.default_rng(2)
    points, poses = rays_down([0.0], spacing_m=0.15)
    points = [points[0] + [0, 0, 1] * rng.normal(0, 0.08, (len(points[0]), 1))]
    x = inner_points()
    smoothed = np.square(fit(points, poses).sdf(x) - x[:, 2]).mean()
    monkeypatch.setattr("radarsdf.fitting.average._SMOOTHINGS", 0)
    assert smoothed < np.square(fit(points, poses).sdf(x) - x[:, 2]).mean() * 2 / 3


def test_intensities_are_in_closed_form():
    scene = ground_and_wall()
    config = FitConfig.quick()
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    assert isinstance(radar_map.field, GridField)
    world = scene.points[0] @ scene.poses[0, :3, :3].T + scene.poses[0, :3, 3]
    error = np.abs(radar_map.intensity(world, scene.poses[0, :3, 3]) - scene.intensities[0])
    assert np.median(error) < 2.0  # of some 20 dB from near to far


def test_the_mesh_of_stored_corners_is_that_of_the_field():
    scene = ground_and_wall()
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(), progress=False)
    everywhere = [[-100.0] * 3, [100.0] * 3]  # a box: corners are looked up one by one
    one, other = radar_map.mesh(0.2), radar_map.mesh(0.2, box=everywhere)
    # A distance of nearly zero may have another sign there: a triangle more or less.
    assert len(one.faces) == pytest.approx(len(other.faces), rel=1e-3)
    assert len(one.faces) > 1000
    for a, b in ((one, other), (other, one)):
        off_m = cKDTree(a.vertices).query(b.vertices)[0]
        assert np.median(off_m) < 1e-4
        assert np.quantile(off_m, 0.99) < 0.005  # on the border, where the other is evaluated a hair inside
    assert one.metadata["leaf_cells"] == one.metadata["leaf_cells_searched"]


def test_ghosts_of_a_part_are_those_of_the_whole():
    scans = radarsdf.simulate.hugin(frames=8, seed=3)
    rays = prepare(scans.points, scans.poses)
    inside = rays.points[:, 0] < np.median(rays.points[:, 0])
    config = FitConfig.quick(returns={"free_space": True})
    whole, part = (SurfaceReturns.of(rays, config, 1, some) for some in (None, inside))
    assert not whole.true.all()
    np.testing.assert_array_equal(part.true, whole.true)
    assert whole.count == SurfaceReturns.of(rays, FitConfig.quick(), 1).count == whole.true.sum()
