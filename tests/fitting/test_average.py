"""Averaged fits: exact for consistent rays, else their mean, and smooth on smooth surfaces."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.field.field import GridField
from radarsdf.fitting.fit import _in_order
from radarsdf.fitting.surface_returns import SurfaceReturns
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare
from scipy.spatial import cKDTree

from ..conftest import ground_and_wall


def rays_down(heights, half_m=3.0, spacing_m=0.05):
    """A sensor high above a grid of returns of alternating heights; its rays are parallel to 1 %."""
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


def test_contradicting_rays_are_averaged():
    x = inner_points()
    expected = x[:, 2] - (0.0 + 0.12 + 0.12) / 3
    np.testing.assert_allclose(fit(*rays_down([0.0, 0.12, 0.12])).sdf(x), expected, atol=0.02)


def test_smoothing_improves_surfaces_of_low_curvature(monkeypatch):
    rng = np.random.default_rng(2)
    points, poses = rays_down([0.0], spacing_m=0.15)
    points = [points[0] + [0, 0, 1] * rng.normal(0, 0.08, (len(points[0]), 1))]
    x = inner_points()
    smoothed = np.square(fit(points, poses).sdf(x) - x[:, 2]).mean()
    monkeypatch.setattr("radarsdf.fitting.surface_returns._SMOOTHINGS", 0)
    assert smoothed < np.square(fit(points, poses).sdf(x) - x[:, 2]).mean() * 2 / 3


def test_intensities_have_a_closed_form():
    scene = ground_and_wall()
    config = FitConfig.quick()
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    assert isinstance(radar_map.field, GridField)
    world = scene.points[0] @ scene.poses[0, :3, :3].T + scene.poses[0, :3, 3]
    error = np.abs(radar_map.intensity(world, scene.poses[0, :3, 3]) - scene.intensities[0])
    assert np.median(error) < 2.0  # of about 20 dB from near to far


def test_of_many_returns_a_sample_is_even_among_scans_and_places(monkeypatch):
    scans = radarsdf.simulate.wall(frames=12, seed=2)
    rays = prepare(scans.points, scans.poses)
    surfels = Surfels.of(rays, 0.2)
    assert len(_in_order(rays, surfels, 1)) == len(rays)
    monkeypatch.setattr("radarsdf.fitting.fit._ENOUGH_RETURNS", 1)
    planes = np.count_nonzero(surfels.is_flat())
    monkeypatch.setattr("radarsdf.fitting.fit._ENOUGH_PER_PLANE", len(rays) // (3 * planes))
    sample = _in_order(rays, surfels, 1)
    assert len(rays) / 5 < len(sample) < len(rays) / 2
    share = len(sample) / len(rays)
    for groups in (lambda r: r.scans, lambda r: (r.points[:, 1] // 4).astype(int) + 100):
        given, kept = (np.bincount(groups(r), minlength=200) for r in (rays, sample))
        np.testing.assert_allclose(kept[given > 300] / given[given > 300], share, rtol=0.15)


@pytest.mark.parametrize("voxel_size", [0.1, 0.2])
def test_the_mesh_of_stored_corners_equals_that_of_the_field(monkeypatch, voxel_size):
    scene = ground_and_wall()
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(), progress=False)
    one = radar_map.mesh(voxel_size)
    monkeypatch.setattr(GridField, "corner_distances_m", lambda _: None)
    other = radar_map.mesh(voxel_size)
    # Distances near zero may change sign: a triangle more or less.
    assert len(one.faces) == pytest.approx(len(other.faces), rel=1e-3)
    assert len(one.faces) > 1000
    for a, b in ((one, other), (other, one)):
        off_m = cKDTree(a.vertices).query(b.vertices)[0]
        assert np.median(off_m) < 1e-4
        assert np.quantile(off_m, 0.99) < 0.005  # on the border, where the other is evaluated slightly inside
    assert (one.metadata["leaf_cells"] > one.metadata["leaf_cells_searched"]) == (voxel_size < 0.2)


def test_ghosts_of_a_part_equal_those_of_the_whole():
    scans = radarsdf.simulate.hugin(frames=8, seed=3)
    rays = prepare(scans.points, scans.poses)
    inside = rays.points[:, 0] < np.median(rays.points[:, 0])
    config = FitConfig.quick(returns={"free_space": True})
    whole, part = (SurfaceReturns.of(rays, config, 1, some) for some in (None, inside))
    assert not whole.true.all()
    np.testing.assert_array_equal(part.true, whole.true)
    assert whole.count == SurfaceReturns.of(rays, FitConfig.quick(), 1).count == whole.true.sum()


HALF_M, HEIGHT_M = 3.0, 3.0


def seen_from_an_arc(sides, thickness_m, clutter, scans=40, returns=1500):
    """Scans of a wall along y with faces at ±thickness_m / 2, from x > 0 and, with two `sides`, alternately from x < 0."""
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
    """Distances (V,) of vertices from the nearer face, away from the ends of the wall."""
    x, y, z = np.asarray(mesh.vertices).T
    inner = (np.abs(y) < HALF_M - 0.3) & (z > 0.3) & (z < HEIGHT_M - 0.3)
    return np.abs(np.abs(x[inner]) - thickness_m / 2)


@pytest.mark.parametrize("mesh_of", [quick_mesh, live_mesh])
def test_smoothing_adds_no_second_surface_before_or_behind_a_wall(mesh_of):
    found = off_m(mesh_of(*seen_from_an_arc(1, 0.0, 0.01)), 0.0)
    assert len(found) > 300
    assert (found > 0.3).mean() < 0.005


@pytest.mark.parametrize("mesh_of", [quick_mesh, live_mesh])
def test_a_thin_wall_has_exactly_two_faces(mesh_of):
    mesh = mesh_of(*seen_from_an_arc(2, 0.2, 0.0, scans=80))
    found = off_m(mesh, 0.2)
    assert len(found) > 600
    assert (found < 0.2).mean() > 0.98
    outwards = mesh.face_normals[:, 0] * np.sign(mesh.triangles_center[:, 0])
    assert mesh.area_faces[outwards > 0.7].sum() > 0.9 * 2 * 2 * HALF_M * HEIGHT_M
