# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The average of truncated distances: exact where rays agree, the mean where they do not, and what training starts from."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf._core import cell_keys
from radarsdf.field.neural_field import SDFNetwork
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import MeanRays, ScanSums
from scipy.spatial import cKDTree

from ..conftest import ground_and_wall
from ..settings import grouped


def rays_down(heights, half_m=3.0, spacing_m=0.05):
    """A sensor high above a grid of returns, so far that its rays are parallel to 1 %; its heights alternate."""
    x, y = np.meshgrid(*[np.arange(-half_m, half_m, spacing_m)] * 2, indexing="ij")
    z = np.resize(heights, x.shape)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel() - 300.0])
    pose = np.eye(4)
    pose[2, 3] = 300.0
    return [points], pose[None]


def fit(points, poses, **changes):
    config = FitConfig.quick(**grouped(**({"drop_ghosts": False, "start": "average"} | changes)))
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


def test_rays_count_behind_what_floats_before_their_ends():
    """Returns a little before the surface, fewer than the rays that go on: these outvote them, as far as they count."""
    points, poses = rays_down([0.0])
    rng = np.random.default_rng(0)
    clutter = np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.full(20, 0.9 - 300.0)])
    points = [np.concatenate([points[0], clutter])]
    x = np.column_stack([np.zeros((5, 2)), np.linspace(0.75, 0.85, 5)])
    assert (fit(points, poses, truncation_cells=6.0).sdf(x) > 0).all()
    assert (fit(points, poses, truncation_cells=2.0).sdf(x) < 0).any()


def test_one_ray_of_a_cell_is_the_mean_of_its_rays():
    rng = np.random.default_rng(0)
    points, poses = [rng.normal(0, 3, (3000, 3))], np.eye(4)[None]
    rays = prepare(points, poses)
    averaged = MeanRays.of_sums(ScanSums.of(rays, 0.8))
    keys = cell_keys(rays.points, 0.8)
    assert averaged.keys.tolist() == np.unique(keys).tolist()
    assert averaged.counts.sum() == len(rays)
    for i in (0, 5, len(averaged.keys) - 1):
        own = np.flatnonzero(keys == averaged.keys[i])
        assert averaged.counts[i] == len(own)
        np.testing.assert_allclose(averaged.points[i], rays.points[own].mean(axis=0), atol=1e-5)
        direction = rays.directions[own].sum(axis=0)
        np.testing.assert_allclose(averaged.directions[i], direction / np.linalg.norm(direction), atol=1e-5)


def test_rays_that_cancel_each_other_have_a_direction():
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 10.0
    rays = prepare([[[5.0, 0.0, 0.0]], [[-5.0, 0.0, 0.0]]], poses)
    averaged = MeanRays.of_sums(ScanSums.of(rays, 0.4))
    np.testing.assert_array_equal(averaged.directions, [[0, 0, -1]])


def test_the_quick_mesh_lies_on_the_surface():
    scene = ground_and_wall(scans=8, returns_per_scan=3000)
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(), progress=False)
    vertices = np.asarray(radar_map.mesh(0.2).vertices)
    off_m = np.minimum(np.abs(vertices[:, 2]), np.abs(vertices[:, 0] - 20))
    assert np.quantile(off_m, 0.95) < 0.1
    assert radar_map.report["iterations"] == {"sdf": 0, "intensity": 0}


def test_intensities_are_fitted_on_the_average():
    scene = ground_and_wall()
    config = FitConfig.quick(training={"intensity_iterations": 200})
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    world = scene.points[0] @ scene.poses[0, :3, :3].T + scene.poses[0, :3, 3]
    error = np.abs(radar_map.intensity(world, scene.poses[0, :3, 3]) - scene.intensities[0])
    assert np.median(error) < 2.0  # of some 20 dB from near to far


def test_training_goes_on_from_the_average():
    scene = ground_and_wall()
    start = fit(scene.points, scene.poses)
    on = fit(scene.points, scene.poses, sdf_iterations=30, learning_rate=1e-3)
    x = np.random.default_rng(1).uniform([10, -4, -0.1], [18, 4, 0.1], (400, 3))
    change = np.abs(on.sdf(x, extrapolate=True) - start.sdf(x, extrapolate=True))
    assert 0 < np.median(change) < 0.05


@pytest.mark.parametrize("hidden", [(2,), (4, 4)])
def test_the_mesh_from_vertices_is_that_of_the_field(hidden):
    scene = ground_and_wall()
    radar_map = radarsdf.fit(
        scene.points, scene.poses, config=FitConfig.quick(networks={"sdf_hidden": hidden}), progress=False
    )
    everywhere = [[-100.0] * 3, [100.0] * 3]  # a box: vertices are looked up one by one
    one, other = radar_map.mesh(0.2), radar_map.mesh(0.2, box=everywhere)
    # A distance of nearly zero may have another sign there: a triangle more or less.
    assert len(one.faces) == pytest.approx(len(other.faces), rel=1e-3)
    assert len(one.faces) > 1000
    for a, b in ((one, other), (other, one)):
        off_m = cKDTree(a.vertices).query(b.vertices)[0]
        assert np.median(off_m) < 1e-4
        assert np.quantile(off_m, 0.99) < 0.005  # on the border, where the other is evaluated a hair inside
    assert one.metadata["leaf_cells"] == one.metadata["leaf_cells_searched"]


@pytest.mark.parametrize("hidden", [(2,), (5, 3), (4, 4, 4)])
def test_the_network_starts_as_one_input(hidden):
    config = FitConfig(
        encoding={"num_levels": 1, "fourier_count": 0},
        networks={"sdf_hidden": hidden, "geometry_feature_dim": 2},
    )
    network = SDFNetwork(config)
    network.initialise(torch.Generator().manual_seed(0))
    network.start_as_input(4)
    encoding = torch.randn(50, 8, generator=torch.Generator().manual_seed(1))
    logit, _ = network([encoding])
    torch.testing.assert_close(logit, encoding[:, 4])
    logit.sum().backward()
    assert network.layers[-1].weight.grad.any()


def test_a_smoothed_average_is_nearer_to_a_surface_that_bends_little():
    rng = np.random.default_rng(2)
    points, poses = rays_down([0.0], spacing_m=0.15)
    points = [points[0] + [0, 0, 1] * rng.normal(0, 0.08, (len(points[0]), 1))]
    x = inner_points()
    errors = [
        np.square(fit(points, poses, start=start).sdf(x) - x[:, 2]).mean()
        for start in ("average", "smoothed")
    ]
    assert errors[1] < errors[0] * 2 / 3


@pytest.mark.parametrize("start", ["average", "smoothed"])
def test_only_an_octree_holds_an_average(start):
    with pytest.raises(ValueError, match=f"'{start}' needs encoding.kind 'octree'"):
        FitConfig(training={"start": start})
    with pytest.raises(ValueError, match="start"):
        FitConfig(training={"start": "zero"})
    with pytest.raises(ValueError, match="at least 2"):
        FitConfig.quick(networks={"sdf_hidden": (1,)})
    with pytest.raises(
        ValueError, match=r"training\.truncation_cells must be at least sampling\.near_band_cells, 2\.0"
    ):
        FitConfig.quick(training={"truncation_cells": 1.5})
