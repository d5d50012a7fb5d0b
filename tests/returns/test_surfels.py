"""Planes through returns: what lies behind them, how many returns support a place, and returns moved onto them."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf._core import SurfelMap, cell_keys
from radarsdf.config.groups import ReturnsConfig
from radarsdf.returns.ghosts import find_ghosts, first_crossed
from radarsdf.returns.noise import SensorNoise, onto_surfels, sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import MeanRays, ScanSums

from .walls import a_wall

CELL_M = 0.4
LEAF_M = 0.2
NOISE = SensorNoise(0.05, 0.01, 0.01)
"""That of `a_wall`."""


def ghosts_of(rays, surfels, noise=NOISE, num_threads=0):
    """(N,) bool of the returns."""
    cells = surfels.cells_at(rays.points)
    return find_ghosts(surfels, rays, cells, noise, num_threads)[cells]


def test_ghosts_are_found_and_the_surface_is_kept():
    points, poses, is_ghost = a_wall(ghosts=40)
    rays = prepare(points, poses)
    surfels = Surfels.of(rays, LEAF_M)
    dropped = ghosts_of(rays, surfels)
    assert dropped[is_ghost].mean() > 0.9
    assert dropped[~is_ghost].mean() < 0.005
    np.testing.assert_array_equal(dropped, ghosts_of(rays, surfels, num_threads=1))
    np.testing.assert_array_equal(dropped, ghosts_of(rays, surfels, num_threads=3))


def test_clutter_lies_on_no_flat_surfel():
    points, poses, _ = a_wall()
    surfels = Surfels.of(prepare(points, poses), LEAF_M)
    flat = surfels.variances[:, 0] < 0.5 * surfels.variances[:, 1]
    of_planes = surfels.counts[surfels.cell_of_plane]
    assert 0.05 < flat.mean() < 1
    assert surfels.clutter_ratio() == pytest.approx(of_planes[~flat].sum() / of_planes.sum())
    assert surfels.returns_per_cell() == pytest.approx(sum(map(len, points)) / len(surfels.keys))
    lone = Surfels.of(prepare([np.array([[5.0, 0, 0]])], poses[:1]), LEAF_M)
    assert (lone.clutter_ratio(), lone.returns_per_cell(), len(lone.cell_of_plane)) == (0, 1, 0)


def test_a_fit_excludes_and_counts_ghosts():
    points, poses, is_ghost = a_wall(ghosts=40)
    config = FitConfig(training={"sdf_iterations": 5}, returns={"min_range_m": 0.0})
    with_ghosts, without = (
        radarsdf.fit(points, poses, config=config.override(returns={"drop_ghosts": drop}), progress=False)
        for drop in (False, True)
    )
    assert with_ghosts.report["ghosts"] == 0
    assert without.report["ghosts"] > 0.9 * is_ghost.sum()
    assert without.report["returns_used"] + without.report["ghosts"] == len(is_ghost)
    assert not FitConfig.paper().returns.drop_ghosts
    behind = [[19.0, y, 2.0] for y in np.linspace(-3, 3, 50)]
    assert without.observed(behind).sum() < with_ghosts.observed(behind).sum()


def test_a_permeable_hedge_is_no_mirror():
    """Most rays cross its plane, so that returns behind it are real."""
    points, poses, _ = a_wall()
    rng = np.random.default_rng(1)
    passed = [np.concatenate([p[-750:] * rng.uniform(1.3, 1.9, (750, 1)) for _ in range(5)]) for p in points]
    rays = prepare([np.concatenate(pair) for pair in zip(points, passed, strict=True)], poses)
    behind = np.concatenate([np.arange(1500 + 3750) >= 1500] * len(points))
    surfels = Surfels.of(rays, LEAF_M)
    noise = sensor_noise(surfels, rays, ReturnsConfig())
    assert ghosts_of(rays, surfels, noise)[behind].mean() < 0.05


def one_surfel(normal=(-1.0, 0, 0), thickness_m=0.0, reach_m=np.inf):
    """A plane through (10, 0.2, 0.2)."""
    centre = np.array([[10.0, 0.2, 0.2]], np.float32)
    row = np.concatenate([centre, [normal], [[thickness_m, reach_m]]], 1).astype(np.float32)
    return SurfelMap(cell_keys(centre, CELL_M), row, CELL_M)


def crossed(surfels, sensor, point, noise=(0.01, 0.001), margin_m=0.1, sigmas=2.0):
    ray = np.asarray(point, np.float64) - sensor
    range_m = np.linalg.norm(ray)
    arrays = np.atleast_2d(point), np.atleast_2d(ray / range_m), np.array([range_m])
    return surfels.first_crossings(*(a.astype(np.float32) for a in arrays), *noise, margin_m, sigmas).tolist()


def test_crossings_of_one_surfel():
    sensor = np.array([0.0, 0.2, 0.2])
    assert crossed(one_surfel(), sensor, [11.0, 0.2, 0.2]) == [0]
    assert crossed(one_surfel(), sensor, [9.5, 0.2, 0.2]) == [-1]  # ends in front
    assert crossed(one_surfel(), sensor, [10.1, 0.2, 0.2]) == [-1]  # within the margin
    assert crossed(one_surfel(), sensor, [11.0, 3.0, 0.2]) == [-1]  # misses the cell
    assert crossed(one_surfel(reach_m=0.1), sensor, [11.0, 0.3, 0.2]) == [0]  # 0.09 m off its centre
    assert crossed(one_surfel(reach_m=0.1), sensor, [11.0, 0.2, 0.33]) == [-1]  # 0.12 m off
    assert crossed(one_surfel([1, 0, 0]), sensor, [11.0, 0.2, 0.2]) == [-1]  # comes from behind
    # Within two of its deviations.
    assert crossed(one_surfel(thickness_m=0.5), sensor, [11.0, 0.2, 0.2]) == [-1]
    # Within two of the sensor's.
    assert crossed(one_surfel(), sensor, [11.0, 0.2, 0.2], noise=(0.5, 0.0)) == [-1]
    # Across the beam: no depth.
    assert crossed(one_surfel(), sensor, [11.0, 0.2, 0.2], noise=(0.0, 0.5)) == [0]


def test_the_shift_is_the_best_linear_estimate():
    """Against plain NumPy, return by return."""
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
    cells = surfels.cells_at(rays.points)
    moved = onto_surfels(surfels, rays, cells, noise)
    np.testing.assert_allclose(moved.points, expected, atol=2e-6)
    # Rays that are left out count for the scatter of their plane.
    kept = np.random.default_rng(0).random(len(rays)) < 0.5
    for threads in (1, 3):
        chosen = onto_surfels(surfels, rays, cells, noise, kept, threads)
        for name in ("points", "directions", "ranges_m", "scans"):
            np.testing.assert_array_equal(getattr(chosen, name), getattr(moved, name)[kept])


def test_a_rough_surface_keeps_its_shape():
    """A sensor with little noise sees a wall with grooves: the scatter across the plane is shape, not noise."""
    rng = np.random.default_rng(0)
    y, z = rng.uniform(-3, 3, 20_000), rng.uniform(-3, 3, 20_000)
    depth_m = 0.1 * np.sin(2 * np.pi * y / 0.5)
    rays = prepare([np.column_stack([10 + depth_m + rng.normal(0, 0.01, len(y)), y, z])], np.eye(4)[None])
    surfels = Surfels.of(rays, LEAF_M)
    cells = surfels.cells_at(rays.points)
    kept = {
        sigma_m: np.std(onto_surfels(surfels, rays, cells, SensorNoise(sigma_m, 1e-4, 1e-4)).points[:, 0])
        / np.std(rays.points[:, 0])
        for sigma_m in (0.01, 0.1)
    }
    assert kept[0.01] > 0.95
    assert kept[0.1] < 0.3  # the grooves are below the noise of this sensor


def test_ghosts_of_mean_rays_are_found_around_a_sample_of_them(monkeypatch):
    points, poses, is_ghost = a_wall(ghosts=40)
    rays = prepare(points, poses)
    sums = ScanSums.of(rays, LEAF_M)
    surfels, means = Surfels.of_sums(sums), MeanRays.of_sums(sums)
    followed = []

    def counted(surfels, planes, rays, *rest, **options):
        followed.append(len(rays.keys))
        return first_crossed(surfels, planes, rays, *rest, **options)

    monkeypatch.setattr("radarsdf.returns.ghosts.first_crossed", counted)
    found = find_ghosts(surfels, means, surfels.cells_of_leaves(means.keys), NOISE)[
        surfels.cells_at(rays.points)
    ]
    assert found[is_ghost].mean() > 0.9
    assert found[~is_ghost].mean() < 0.01
    sampled, near = followed[:2]
    assert 0 < near < 0.8 * (len(means.keys) - sampled)
