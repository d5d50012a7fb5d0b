# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Means in cells of several kinds, by place, direction and incidence."""

import numpy as np
import pytest
from radarsdf._core import CellMeans, cell_rows, fit_cell_means

KINDS = np.array([[4.0, 0, 0], [1.0, 0.2, 0], [1.0, 0, 0.1]])


def views(count=3000, seed=0):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    incidence = rng.uniform(0, np.pi / 2, count)
    incidence[::7] = np.nan
    arrays = rng.uniform(-6, 6, (count, 3)), directions, incidence
    return tuple(np.ascontiguousarray(a, np.float32) for a in arrays)


def bins(kind, points, directions, incidence, offset=0.0):
    """The cell of each view, as numbers that NumPy can compare."""
    edge, by_direction, by_incidence = kind
    columns = [np.floor(points.astype(float) / edge + offset)]
    if by_direction:
        columns.append(np.floor(directions.astype(float) / by_direction + offset + 0.37))
    if by_incidence:
        angle = np.floor(incidence.astype(float) / by_incidence + offset)
        columns.append(np.nan_to_num(angle, nan=-2)[:, None])
    return np.unique(np.concatenate(columns, 1), axis=0, return_inverse=True)[1].ravel()


def fitted_slowly(tiling, num_tilings, asked, values, weights, shrinkage, rounds):
    """What the definition says that the means of one tiling explain."""
    rows = [bins(kind, *asked, tiling / num_tilings) for kind in KINDS]
    means = [np.zeros(row.max() + 1) for row in rows]
    left, weight = values.astype(float), weights.astype(float)
    for turn in range(rounds):
        for row, mean in zip(rows, means, strict=True):
            left += mean[row]
            mean[:] = np.bincount(row, weight * left) / (np.bincount(row, weight) + shrinkage)
            left -= mean[row]
        if turn == 0 and rounds > 1:
            scale = 2 * np.sort(np.abs(left))[len(left) // 2]
            weight = weights / np.sqrt(1 + (left / scale) ** 2)
    return values - left


@pytest.mark.parametrize("rounds", [1, 2, 4])
def test_means_are_those_of_the_definition(rounds):
    asked = views()
    rng = np.random.default_rng(1)
    values = (asked[0][:, 0] + 3 * np.cos(np.nan_to_num(asked[2])) + rng.normal(size=3000)).astype(np.float32)
    weights = rng.uniform(0.5, 2, 3000).astype(np.float32)
    keys, means, explained = fit_cell_means(KINDS, 3, *asked, values, weights, 5.0, rounds)
    expected = np.mean([fitted_slowly(t, 3, asked, values, weights, 5.0, rounds) for t in range(3)], axis=0)
    assert expected.std() > 1
    np.testing.assert_allclose(explained, expected, rtol=0, atol=2e-6)
    answers = CellMeans(KINDS, 3, keys, means).sums(*asked)
    np.testing.assert_allclose(answers, expected, rtol=0, atol=5e-6)


def test_any_number_of_threads_has_the_same_bits():
    asked, values = views(20_000), np.random.default_rng(2).normal(size=20_000).astype(np.float32)
    fits = [fit_cell_means(KINDS, 4, *asked, values, np.ones_like(values), 3.0, 2, 0.0, n) for n in (1, 2, 5)]
    for other in fits[1:]:
        assert all((a == b).all() for a, b in zip(fits[0], other, strict=True))
    cells = CellMeans(KINDS, 4, *fits[0][:2])
    assert (cells.sums(*asked, 1) == cells.sums(*asked, 4)).all()


def test_small_means_are_left_out_of_what_is_found():
    asked, values = views(), np.random.default_rng(3).normal(size=3000).astype(np.float32)
    arguments = KINDS, 2, *asked, values, np.ones_like(values), 5.0, 2
    keys, means, explained = fit_cell_means(*arguments)
    large_keys, large_means, still_explained = fit_cell_means(*arguments, 0.1)
    kept = np.abs(means) >= np.float32(0.1)
    assert 0.1 < kept.mean() < 0.9
    np.testing.assert_array_equal(large_keys, keys[kept])
    np.testing.assert_array_equal(large_means, means[kept])
    np.testing.assert_array_equal(still_explained, explained)


def test_rows_number_the_cells_as_they_occur():
    asked = views()
    for kind in KINDS:
        rows, count = cell_rows(kind[None], *asked)
        expected = bins(kind, *asked)
        assert count == expected.max() + 1
        assert len(np.unique(np.stack([rows, expected], 1), axis=0)) == count
        first = np.unique(rows, return_index=True)[1]
        assert (np.diff(first) > 0).all()


def test_far_away_nothing_is_known():
    asked, ones = views(), np.ones(3000, np.float32)
    cells = CellMeans(KINDS, 2, *fit_cell_means(KINDS, 2, *asked, ones, ones, 1.0, 2)[:2])
    assert cells.sums(*asked).min() > 0.5
    points = np.array([[1e5, 0, 0], [3e38, 0, 0]], np.float32)
    assert cells.sums(points, asked[1][:2].copy(), asked[2][:2].copy()).tolist() == [0, 0]
