# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which leaf cells rays passed, beside a plain search."""

import numpy as np
from radarsdf._core import cell_keys, find_free_space
from radarsdf.returns.free_space import FreeSpace

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
    """Scans that passed each cell, by steps of a millimetre, and the cells with returns."""
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


def test_crossings_are_those_of_a_plain_search():
    rays = rays_of(300, 9)
    free_space = found(rays)
    free_space.check()
    passed, returns = free_space.dense(LOWER, SHAPE)
    expected, expected_returns = searched(*rays)
    np.testing.assert_array_equal(returns, expected_returns)
    # A step misses corners of cells, and rays that come together are not followed on: few cells, of one scan each.
    wrong = passed != expected
    assert wrong.sum() < 0.03 * (expected > 0).sum()
    assert np.abs(passed.astype(int) - expected)[wrong].max() == 1
    assert expected.max() == 7 == passed.max()


def test_threads_make_no_difference_and_a_box_leaves_out_blocks():
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
    # What lies outside does not count as passed, so that some rays are followed farther in the box.
    assert (passed >= of_all).all()
    assert (passed > of_all).mean() < 0.1
    cells = np.random.default_rng(0).integers(-60, 60, (2000, 3))
    dense, _ = one.dense([-60] * 3, (120,) * 3)
    keys = cell_keys(((cells + 0.5) * LEAF_M).astype(np.float32), LEAF_M)
    np.testing.assert_array_equal(one.at(keys), dense[tuple((cells + 60).T)])
