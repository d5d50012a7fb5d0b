# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is shown of a surface, and where a ray meets it."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import trimesh
from radarsdf.map.colors import intensity_colors
from radarsdf.map.threshold import Threshold
from radarsdf.view.framing import look_at_all
from radarsdf.view.glb import glb
from radarsdf.view.light import shaded
from radarsdf.view.picking import first_hit
from radarsdf.view.surface import ShownSurface
from radarsdf.view.thinning import spread_evenly, thinned
from scipy.spatial import cKDTree

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
TWO = np.array([[0, 1, 2], [1, 3, 2]], np.int32)


def test_a_surface_has_no_more_vertices_than_allowed(sharp_map):
    full = ShownSurface.of(sharp_map, 0.1, max_vertices=10**9, progress=False)
    assert full.spacing_m == 0.1
    most = len(full.vertices) // 3
    thin = ShownSurface.of(sharp_map, 0.1, max_vertices=most, progress=False)
    assert most / 2 < len(thin.vertices) <= most
    assert thin.spacing_m > 0.1
    np.testing.assert_allclose(np.ptp(thin.vertices, axis=0), np.ptp(full.vertices, axis=0), atol=0.5)


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
    # No hole: the surface is nowhere farther than a cube. And it faces the same way.
    samples, _ = trimesh.sample.sample_surface(thin, 50_000, seed=0)
    assert cKDTree(samples).query(full.vertices)[0].max() < 2 * spacing_m
    assert (thin.vertex_normals * full.vertex_normals[row]).sum(axis=1).mean() > 0.8
    assert thinned(full, len(full.vertices), 0.1)[0] is full


def test_a_map_without_a_surface_here(sharp_map):
    with pytest.raises(ValueError, match="no surface here"):
        ShownSurface.of(sharp_map, 0.2, max_vertices=1000, box=[[90, 90, 90], [91, 91, 91]], progress=False)


def test_limits_leave_out_vertices_and_their_triangles():
    surface = ShownSurface(
        SQUARE, TWO, np.array([0.1, 0.1, 0.1, 0.4], np.float32), np.array([0.5, 1, 1, 1], np.float32),
        np.ones(4, np.float32), Threshold(0.5, 0.9, 0.9, 0.9, 0.9), 1.0,
    )  # fmt: skip

    def part(*limits):
        rows, faces = surface.part(surface.kept(*limits))
        return rows.tolist(), rows[faces].tolist()

    assert part(1.0, 0.0) == ([0, 1, 2, 3], [[0, 1, 2], [1, 3, 2]])
    assert part(0.2, 0.0) == ([0, 1, 2], [[0, 1, 2]])
    assert part(1.0, 0.7) == ([1, 2, 3], [[1, 3, 2]])
    assert part(0.2, 0.7) == ([], [])


def test_points_are_spread_evenly():
    rng = np.random.default_rng(1)
    points = np.zeros((20_000, 3))
    points[:, :2] = rng.uniform(0, 10, (20_000, 2))
    points[:15_000, :2] *= 0.1  # most of them in a corner
    rows, of_point, edge_m = spread_evenly(points, 1000, 0.05)
    assert 500 < len(rows) <= 1000
    assert len(set(rows)) == len(rows)
    gaps = cKDTree(points[rows]).query(points)[0]
    assert gaps.max() < 1.8 * edge_m  # within the diagonal of a cube: no place is left out
    away_m = np.linalg.norm(points - points[rows[of_point]], axis=1)
    assert away_m.max() < 1.8 * edge_m
    everything, _, edge_m = spread_evenly(points, len(points), 0.05)
    assert (everything == np.arange(len(points))).all()
    assert edge_m == 0.05


def test_a_glb_says_how_long_it_is():
    data = glb(SQUARE, TWO, np.zeros((4, 3), np.uint8))
    assert struct.unpack("<4s2I", data[:12]) == (b"glTF", 2, len(data))


def test_a_glb_has_the_colors_that_were_given():
    pytest.importorskip("viser", reason="the extra view is not installed")
    from .client import Glb  # noqa: PLC0415 - which needs it

    colors = np.array([[0, 0, 0], [43, 20, 133], [249, 237, 82], [255, 255, 255]], np.uint8)
    mesh = Glb.of(glb(SQUARE, TWO, colors))
    np.testing.assert_array_equal(mesh.faces, TWO)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_allclose(mesh.colors, colors, atol=0.5)


def test_a_shade_keeps_the_hue():
    colors = intensity_colors(np.linspace(0, 1, 64), 0, 1)[:, :3]
    whole, half = (_oklab(shaded(colors, np.full(64, factor))) for factor in (1.0, 0.87))
    np.testing.assert_array_equal(shaded(colors, np.ones(64)), colors)
    np.testing.assert_allclose(half, 0.87 * whole, atol=0.004)  # lightness and chroma; colours are rounded


def _oklab(colors):
    srgb = colors / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    to_lms = [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]]
    to_lab = [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]
    return np.cbrt(linear @ np.transpose(to_lms)) @ np.transpose(to_lab)


def test_all_is_seen_and_the_frame_is_filled():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(500, 3)) * [40, 6, 2] + [500, -300, 20]
    for aspect in (0.4, 1.0, 2.4):
        position, look_at = look_at_all(points, np.array([-0.3, -0.6, 0.5]), aspect, fov_rad=0.9)
        forward = (look_at - position) / np.linalg.norm(look_at - position)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        depth = (points - position) @ forward
        x = (points - position) @ right / depth / aspect
        y = (points - position) @ np.cross(right, forward) / depth
        share = np.abs([x, y]).max(axis=1) / np.tan(0.45)
        assert 0.85 < share.max() < 0.95  # of half the frame
        assert (depth > 0).all()
        np.testing.assert_allclose([x.min(), y.min()], [-x.max(), -y.max()], rtol=0.02)  # in the middle


def test_a_ray_meets_the_nearest_triangle():
    vertices = np.concatenate([SQUARE, SQUARE - [0, 0, 1]])
    faces = np.concatenate([TWO + 4, TWO])
    assert first_hit(vertices, faces, [0.25, 0.25, 2], [0, 0, -5]) == pytest.approx([0.25, 0.25, 0])
    assert first_hit(vertices, faces, [0.75, 0.8, -3], [0, 0, 1]) == pytest.approx([0.75, 0.8, -1])
    assert first_hit(vertices, faces, [0.25, 0.25, -0.5], [0, 0, -1]) == pytest.approx([0.25, 0.25, -1])
    for origin, direction in [([0, 0, 2], [0, 0, 1]), ([1.1, 0.5, 2], [0, 0, -1]), ([-1, 0.5, 0], [1, 0, 0])]:
        assert first_hit(vertices, faces, origin, direction) is None
    assert first_hit(vertices, faces[:1], [0.25, 0.25, 2], [0, 0, -1]) == pytest.approx([0.25, 0.25, -1])
    assert first_hit(vertices, faces[:0], [0, 0, 2], [0, 0, -1]) is None


def test_rays_meet_a_mesh_where_others_say():
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
