"""Rays meet the first triangle, as a loop over all finds it, and cross the same cells and surfels as cell by cell."""

import numpy as np
import pytest
import trimesh
from radarsdf._core import SurfaceTracer, SurfelMap, cell_keys, find_free_space
from radarsdf.returns.view_statistics import FreeSpace


def unit_vectors(count, seed=0):
    vectors = np.random.default_rng(seed).standard_normal((count, 3))
    return (vectors / np.linalg.norm(vectors, axis=1)[:, None]).astype(np.float32)


def reference(vertices, faces, origin, directions, max_range_m=np.inf, *, front_only=False):
    """Distance to the nearest of all triangles, in float64."""
    first = np.full(len(directions), np.inf)
    for a, b, c in vertices[faces]:
        columns = np.stack(
            [np.broadcast_to(b - a, directions.shape), np.broadcast_to(c - a, directions.shape), -directions],
            2,
        )
        facing = np.einsum("ni,i->n", directions, np.cross(b - a, c - a)) < 0
        with np.errstate(all="ignore"):
            det = np.linalg.det(columns)
            ok = np.abs(det) > 1e-12
            columns[~ok] = np.eye(3)
            u, v, t = np.linalg.solve(columns, np.broadcast_to(origin - a, directions.shape)[..., None])[
                ..., 0
            ].T
        hit = ok & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= max_range_m)
        if front_only:
            hit &= facing
        first[hit] = np.minimum(first[hit], t[hit])
    return first


def soup(count=60, extent=4.0, size=1.0, seed=1):
    """Triangles of random position and orientation."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-extent, extent, (count, 1, 3)) + rng.uniform(-size, size, (count, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def agree(found, expected):
    """Equal, except rays that graze an edge."""
    same = np.isclose(found, expected, rtol=1e-5, atol=1e-4) | (np.isinf(found) & np.isinf(expected))
    return same.mean()


@pytest.mark.parametrize("size_m", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("front_only", [False, True])
@pytest.mark.parametrize("origin", [[0.0, 0.0, 0.0], [-9.0, 3.0, 1.0]])
def test_hits_are_on_the_nearest_triangle(size_m, front_only, origin):
    vertices, faces = soup(round(60 / size_m), size=size_m)
    # From outside, towards the triangles.
    directions = unit_vectors(600) + np.float32(0.3) * -np.array(origin, np.float32)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found, rows = SurfaceTracer(vertices, faces).first_hits(origin, directions, 50.0, front_only=front_only)
    expected = reference(
        vertices, faces, np.array(origin), directions.astype(np.float64), front_only=front_only
    )
    assert 0.03 < np.isfinite(expected).mean() < 0.99
    assert agree(found, expected) >= 0.998
    assert ((rows >= 0) == np.isfinite(found)).all()
    hit = rows >= 0
    places = np.array(origin) + directions[hit] * found[hit, None]
    a, b, c = np.moveaxis(vertices[faces[rows[hit]]], 1, 0)
    normals = np.cross(b - a, c - a)
    off_plane = np.abs(np.einsum("ni,ni->n", places - a, normals)) / np.linalg.norm(normals, axis=1)
    assert off_plane.max() < 1e-4


def test_ranges_are_accurate_at_grazing_incidence():
    x, y = np.meshgrid(np.arange(0, 60.5, 0.5), np.arange(-20, 20.5, 0.5), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    columns = x.shape[1]
    corner = (np.arange(x.shape[0] - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    lower = np.stack([corner, corner + columns, corner + 1], 1)
    upper = np.stack([corner + 1, corner + columns, corner + columns + 1], 1)
    tracer = SurfaceTracer(vertices, np.concatenate([lower, upper]).astype(np.int32))
    depression = np.linspace(0.03, 1.2, 5000)
    directions = np.stack([np.cos(depression), np.zeros(5000), -np.sin(depression)], 1).astype(np.float32)
    found, _ = tracer.first_hits([0.0, 0.3, 1.5], directions, 100.0)
    np.testing.assert_allclose(found, 1.5 / np.sin(depression), rtol=1e-5)


def test_ranges_end_at_the_limit():
    vertices = np.array([[5.0, -1, -1], [5, 1, -1], [5, 0, 1]])
    tracer = SurfaceTracer(vertices, np.array([[0, 1, 2]], np.int32))
    ahead = np.array([[1, 0, 0]], np.float32)
    for limit, found in ((4.99, np.inf), (5.01, 5.0), (np.inf, 5.0), (0.0, np.inf)):
        assert tracer.first_hits([0, 0, 0], ahead, limit)[0][0] == pytest.approx(found)
    assert tracer.first_hits([0, 0, 0], -ahead, 100.0)[0][0] == np.inf


@pytest.mark.parametrize("distance_m", [0.0, 4.9, 300.0])
def test_no_ray_passes_between_adjacent_triangles(distance_m):
    ball = trimesh.creation.icosphere(subdivisions=5, radius=5.0)
    vertices = np.array(ball.vertices)
    tracer = SurfaceTracer(vertices, np.array(ball.faces, np.int32))
    origin = np.array([0.6, 0.0, 0.8]) * distance_m
    edges = vertices[ball.edges_unique]
    share = np.random.default_rng(0).uniform(0, 1, (len(edges), 1))
    share[::10] = 0  # through vertices
    target = edges[:, 0] + share * (edges[:, 1] - edges[:, 0])
    away = target - origin
    ranges_m = np.linalg.norm(away, axis=1)
    # Not at the boundary, where both sides end.
    seen = np.abs(np.einsum("ni,ni->n", away, target)) > 0.1 * 5 * ranges_m
    seen &= (distance_m < 5) | (np.einsum("ni,ni->n", away, target) < 0)
    away, ranges_m = away[seen], ranges_m[seen]
    found, _ = tracer.first_hits(origin, (away / ranges_m[:, None]).astype(np.float32), 1e3)
    assert len(found) > 10_000
    np.testing.assert_allclose(found, ranges_m, atol=0.02)


def test_the_same_bits_with_any_number_of_threads_and_in_any_order():
    vertices, faces = soup(400, 8.0)
    tracer = SurfaceTracer(vertices, faces, num_threads=1)
    directions = unit_vectors(30_000)
    alone = tracer.first_hits([0, 0, 0], directions, 50.0, num_threads=1)
    for threads in (2, 5):
        order = np.random.default_rng(threads).permutation(len(directions))
        shared = SurfaceTracer(vertices, faces, num_threads=threads)
        for given in (slice(None), order):
            found = shared.first_hits([0, 0, 0], directions[given], 50.0, num_threads=threads)
            for ours, theirs in zip(found, alone, strict=True):
                np.testing.assert_array_equal(ours, theirs[given])


def test_ranges_are_exact_far_from_the_origin_of_the_frame():
    vertices, faces = soup(50)
    moved = np.array([40_000.0, -30_000.0, 500.0])
    directions = unit_vectors(2000)
    near = SurfaceTracer(vertices, faces).first_hits([0, 0, 0], directions, 50.0)
    far = SurfaceTracer(vertices + moved, faces).first_hits(moved, directions, 50.0)
    same = near[1] == far[1]
    assert same.mean() > 0.999
    np.testing.assert_allclose(near[0][same], far[0][same], atol=2e-5)


def test_far_apart_triangles_need_little_memory():
    near, faces = soup(20)
    vertices = np.concatenate([near, near + [1e6, 1e6, 1e3]])
    tracer = SurfaceTracer(vertices, np.concatenate([faces, faces + len(near)]).astype(np.int32))
    assert tracer.nbytes < 200e6
    directions = unit_vectors(500)
    found, _ = tracer.first_hits([0, 0, 0], directions, 50.0)
    assert agree(found, reference(near, faces, np.zeros(3), directions.astype(np.float64))) >= 0.99


LEAF_M = 0.2
LIMIT = 10**6
LOWER, SHAPE = np.array([-45, -45, -45]), (90, 90, 90)


def rays_of(count, scans):
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges_m = rng.uniform(0.5, 8, count)
    sensors = rng.uniform(-0.5, 0.5, (scans, 3))
    of = np.sort(rng.integers(0, scans, count)).astype(np.int32)
    points = sensors[of] + directions * ranges_m[:, None]
    passed_m = ranges_m - rng.uniform(0, 2, count)  # some end behind the sensor
    return *(a.astype(np.float32) for a in (points, directions, ranges_m, passed_m)), of


def found(rays, num_threads=1, lower=(-LIMIT,) * 3, upper=(LIMIT,) * 3):
    return FreeSpace(*find_free_space(*rays, LEAF_M, list(lower), list(upper), num_threads))


def searched(points, directions, ranges_m, passed_m, scans):
    """Numbers of scans that cross each cell, in steps of a millimetre, and cells with returns."""
    passed, returns = np.zeros(SHAPE, int), np.zeros(SHAPE, bool)
    for scan in np.unique(scans):
        seen = np.zeros(SHAPE, bool)
        for i in np.flatnonzero(scans == scan):
            along = np.arange(0, max(float(passed_m[i]), 0), 1e-3) - float(ranges_m[i])
            x = points[i].astype(float) + directions[i].astype(float) * along[:, None]
            seen[tuple(np.floor(x / LEAF_M).astype(int).T - LOWER[:, None])] = True
        passed += seen
    returns[tuple(np.floor(points.astype(float) / LEAF_M).astype(int).T - LOWER[:, None])] = True
    return np.minimum(passed, 7), returns


def test_crossings_equal_a_plain_search():
    rays = rays_of(300, 9)
    free_space = found(rays)
    free_space.check()
    passed, returns = free_space.dense(LOWER, SHAPE)
    expected, expected_returns = searched(*rays)
    np.testing.assert_array_equal(returns, expected_returns)
    # Steps miss corners of cells, and traversals of converging rays end early: few cells, of one scan each.
    wrong = passed != expected
    assert wrong.sum() < 0.03 * (expected > 0).sum()
    assert np.abs(passed.astype(int) - expected)[wrong].max() == 1
    assert expected.max() == 7 == passed.max()


def test_threads_change_no_bit_and_a_box_omits_blocks():
    rays = rays_of(6000, 40)
    one = found(rays)
    for num_threads in (2, 5):
        many = found(rays, num_threads)
        np.testing.assert_array_equal(many.keys, one.keys)
        np.testing.assert_array_equal(many.planes, one.planes)
    part = found(rays, 2, (-8, -8, -8), (8, 8, 8))
    assert 0 < len(part.keys) < len(one.keys)
    (passed, returns), (of_all, all_returns) = (kind.dense([-8] * 3, (16,) * 3) for kind in (part, one))
    np.testing.assert_array_equal(returns, all_returns)
    # Cells outside do not count as crossed, so that some rays are traversed farther in the box.
    assert (passed >= of_all).all()
    assert (passed > of_all).mean() < 0.1
    cells = np.random.default_rng(0).integers(-60, 60, (2000, 3))
    dense, _ = one.dense([-60] * 3, (120,) * 3)
    keys = cell_keys(((cells + 0.5) * LEAF_M).astype(np.float32), LEAF_M)
    np.testing.assert_array_equal(one.at(keys), dense[tuple((cells + 60).T)])


CELL_M = 0.5  # a power of two, so that rays along borders of cells meet these exactly
MARGIN_M = 0.1
SLACK_M = 0.25 * CELL_M


def a_scene(seed):
    """Surfels in clusters of cells with empty space in between: keys and rows (M, 8)."""
    rng = np.random.default_rng(seed)
    clusters = [
        centre + rng.integers(-4, 5, (300, 3)) for centre in rng.integers(-60, 60, (60, 3)) * [1, 1, 0.2]
    ]
    cells = np.unique(np.floor(np.concatenate(clusters)), axis=0)
    keys = cell_keys((cells + 0.5) * CELL_M, CELL_M)
    cells = cells[np.argsort(keys)]
    normals = rng.normal(size=cells.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.concatenate(
        [(cells + rng.random(cells.shape)) * CELL_M, normals, np.tile([[0, np.inf]], (len(cells), 1))], 1
    )
    return np.sort(keys), rows.astype(np.float32)


def rays_across(kind, count, seed):
    """Points, directions, ranges, float32."""
    rng = np.random.default_rng(seed)
    sensors = rng.uniform(-35, 35, (count, 3)) * [1, 1, 0.2]
    directions = rng.normal(size=(count, 3)) * [1, 1, 0.2]
    if kind in ("along axes", "along borders"):
        directions = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
    if kind == "through edges":  # every step crosses two or three faces at once
        directions = rng.choice([-1.0, 0.0, 1.0], (count, 3))
        directions[~directions.any(axis=1)] = [1, 1, -1]
    if kind in ("along borders", "through edges"):
        sensors = np.round(sensors / CELL_M) * CELL_M
    if kind == "grazing":  # next to a border
        directions = directions * [1, 1e-7, 1e-6]
        sensors[:, 1:] = np.round(sensors[:, 1:] / CELL_M) * CELL_M
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges_m = rng.uniform(0, 90, count)
    ranges_m[:3] = 0, 1e-3, CELL_M
    points = sensors + directions * ranges_m[:, None]
    return tuple(a.astype(np.float32) for a in (points, directions, ranges_m))


def first_crossing(row_of_cell, surfels, point, direction, range_m):
    """A plain traversal of one ray, cell by cell, with distances of faces from the sensor."""
    start = (point.astype(np.float64) - float(range_m) * direction.astype(np.float64)) / CELL_M
    speed = direction.astype(np.float64) / CELL_M
    cell, begin_m = np.floor(start).astype(int), 0.0
    per_cell_m = [1 / v if v else np.inf for v in speed]
    step = np.where(speed >= 0, 1, -1)
    while begin_m < range_m:
        ends_m = [(cell[k] + (step[k] > 0) - start[k]) * per_cell_m[k] for k in range(3)]
        axis = int(np.argmin(ends_m))  # the first in case of ties
        row = row_of_cell.get(tuple(cell.tolist()), -1)
        if row >= 0:
            centre, normal = surfels[row, :3], surfels[row, 3:6]
            cosine, depth_m = -(normal @ direction), -(normal @ (point - centre))
            if cosine > 0 and depth_m > MARGIN_M:
                at_m = range_m - depth_m / cosine
                if begin_m - SLACK_M <= at_m <= ends_m[axis] + SLACK_M:
                    return row
        begin_m = ends_m[axis]
        cell[axis] += step[axis]
    return -1


@pytest.mark.parametrize("kind", ["any", "along axes", "along borders", "through edges", "grazing"])
def test_skipping_empty_space_equals_a_plain_traversal(kind):
    keys, surfels = a_scene(seed=len(kind))
    cells = np.floor(surfels[:, :3] / CELL_M).astype(int)
    row_of_cell = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    rays = rays_across(kind, 400, seed=1)
    expected = [first_crossing(row_of_cell, surfels, *ray) for ray in zip(*rays, strict=True)]
    assert 0.05 < np.mean(np.array(expected) >= 0) < 0.95
    for num_threads in (1, 2):
        found = SurfelMap(keys, surfels, CELL_M).first_crossings(*rays, 0.0, 0.0, MARGIN_M, 0.0, num_threads)
        np.testing.assert_array_equal(found, expected)


def test_the_last_of_ten_cells_of_a_block_is_searched():
    """A line crosses up to ten cells of a block; here only the last one holds a surfel."""
    direction = np.full(3, 3**-0.5)
    # In the cell (3, 3, 3), behind nine empty ones of its block.
    crossing = np.array([3.6, 3.5, 3.4]) * CELL_M
    surfels = np.concatenate([crossing, -direction, [0, np.inf]])[None].astype(np.float32)
    keys = cell_keys(crossing[None], CELL_M)
    points = (crossing + 5 * CELL_M * direction)[None].astype(np.float32)
    ranges_m = np.array([40 * CELL_M], np.float32)
    ray = points, direction[None].astype(np.float32), ranges_m
    assert SurfelMap(keys, surfels, CELL_M).first_crossings(*ray, 0.0, 0.0, MARGIN_M, 0.0).tolist() == [0]


def test_rays_from_far_away_and_past_everything():
    keys, surfels = a_scene(seed=0)
    surfel_map = SurfelMap(keys, surfels, CELL_M)
    normal, centre = surfels[:1, 3:6], surfels[:1, :3]
    points, ranges_m = centre - 0.3 * normal, np.array([30_000.0], np.float32)
    # The resolution of float32 at such sensor positions moves the ray by millimetres.
    assert surfel_map.first_crossings(points, -normal, ranges_m, 0.0, 0.0, MARGIN_M, 0.0)[0] >= 0
    beyond = np.array([[0, 0, 500.0]], np.float32)
    along = np.array([[1.0, 0, 0]], np.float32)
    assert surfel_map.first_crossings(beyond, along, ranges_m, 0.0, 0.0, MARGIN_M, 0.0).tolist() == [-1]
