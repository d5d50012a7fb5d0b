# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Cells along rays and the average over rays, against what they are by definition."""

import itertools

import numpy as np
import pytest
from radarsdf._core import CellSet, Encoding, VertexTable, cell_keys

LEAF_M = 0.2


def some_rays(count, seed=0, spread_m=1.0):
    """Points, directions, normals and weights; some rays along axes, from points on faces of cells."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-spread_m, spread_m, (count, 3))
    directions = rng.normal(size=(count, 3))
    axes = np.repeat(np.eye(3), 2, axis=0) * np.resize([1, -1], 6)[:, None]
    directions[: len(axes)] = axes
    points[: len(axes) // 2] = np.round(points[: len(axes) // 2] / LEAF_M) * LEAF_M
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = rng.integers(1, 5, count)
    return [np.ascontiguousarray(a, np.float32) for a in (points, directions, normals, weights)]


def keys_along(points, directions, reach_m, num_threads=0):
    cells = CellSet(LEAF_M)
    cells.insert_rays(points, directions, reach_m, num_threads)
    return cells.sorted_keys()


def lattice(key):
    return [
        sum((int(key) >> (3 * bit + axis) & 1) << bit for bit in range(21)) - (1 << 20) for axis in range(3)
    ]


def test_cells_along_rays_are_those_that_they_go_through():
    points, directions, *_ = some_rays(60)
    reach_m = 0.7
    for point, direction in zip(points, directions, strict=True):
        keys = keys_along(point[None], direction[None], reach_m)
        steps = point + np.linspace(-reach_m, reach_m, 20_001)[:, None] * direction.astype(np.float64)
        fraction = steps / LEAF_M - np.floor(steps / LEAF_M)
        inside = ((fraction > 1e-4) & (fraction < 1 - 1e-4)).all(axis=1)  # where rounding cannot decide
        assert np.isin(cell_keys(np.ascontiguousarray(steps[inside]), LEAF_M), keys).all()
        for key in keys:  # and no others: each is met by the piece of line, within rounding
            low = np.array(lattice(key)) * LEAF_M - 1e-5
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = (np.stack([low, low + LEAF_M + 2e-5]) - point) / direction.astype(np.float64)
            ends = np.where(direction == 0, np.array([[-np.inf], [np.inf]]), np.sort(ends, axis=0))
            assert max(ends[0].max(), -reach_m) <= min(ends[1].min(), reach_m)


def test_a_longer_reach_meets_all_the_cells_of_a_shorter_one():
    points, directions, *_ = some_rays(5000, spread_m=300.0)
    short, far = (keys_along(points, directions, reach_m) for reach_m in (0.4, 0.6))
    assert np.isin(short, far).all()
    assert len(far) > len(short)
    for num_threads in (1, 3):
        np.testing.assert_array_equal(far, keys_along(points, directions, 0.6, num_threads))


@pytest.mark.parametrize("num_levels", [1, 3])
def test_vertices_of_leaf_cells(num_levels):
    points, directions, *_ = some_rays(300)
    table = VertexTable(keys_along(points, directions, 0.4), LEAF_M, num_levels, Encoding.OCTREE)
    coordinates, of_cells = table.leaf_vertices()
    steps = np.array(list(itertools.product((0, 1), repeat=3)))
    np.testing.assert_array_equal(coordinates[of_cells], table.leaf_cells()[:, None] + steps)
    assert len(np.unique(coordinates, axis=0)) == len(coordinates) <= table.num_rows
    assert np.array_equal(np.unique(of_cells), np.arange(len(coordinates)))
    if num_levels > 1:
        return
    # A feature is what is interpolated at its vertex: a hair inside one of its cells.
    features = np.random.default_rng(0).normal(size=(table.num_rows, 8)).astype(np.float32)
    inside = (coordinates[of_cells] + np.where(steps > 0, -1e-4, 1e-4)) * LEAF_M
    x = np.ascontiguousarray(inside.reshape(-1, 3), np.float32)
    located, out = np.empty((len(x), 1), np.int32), np.empty((len(x), 8), np.float32)
    table.encode(features, x, located, out)
    np.testing.assert_allclose(out, features[of_cells.ravel()], atol=5e-3)


def reference(table, points, directions, normals, weights, truncation_m):
    """By vertex, in float64, over the cells that :func:`keys_along` says a ray goes through."""
    coordinates, of_cells = table.leaf_vertices()
    leaf_of_key = {int(key): leaf for leaf, key in enumerate(table.leaf_keys())}
    sums = np.zeros((len(coordinates), 2))
    for p, d, n, w in zip(
        *(a.astype(np.float64) for a in (points, directions, normals, weights)), strict=True
    ):
        for key in keys_along(p[None].astype(np.float32), d[None].astype(np.float32), truncation_m):
            if int(key) in leaf_of_key:
                rows = of_cells[leaf_of_key[int(key)]]
                distance_m = ((coordinates[rows] * LEAF_M - p) @ n).clip(-truncation_m, truncation_m)
                sums[rows] += np.stack([np.full(8, w), w * distance_m], 1)
    return np.divide(sums[:, 1], sums[:, 0], out=np.zeros(len(sums)), where=sums[:, 0] > 0)


@pytest.mark.parametrize("num_levels", [1, 3])
def test_the_average_is_that_of_the_reference(num_levels):
    rays = some_rays(400)
    occupied = keys_along(*(np.ascontiguousarray(a[::2]) for a in rays[:2]), 0.4)
    table = VertexTable(occupied, LEAF_M, num_levels, Encoding.OCTREE)
    average, _ = table.average_rays(*rays, 0.6)
    expected = reference(table, *rays, 0.6)
    assert (expected != 0).mean() > 0.9
    np.testing.assert_allclose(average[: len(expected)], expected, atol=2e-6)
    assert (average[len(expected) :] == 0).all()


def test_the_same_bits_for_any_number_of_threads():
    rays = some_rays(40_000, spread_m=4.0)  # several groups
    table = VertexTable(keys_along(rays[0], rays[1], 0.4), LEAF_M, 1, Encoding.OCTREE)
    one, sides = table.average_rays(*rays, 0.6, num_threads=1)
    for num_threads in (2, 3, 8):
        again = table.average_rays(*rays, 0.6, num_threads=num_threads)
        assert (again[0].tobytes(), again[1].tobytes()) == (one.tobytes(), sides.tobytes())
    backwards = [
        np.ascontiguousarray(a[::-1]) for a in rays
    ]  # another order of sums, and no ray lost between groups
    np.testing.assert_allclose(table.average_rays(*backwards, 0.6)[0], one, atol=1e-5)


def test_the_side_of_a_vertex_is_known_where_many_rays_passed_it_and_behind_many_more():
    x, y = np.meshgrid(*[np.arange(-0.95, 1, 0.1)] * 2)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.03)]).astype(np.float32)
    down = np.tile(np.float32([0, 0, -1]), (x.size, 1))
    table = VertexTable(keys_along(points, down, 0.6), LEAF_M, 1, Encoding.OCTREE)
    corners, _ = table.leaf_vertices()
    inner = (np.abs(corners[:, :2]) < 5).all(axis=1)
    height_m = corners[inner, 2] * LEAF_M - 0.03
    # 16 rays in the four columns of cells round a vertex, each once or twice.
    for weight, in_front, behind in ((1, 0, 0), (8, 1, 0), (64, 1, -1)):
        weights = np.full(x.size, weight, np.float32)
        _, sides = table.average_rays(points, down, -down, weights, 0.6)
        expected = np.where(height_m > LEAF_M, in_front, np.where(height_m < -LEAF_M, behind, 0))
        np.testing.assert_array_equal(sides[: len(corners)][inner], expected)
