# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rows of cells by their keys, and sums over returns and over neighbouring cells."""

import numpy as np
import pytest
from radarsdf._core import DIRECTION_QUANTA, CellBlocks, cell_keys, principal_axes, sum_returns


def keys_of(cells):
    return cell_keys(np.asarray(cells, np.float64) + 0.5, 1.0)


def some_cells(seed=0):
    """Cells (C, 3) in the order of their keys: crowded, on both sides of the origin, and lonely far away."""
    rng = np.random.default_rng(seed)
    crowd, far = rng.integers(-6, 7, (700, 3)), rng.integers(-900_000, 900_000, (100, 3))
    cells = np.unique(np.concatenate([crowd, far]), axis=0)
    return cells[np.argsort(keys_of(cells))]


def test_rows_are_positions_and_absent_cells_have_none():
    cells = some_cells()
    blocks = CellBlocks(keys_of(cells))
    assert len(blocks) == len(cells)
    asked = np.concatenate([cells[::-1], some_cells(1)])
    row_of = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    expected = [row_of.get(tuple(cell), -1) for cell in asked.tolist()]
    assert -1 in expected
    assert blocks.rows(keys_of(asked)).tolist() == expected
    assert CellBlocks(np.zeros(0, np.uint64)).rows(keys_of(asked)).tolist() == [-1] * len(asked)


@pytest.mark.parametrize("columns", [3, 5])
@pytest.mark.parametrize("weight", [1.0, 0.7])
def test_sums_round_a_key(weight, columns):
    cells, asked = some_cells(), some_cells(1)
    values = np.random.default_rng(2).normal(size=(len(cells), columns))
    apart = np.abs(cells[None] - asked[:, None])
    weights = np.where(apart.max(axis=2) <= 1, weight ** apart.sum(axis=2), 0.0)
    blocks = CellBlocks(keys_of(cells))
    sums = blocks.neighbour_sums(keys_of(asked), values, weight)
    np.testing.assert_allclose(sums, weights @ values, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(sums, blocks.neighbour_sums(keys_of(asked), values, weight, num_threads=1))
    backwards = blocks.neighbour_sums(np.ascontiguousarray(keys_of(asked)[::-1]), values, weight)
    np.testing.assert_array_equal(sums, backwards[::-1])


def test_sums_over_the_returns_of_a_cell():
    rng = np.random.default_rng(0)
    count, num_cells, quantum_m = 50_000, 300, 1e-4  # enough for several threads
    points, directions = (rng.normal(size=(count, 3)).astype(np.float32) for _ in range(2))
    ranges_m = rng.uniform(1, 100, count).astype(np.float32)
    cells = rng.integers(0, num_cells - 1, count).astype(np.int32)  # the last stays empty
    corners = rng.integers(-5000, 5000, (num_cells, 3))
    x, y, z = (np.rint(points.astype(np.float64) / quantum_m).astype(np.int64) - corners[cells]).T
    along = np.rint(directions * DIRECTION_QUANTA).astype(np.int64).T
    ranges = np.rint(ranges_m.astype(np.float64) / quantum_m).astype(np.int64)
    ones = np.ones(count, np.int64)
    expected = np.zeros((num_cells, 14), np.int64)
    for k, column in enumerate([ones, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, *along, ranges]):
        np.add.at(expected[:, k], cells, column)
    for num_threads in (0, 1, 3):
        sums = sum_returns(points, directions, ranges_m, cells, corners, quantum_m, num_threads)
        np.testing.assert_array_equal(sums, expected)


def test_values_between_the_centres_of_cells():
    rng = np.random.default_rng(0)
    size_m, cells = 0.2, some_cells()
    blocks = CellBlocks(keys_of(cells))
    values = rng.uniform(0, 5, (len(cells), 2)).astype(np.float32)
    points = rng.uniform(-1.5, 1.5, (2000, 3)).astype(np.float32)
    value_of = {tuple(cell): value for cell, value in zip(cells.tolist(), values.astype(float), strict=True)}
    expected = []
    for u in points.astype(np.float64) / size_m - 0.5:
        lower = np.floor(u).astype(int)
        steps = np.array(list(np.ndindex(2, 2, 2)))
        weights = np.where(steps > 0, u - lower, 1 - (u - lower)).prod(axis=1)
        found = [value_of.get(tuple(cell), np.zeros(2)) for cell in (lower + steps).tolist()]
        expected.append(weights @ found)
    assert (np.ptp(expected, axis=0) > 3).all()
    result = blocks.interpolate(size_m, values, points)
    np.testing.assert_allclose(result, expected, atol=1e-4)
    for num_threads in (1, 3):
        assert blocks.interpolate(size_m, values, points, num_threads).tobytes() == result.tobytes()
    points[7] = np.nan
    with pytest.raises(ValueError, match="million cells"):
        blocks.interpolate(size_m, values, points)
    with pytest.raises(ValueError, match="values must have shape"):
        blocks.interpolate(size_m, values[1:], points)


def test_principal_axes_are_those_of_lapack():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(3000, 3, 3)) * 10.0 ** rng.uniform(-4, 4, (3000, 1, 3))
    matrices = np.concatenate(
        [
            a @ a.transpose(0, 2, 1),
            a + a.transpose(0, 2, 1),  # of both signs
            np.zeros((1, 3, 3)),
            np.eye(3)[None],
            np.diag([3.0, 1.0, 2.0])[None],
            np.ones((1, 3, 3)),
            1e-300 * (a[:1] @ a[:1].transpose(0, 2, 1)),
        ]
    )
    values, vectors = principal_axes(matrices)
    scale = np.abs(matrices).max(axis=(1, 2))[:, None]
    np.testing.assert_allclose(
        values / (scale + 1e-320), np.linalg.eigvalsh(matrices) / (scale + 1e-320), atol=1e-13
    )
    assert (np.diff(values, axis=1) >= 0).all()
    np.testing.assert_allclose(
        vectors.transpose(0, 2, 1) @ vectors, np.tile(np.eye(3), (len(a) * 2 + 5, 1, 1)), atol=1e-13
    )
    residual = matrices @ vectors - vectors * values[:, None, :]
    assert (np.abs(residual) <= 1e-13 * scale[:, None] + 1e-320).all()
    for num_threads in (1, 3):
        again = principal_axes(matrices, num_threads)
        assert all(x.tobytes() == y.tobytes() for x, y in zip(again, (values, vectors), strict=True))


def test_axes_of_what_is_not_finite_are_not_numbers():
    matrices = np.stack([np.eye(3)] * 3)
    matrices[1, 0, 2] = np.nan
    values, vectors = principal_axes(matrices)
    assert np.isnan(values[1]).all()
    assert np.isnan(vectors[1]).all()
    assert (values[[0, 2]] == 1).all()
    with pytest.raises(ValueError, match="shape"):
        principal_axes(np.zeros((2, 3)))
