"""Visibility counts, and numbers of scans with returns."""

import numpy as np
import pytest
from radarsdf._core import cell_keys, count_scans, count_visibility

from ..reference_visibility import CUBE_CELLS, looks_at

LEAF_M = 0.2
CUBE_M = CUBE_CELLS * LEAF_M
THREADS = (1, 2, 3, 7)
MANY = 10_000  # enough for several threads


def rays_of(kind, count, seed=0):
    """Points, directions, ranges, float32."""
    rng = np.random.default_rng(seed)
    sensors = rng.uniform(-15, 15, (count, 3))
    directions = rng.normal(size=(count, 3))
    if kind == "along axes":
        directions = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
    if kind == "in planes":  # one coordinate is constant
        directions[np.arange(count), rng.integers(0, 3, count)] = 0
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges_m = rng.uniform(0, 25, count)
    if kind == "short":  # most end in the cube of their sensor
        ranges_m = rng.uniform(0, 0.5 * CUBE_M, count)
        ranges_m[::7] = 0
    if kind == "far":
        sensors += [-190_000.0, 170_000.0, -150_000.0]
    points = sensors + directions * ranges_m[:, None]
    return tuple(a.astype(np.float32) for a in (points, directions, ranges_m))


def cells_near(points, seed=0):
    """Leaf cells (C, 3), a few in about every fourth cube with points, some far from them, in the order of their keys; and the keys."""
    rng = np.random.default_rng(seed)
    middle = np.round(np.median(points, axis=0) / LEAF_M).astype(int)
    near = middle + rng.integers(-80, 80, (1500, 3))
    beside = near[:500] + rng.integers(0, 2, (500, 3))
    far = middle + rng.integers(2000, 4000, (50, 3))
    cells = np.unique(np.concatenate([near, beside, far]), axis=0)
    keys = cell_keys((cells + 0.5) * LEAF_M, LEAF_M)
    order = np.argsort(keys)
    return cells[order], keys[order]


def scans_of(count, seed=0):
    """(N,) int32: scans of a few returns, one with more than half of all, and numbers without returns."""
    rng = np.random.default_rng(seed)
    scans = rng.integers(0, 400, count) * 3
    scans[rng.random(count) < 0.6] = 600
    return np.sort(scans).astype(np.int32)


@pytest.mark.parametrize("kind", ["any", "along axes", "in planes", "short", "far"])
def test_visibility_equals_a_plain_search(kind):
    rays = rays_of(kind, 3000)
    cells, keys = cells_near(rays[0])
    scans = np.sort(np.random.default_rng(1).integers(0, 30, 3000)).astype(np.int32)
    expected = looks_at(cells, LEAF_M, *rays, scans)
    assert (expected == 0).mean() > 0.02
    assert expected.max() > 3
    visibility = count_visibility(keys, LEAF_M, *rays, scans)
    assert visibility.dtype == np.uint32
    np.testing.assert_array_equal(visibility, expected)


def test_results_do_not_depend_on_threads():
    rays, scans = rays_of("any", MANY), scans_of(MANY)
    cells, keys = (a[::8] for a in cells_near(rays[0]))
    keys = np.ascontiguousarray(keys)
    expected = looks_at(cells, LEAF_M, *rays, scans)
    assert len(np.unique(expected)) > 5
    for num_threads in THREADS:
        np.testing.assert_array_equal(count_visibility(keys, LEAF_M, *rays, scans, num_threads), expected)


@pytest.mark.parametrize("num_cells", [1, 300, 40_000])
def test_scans_of_cells_are_counted_once(num_cells):
    rng = np.random.default_rng(num_cells)
    cells, scans = rng.integers(0, num_cells, MANY).astype(np.int32), scans_of(MANY)
    pairs = np.unique(np.stack([cells, scans], 1), axis=0)
    expected = np.bincount(pairs[:, 0], minlength=num_cells)
    for num_threads in (0, *THREADS):
        counts = count_scans(cells, scans, num_cells, num_threads)
        assert counts.dtype == np.uint32
        np.testing.assert_array_equal(counts, expected)
