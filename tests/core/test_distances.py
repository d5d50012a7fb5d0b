"""Average distances over rays, and smoothed ones, against their definition and their least sum of squares."""

import itertools

import numpy as np
import pytest
import torch
import trimesh
from radarsdf import _core
from radarsdf._core import CellBlocks, CellSet, Encoding, VertexTable, cell_keys, vertex_areas
from radarsdf.field.field import GridField
from radarsdf.map.marching_cubes import sparse_lattice
from scipy.linalg import lstsq
from scipy.spatial import cKDTree

LEAF_M = 0.2


def scene(seed=0, count=300, half_m=1.2, lower=0.0):
    """A table around a wavy surface, noisy planes on it, and rough distances at its vertices."""
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
    """Distances by ``table.smoothed`` without known sides. `planes`: including the iterations."""
    *arrays, iterations = planes
    return table.smoothed(distances, *arrays, np.zeros(len(distances), np.int8), iterations, **threads)


def system(table, points, normals, information):
    """Rows A and targets b of the sum of squares |A d - b|² minimised by the core."""
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
                continue  # two adjacent vertices without a common cell
            if before is not None and after is not None:
                row = np.zeros(len(corners))
                row[[before, i, after]] = 1, -2, 1
                rows.append(row)
                targets.append(0.0)
    return np.array(rows), np.array(targets)


def test_iterations_converge_to_the_least_squares_solution():
    table, rough, *planes = scene(count=150, half_m=0.8)
    matrix, targets = system(table, *planes)
    # NumPy's takes singular values, ten times as long.
    least = lstsq(matrix, targets, lapack_driver="gelsy")[0]

    def sum_of_squares(distances):
        return np.square(matrix @ distances - targets).sum()

    sums = [sum_of_squares(smoothed(table, rough, *planes, iterations)) for iterations in (0, 4, 24)]
    again = smoothed(table, smoothed(table, rough, *planes, 50), *planes, 50)
    sums.append(sum_of_squares(again))
    assert sums[0] == sum_of_squares(rough)
    assert sums == sorted(sums, reverse=True)
    # Errors shrink to 1 / cosh(4), except in nearly unobservable directions.
    assert sums[2] - sum_of_squares(least) < (sums[0] - sum_of_squares(least)) / np.cosh(4) ** 2
    assert sums[3] < 1.0001 * sum_of_squares(least)


def test_distances_depend_only_on_data_within_reach():
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
    # Cells along a ray extend 0.4 m from its point, and points of planes are a leaf cell away from it.
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


def test_planes_of_both_faces_of_a_thin_wall_are_kept():
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


def test_cells_along_rays_are_the_cells_crossed():
    points, directions, *_ = some_rays(60)
    reach_m = 0.7
    for point, direction in zip(points, directions, strict=True):
        keys = keys_along(point[None], direction[None], reach_m)
        steps = point + np.linspace(-reach_m, reach_m, 20_001)[:, None] * direction.astype(np.float64)
        fraction = steps / LEAF_M - np.floor(steps / LEAF_M)
        inside = ((fraction > 1e-4) & (fraction < 1 - 1e-4)).all(axis=1)  # where rounding cannot decide
        assert np.isin(cell_keys(np.ascontiguousarray(steps[inside]), LEAF_M), keys).all()
        for key in keys:  # and no others: the segment crosses each, within rounding
            low = np.array(lattice(key)) * LEAF_M - 1e-5
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = (np.stack([low, low + LEAF_M + 2e-5]) - point) / direction.astype(np.float64)
            ends = np.where(direction == 0, np.array([[-np.inf], [np.inf]]), np.sort(ends, axis=0))
            assert max(ends[0].max(), -reach_m) <= min(ends[1].min(), reach_m)


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
    # Interpolation at a vertex, slightly inside one of its cells, gives its feature.
    features = np.random.default_rng(0).normal(size=(table.num_rows, 8)).astype(np.float32)
    inside = (coordinates[of_cells] + np.where(steps > 0, -1e-4, 1e-4)) * LEAF_M
    x = np.ascontiguousarray(inside.reshape(-1, 3), np.float32)
    located, out = np.empty((len(x), 1), np.int32), np.empty((len(x), 8), np.float32)
    table.encode(features, x, located, out)
    np.testing.assert_allclose(out, features[of_cells.ravel()], atol=5e-3)


def reference(table, points, directions, normals, weights, truncation_m):
    """Averages by vertex, in float64, over the cells of :func:`keys_along`."""
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
def test_the_average_equals_the_reference(num_levels):
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
    # Another order of sums, and no ray lost between groups.
    backwards = [np.ascontiguousarray(a[::-1]) for a in rays]
    np.testing.assert_allclose(table.average_rays(*backwards, 0.6)[0], one, atol=1e-5)


def test_sides_need_many_rays_in_front_and_more_behind():
    x, y = np.meshgrid(*[np.arange(-0.95, 1, 0.1)] * 2)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.03)]).astype(np.float32)
    down = np.tile(np.float32([0, 0, -1]), (x.size, 1))
    table = VertexTable(keys_along(points, down, 0.6), LEAF_M, 1, Encoding.OCTREE)
    corners, _ = table.leaf_vertices()
    inner = (np.abs(corners[:, :2]) < 5).all(axis=1)
    height_m = corners[inner, 2] * LEAF_M - 0.03
    # 16 rays in the four columns of cells at a vertex, each once or twice.
    for weight, in_front, behind in ((1, 0, 0), (8, 1, 0), (64, 1, -1)):
        weights = np.full(x.size, weight, np.float32)
        _, sides = table.average_rays(points, down, -down, weights, 0.6)
        expected = np.where(height_m > LEAF_M, in_front, np.where(height_m < -LEAF_M, behind, 0))
        np.testing.assert_array_equal(sides[: len(corners)][inner], expected)


EDGE_M = 0.25


def grid_field(cells, seed=0):
    """A field of random distances on leaf cells with these coordinates (C, 3)."""
    centres = np.ascontiguousarray((np.asarray(cells) + 0.5) * EDGE_M, np.float32)
    field = GridField(np.unique(cell_keys(centres, EDGE_M)), EDGE_M)
    with torch.no_grad():
        field.distances_m.copy_(
            torch.randn(field.table.num_rows, generator=torch.Generator().manual_seed(seed))
        )
    return field


def surface(field, parts, lowest=(-99,) * 3, highest=(99,) * 3, num_threads=1):
    distances_m = field.corner_distances_m()
    rows = field.table.cells_near_surface(distances_m, 0.0, num_threads)
    return field.table.surface(distances_m, rows, parts, EDGE_M / parts, lowest, highest, num_threads)


def expected_surface(field, parts, lowest, highest):
    """The surface from interpolation at the corners of all voxels."""
    inside = np.indices((parts,) * 3).reshape(3, -1).T
    voxels = (field.table.leaf_cells()[:, None] * parts + inside).reshape(-1, 3)
    voxels = voxels[((voxels >= lowest) & (voxels <= highest)).all(axis=1)]
    voxels, corners, voxel_corners = sparse_lattice(voxels)
    centres, at = np.zeros((2, len(corners), 3))
    at[voxel_corners] = corners[voxel_corners]
    centres[voxel_corners] = voxels[:, None] + 0.5
    inside = (at + 1e-5 * (centres - at)) * (EDGE_M / parts)  # beyond a face, there may be no cell
    values = field.sdf(torch.from_numpy(inside.astype(np.float32))).detach().numpy()
    return _core.marching_cubes_sparse(corners, values, voxel_corners, [EDGE_M / parts] * 3, [0.0] * 3, 0.0)


@pytest.mark.parametrize("parts", [1, 2, 3, 4])
@pytest.mark.parametrize(("lowest", "highest"), [((-99,) * 3, (99,) * 3), ((-3, -2, -9), (5, 7, 4))])
def test_the_surface_between_corners_is_that_of_all_voxels(parts, lowest, highest):
    field = grid_field(np.random.default_rng(1).integers(-3, 3, (120, 3)))
    vertices, faces = surface(field, parts, lowest, highest)
    expected_vertices, expected_faces = expected_surface(field, parts, lowest, highest)
    assert len(vertices) == len(expected_vertices)
    assert len(faces) == len(expected_faces) > 30
    off_m, rows = cKDTree(expected_vertices).query(vertices)
    assert off_m.max() < 1e-4
    assert len(np.unique(rows)) == len(rows)
    turned = [np.roll(face, -np.argmin(face)).tolist() for face in rows[faces]]
    assert sorted(turned) == sorted(np.roll(face, -np.argmin(face)).tolist() for face in expected_faces)
    for threads in (2, 3):
        again = surface(field, parts, lowest, highest, threads)
        assert [array.tobytes() for array in again] == [vertices.tobytes(), faces.tobytes()]


def test_cells_near_the_surface_have_corners_near_it_or_on_both_sides():
    field = grid_field(np.indices((5, 5, 5)).reshape(3, -1).T - 2)
    distances_m = field.corner_distances_m()
    of_cells = distances_m[field.table.leaf_vertices()[1]]
    for margin_m in (0.0, 0.5):
        expected = (of_cells.min(axis=1) <= margin_m) & (of_cells.max(axis=1) >= -margin_m)
        found = field.table.cells_near_surface(distances_m, margin_m, 2)
        np.testing.assert_array_equal(found, np.flatnonzero(expected))
    distances_m[of_cells.argmax() // 8] = np.nan
    unknown = np.isnan(distances_m[field.table.leaf_vertices()[1]]).any(axis=1)
    assert unknown.any()
    assert not unknown[field.table.cells_near_surface(distances_m, 0.0)].any()


def test_areas_at_vertices_are_thirds_of_the_triangles():
    mesh = trimesh.creation.icosphere(2)
    found = vertex_areas(mesh.vertices.copy(), mesh.faces.astype(np.int32))
    assert found.sum() == pytest.approx(mesh.area)
    expected = np.zeros(len(mesh.vertices))
    np.add.at(expected, mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3))
    np.testing.assert_allclose(found, expected)
