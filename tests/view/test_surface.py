"""Thinning, colours, framing and picking of the surface."""

import numpy as np
import pytest
import trimesh
from radarsdf.map.threshold import Threshold
from radarsdf.view.serving import FOV_RAD, framing_pose
from radarsdf.view.surface import ShownSurface, first_hit, glb, thinned
from scipy.spatial import cKDTree

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
TWO = np.array([[0, 1, 2], [1, 3, 2]], np.int32)


def test_a_thinned_mesh_is_the_same_surface_with_the_same_attributes(sharp_map):
    full = sharp_map.mesh(0.1, viewpoint=[1, 0, 1.5], progress=False)
    thin, spacing_m = thinned(full, len(full.vertices) // 4, 0.1)
    assert len(full.vertices) / 8 < len(thin.vertices) <= len(full.vertices) / 4
    distance_m, row = cKDTree(full.vertices).query(thin.vertices)
    assert (distance_m == 0).all()
    for name in ("confidence", "uncertainty_m", "intensity"):
        np.testing.assert_array_equal(thin.vertex_attributes[name], full.vertex_attributes[name][row])
    assert set(np.unique(thin.faces)) == set(range(len(thin.vertices)))
    assert (np.sort(thin.faces, axis=1)[:, 1:] != np.sort(thin.faces, axis=1)[:, :-1]).all()
    assert thin.area == pytest.approx(full.area, rel=0.15)
    # No hole: the surface is nowhere farther than a cube. And its orientation is the same.
    samples, _ = trimesh.sample.sample_surface(thin, 50_000, seed=0)
    assert cKDTree(samples).query(full.vertices)[0].max() < 2 * spacing_m
    assert (thin.vertex_normals * full.vertex_normals[row]).sum(axis=1).mean() > 0.8
    assert thinned(full, len(full.vertices), 0.1)[0] is full


def test_a_vertex_without_uncertainty_is_shown_unless_the_uncertainty_is_limited():
    uncertainty_m = np.array([0.1, np.nan, 0.3], np.float32)
    confidence = np.array([0.2, 0.5, 0.9], np.float32)
    threshold = Threshold(0.0, 1.0, 1.0, 1.0, 1.0)
    surface = ShownSurface(
        np.eye(3), np.array([[0, 1, 2]], np.int32), uncertainty_m, confidence, confidence, threshold, 0.1
    )
    assert surface.kept(np.inf, 0.5).tolist() == [False, True, True]
    assert surface.kept(0.3, 0.0).tolist() == [True, False, True]


def test_a_glb_has_the_given_colors():
    pytest.importorskip("viser", reason="the extra view is not installed")
    from .client import Glb  # noqa: PLC0415 - which needs it

    colors = np.array([[0, 0, 0], [43, 20, 133], [249, 237, 82], [255, 255, 255]], np.uint8)
    data = glb(SQUARE, TWO, colors)
    assert int.from_bytes(data[8:12], "little") == len(data)
    mesh = Glb.of(data)
    np.testing.assert_array_equal(mesh.faces, TWO)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_allclose(mesh.colors, colors, atol=0.5)


def test_the_view_fits_the_whole_surface():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(500, 3)) * [40, 6, 2] + [500, -300, 20]
    for aspect in (0.4, 1.0, 2.4):
        position, look_at = framing_pose(points, np.array([-0.3, -0.6, 0.5]), aspect)
        forward = (look_at - position) / np.linalg.norm(look_at - position)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        depth = (points - position) @ forward
        x = (points - position) @ right / depth / aspect
        y = (points - position) @ np.cross(right, forward) / depth
        share = np.abs([x, y]).max(axis=1) / np.tan(FOV_RAD / 2)
        assert 0.85 < share.max() < 0.95  # of half the frame
        assert (depth > 0).all()
        np.testing.assert_allclose([x.min(), y.min()], [-x.max(), -y.max()], rtol=0.02)  # in the middle


def test_a_ray_hits_the_nearest_triangle():
    for origin, direction in [([0, 0, 2], [0, 0, 1]), ([1.1, 0.5, 2], [0, 0, -1]), ([-1, 0.5, 0], [1, 0, 0])]:
        assert first_hit(SQUARE, TWO, origin, direction) is None
    assert first_hit(SQUARE, TWO, [0.75, 0.8, -3], [0, 0, 5]) == pytest.approx([0.75, 0.8, 0])
    assert first_hit(SQUARE, TWO[:0], [0, 0, 2], [0, 0, -1]) is None
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=2.0)
    rng = np.random.default_rng(2)
    for target in rng.normal(scale=1.0, size=(50, 3)):
        direction = target - [9, 1, 2]
        hit = first_hit(mesh.vertices, mesh.faces, [9, 1, 2], direction)
        along = direction / np.linalg.norm(direction)
        closest = np.array([9, 1, 2]) - along * (along @ [9, 1, 2])
        if np.linalg.norm(closest) < 1.95:
            expected = closest - along * np.sqrt(4 - closest @ closest)
            assert hit == pytest.approx(expected, abs=0.1)
        elif np.linalg.norm(closest) > 2:
            assert hit is None
