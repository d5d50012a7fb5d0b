# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Smoothed distances, against the least sum of squares that they are to come near."""

import numpy as np
import pytest
from radarsdf._core import CellBlocks, CellSet, Encoding, VertexTable, cell_keys
from scipy.linalg import lstsq

LEAF_M = 0.2


def scene(seed=0, count=300, half_m=1.2, lower=0.0):
    """A table round a wavy surface, planes on it with noise, and rough distances at its vertices."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-half_m, half_m, (count, 3))
    points[:, 2] = 0.2 * np.sin(2 * points[:, 0]) + lower
    normals = np.column_stack([-0.4 * np.cos(2 * points[:, 0]), np.zeros(count), np.ones(count)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    information = rng.uniform(50, 500, count)
    points, normals, information = (
        np.ascontiguousarray(a, np.float32)
        for a in (points + 0.05 * rng.normal(size=points.shape), normals, information)
    )
    cells = CellSet(LEAF_M)
    cells.insert_rays(points, normals, 0.4)
    table = VertexTable(cells.sorted_keys(), LEAF_M, 1, Encoding.OCTREE)
    corners, _ = table.leaf_vertices()
    rough = (corners[:, 2] * LEAF_M - lower + 0.1 * rng.normal(size=len(corners))).astype(np.float32)
    return table, rough, points, normals, information


def smoothed(table, distances, *planes, **threads):
    """By ``table.smoothed``, where no vertex has a known side. `planes`: with the iterations."""
    *arrays, iterations = planes
    return table.smoothed(distances, *arrays, np.zeros(len(distances), np.int8), iterations, **threads)


def system(table, points, normals, information):
    """Rows A and targets b of the sum of squares |A d - b|² that the core names."""
    corners, of_cells = table.leaf_vertices()
    leaves = CellBlocks(table.leaf_keys())
    rows, targets = [], []
    for away_m in (-LEAF_M, 0.0, LEAF_M):
        places = points.astype(np.float64) + away_m * normals
        cells = leaves.rows(cell_keys(np.ascontiguousarray(places, np.float32), LEAF_M))
        for place, cell, precision in zip(places, cells, information, strict=True):
            if cell < 0:
                continue
            row, weight = np.zeros(len(corners)), 2 * LEAF_M * np.sqrt(precision / 3)
            for corner in of_cells[cell]:
                row[corner] = weight * np.prod(1 - np.abs(place / LEAF_M - corners[corner]))
            rows.append(row)
            targets.append(weight * away_m)
    number = {tuple(corner): i for i, corner in enumerate(corners.tolist())}
    edges = {
        tuple(sorted((a, b)))
        for cell in of_cells
        for a in cell
        for b in cell
        if np.abs(corners[a] - corners[b]).sum() == 1
    }
    for i, corner in enumerate(corners):
        for step in np.eye(3, dtype=int):
            before, after = (number.get(tuple(corner + way * step)) for way in (-1, 1))
            if {tuple(sorted((i, other))) for other in (before, after) if other is not None} - edges:
                continue  # two vertices that are neighbours, but of no common cell
            if before is not None and after is not None:
                row = np.zeros(len(corners))
                row[[before, i, after]] = 1, -2, 1
                rows.append(row)
                targets.append(0.0)
    return np.array(rows), np.array(targets)


def test_many_iterations_come_to_the_least_sum_of_squares():
    table, rough, *planes = scene(count=150, half_m=0.8)
    matrix, targets = system(table, *planes)
    least = lstsq(matrix, targets, lapack_driver="gelsy")[
        0
    ]  # NumPy's takes singular values, ten times as long

    def sum_of_squares(distances):
        return np.square(matrix @ distances - targets).sum()

    sums = [sum_of_squares(smoothed(table, rough, *planes, iterations)) for iterations in (0, 4, 24)]
    again = smoothed(table, smoothed(table, rough, *planes, 50), *planes, 50)
    sums.append(sum_of_squares(again))
    assert sums[0] == sum_of_squares(rough)
    assert sums == sorted(sums, reverse=True)
    # Errors shrink to 1 / cosh(4), but for those that are hardly seen.
    assert sums[2] - sum_of_squares(least) < (sums[0] - sum_of_squares(least)) / np.cosh(4) ** 2
    assert sums[3] < 1.0001 * sum_of_squares(least)


def test_what_is_flat_stays():
    table, _, points, normals, information = scene()
    points[:, 2], normals[:] = 0.03, [0, 0, 1]
    distances = (table.leaf_vertices()[0][:, 2] * LEAF_M - 0.03).astype(np.float32)
    np.testing.assert_allclose(
        smoothed(table, distances, points, normals, information, 50), distances, atol=2e-6
    )


def test_a_vertex_gets_what_is_in_reach_to_the_bit():
    iterations = 3
    reach_m = iterations * VertexTable.SMOOTHING_REACH * LEAF_M
    table, rough, points, normals, information = scene(count=900, half_m=3.0)
    corners, _ = table.leaf_vertices()
    whole = smoothed(table, rough, points, normals, information, iterations)
    # The half of it with x < 1: planes, cells and vertices.
    kept = points[:, 0] < 1.0
    cells = CellSet(LEAF_M)
    cells.insert_rays(points[kept], normals[kept], 0.4)
    half = VertexTable(cells.sorted_keys(), LEAF_M, 1, Encoding.OCTREE)
    own, _ = half.leaf_vertices()
    number = {tuple(corner): i for i, corner in enumerate(corners.tolist())}
    rows = [number[tuple(corner)] for corner in own.tolist()]
    part = smoothed(half, rough[rows], points[kept], normals[kept], information[kept], iterations)
    # Cells along a ray reach 0.4 m away from its point, and a place lies a leaf away from it.
    inner = own[:, 0] * LEAF_M < 1.0 - reach_m - 0.4 - 2 * LEAF_M
    assert inner.sum() > 100
    assert part[inner].tobytes() == whole[rows][inner].tobytes()
    assert (part[~inner] != whole[rows][~inner]).any()


def test_any_number_of_threads_gives_the_same_bits():
    table, rough, *planes = scene(count=20_000, half_m=8.0)
    assert table.num_rows > 2 * 2**13
    one = smoothed(table, rough, *planes, 5, num_threads=1)
    for num_threads in (2, 3):
        assert smoothed(table, rough, *planes, 5, num_threads=num_threads).tobytes() == one.tobytes()


def test_without_planes_it_only_bends_less():
    table, rough, *planes = scene()
    found = smoothed(table, rough, *(a[:0] for a in planes), 10)
    matrix, _ = system(table, *(a[:0] for a in planes))
    assert np.square(matrix @ found).sum() < 0.1 * np.square(matrix @ rough).sum()
    empty = VertexTable(np.zeros(0, np.uint64), LEAF_M, 1, Encoding.OCTREE)
    assert len(smoothed(empty, rough[:0], *planes, 3)) == 0


def test_no_vertex_leaves_its_known_side():
    table, rough, *planes = scene()
    sides = np.random.default_rng(1).integers(-1, 2, len(rough)).astype(np.int8)
    free = smoothed(table, rough, *planes, 24)
    kept = table.smoothed(rough, *planes, sides, 24)
    known = sides != 0
    assert (free[known] * sides[known] < 0).mean() > 0.3
    assert (kept[known] * sides[known]).min() >= np.float32(LEAF_M / 4)
    assert (kept[~known] != free[~known]).any()
    with pytest.raises(ValueError, match="sides"):
        table.smoothed(rough, *planes, sides[1:], 24)


def test_planes_of_the_two_sides_of_a_thin_wall_both_stay():
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(-0.9, 1, 0.2)] * 2))
    half_m = 0.08
    points = np.float32([[*p, z] for p in zip(x, y, strict=True) for z in (-half_m, half_m)])
    normals = np.float32([[0, 0, np.sign(z)] for z in points[:, 2]])
    cells = CellSet(LEAF_M)
    cells.insert_rays(points, normals, 0.4)
    table = VertexTable(cells.sorted_keys(), LEAF_M, 1, Encoding.OCTREE)
    corners, _ = table.leaf_vertices()
    z = corners[:, 2] * LEAF_M
    found = smoothed(
        table,
        np.zeros(len(z), np.float32),
        points,
        normals,
        np.full(len(z), 500, np.float32)[: len(points)],
        50,
    )
    inner = (np.abs(corners[:, :2]) < 4).all(axis=1)
    assert (found[inner & (np.abs(z) < 0.1)] < 0).all()
    assert (found[inner & (np.abs(z) > 0.1)] > 0).all()
