# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rays that skip empty space cross what rays cross that are walked cell by cell."""

import numpy as np
import pytest
from radarsdf._core import SurfelMap, cell_keys

CELL_M = 0.5  # a power of two, so that rays along borders of cells meet these exactly
MARGIN_M = 0.1
SLACK_M = 0.25 * CELL_M


def a_scene(seed):
    """Surfels in cells that are crowded in places, with nothing in between: keys and rows (M, 8)."""
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


def rays_of(kind, count, seed):
    """Points, directions, ranges, float32."""
    rng = np.random.default_rng(seed)
    sensors = rng.uniform(-35, 35, (count, 3)) * [1, 1, 0.2]
    directions = rng.normal(size=(count, 3)) * [1, 1, 0.2]
    if kind in ("along axes", "along borders"):
        directions = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
    if kind == "through edges":  # two or three faces are met at once, at every step
        directions = rng.choice([-1.0, 0.0, 1.0], (count, 3))
        directions[~directions.any(axis=1)] = [1, 1, -1]
    if kind in ("along borders", "through edges"):
        sensors = np.round(sensors / CELL_M) * CELL_M
    if kind == "grazing":  # just beside a border
        directions = directions * [1, 1e-7, 1e-6]
        sensors[:, 1:] = np.round(sensors[:, 1:] / CELL_M) * CELL_M
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges_m = rng.uniform(0, 90, count)
    ranges_m[:3] = 0, 1e-3, CELL_M
    points = sensors + directions * ranges_m[:, None]
    return tuple(a.astype(np.float32) for a in (points, directions, ranges_m))


def first_crossing(row_of_cell, surfels, point, direction, range_m):
    """A plain walk, cell by cell, of one ray; a face's distance is that from the sensor."""
    start = (point.astype(np.float64) - float(range_m) * direction.astype(np.float64)) / CELL_M
    speed = direction.astype(np.float64) / CELL_M
    cell, begin_m = np.floor(start).astype(int), 0.0
    per_cell_m = [1 / v if v else np.inf for v in speed]
    step = np.where(speed >= 0, 1, -1)
    while begin_m < range_m:
        ends_m = [(cell[k] + (step[k] > 0) - start[k]) * per_cell_m[k] for k in range(3)]
        axis = int(np.argmin(ends_m))  # the first of those that are equally near
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
def test_skipping_finds_what_a_plain_walk_finds(kind):
    keys, surfels = a_scene(seed=len(kind))
    cells = np.floor(surfels[:, :3] / CELL_M).astype(int)
    row_of_cell = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    rays = rays_of(kind, 400, seed=1)
    expected = [first_crossing(row_of_cell, surfels, *ray) for ray in zip(*rays, strict=True)]
    assert 0.05 < np.mean(np.array(expected) >= 0) < 0.95
    for num_threads in (1, 2):
        found = SurfelMap(keys, surfels, CELL_M).first_crossings(*rays, 0.0, 0.0, MARGIN_M, 0.0, num_threads)
        np.testing.assert_array_equal(found, expected)


def test_rays_from_far_away_and_past_everything():
    keys, surfels = a_scene(seed=0)
    surfel_map = SurfelMap(keys, surfels, CELL_M)
    normal, centre = surfels[:1, 3:6], surfels[:1, :3]
    points, ranges_m = centre - 0.3 * normal, np.array([30_000.0], np.float32)
    # What float32 leaves of such a sensor's position moves the ray by millimetres.
    assert surfel_map.first_crossings(points, -normal, ranges_m, 0.0, 0.0, MARGIN_M, 0.0)[0] >= 0
    beyond = np.array([[0, 0, 500.0]], np.float32)
    along = np.array([[1.0, 0, 0]], np.float32)
    assert surfel_map.first_crossings(beyond, along, ranges_m, 0.0, 0.0, MARGIN_M, 0.0).tolist() == [-1]
