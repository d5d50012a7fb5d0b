"""Rows of cells by key, and sums over returns and over neighbourhoods."""

import itertools

import numpy as np
import pytest
from radarsdf._core import (
    DIRECTION_QUANTA,
    QUANTA,
    CellBlocks,
    CellMeans,
    CellSet,
    block_medians,
    cell_keys,
    fit_cell_means,
    gather_rows,
    principal_axes,
    stable_order,
    sum_returns,
)
from radarsdf.map.marching_cubes import sparse_lattice


def keys_of(cells):
    return cell_keys(np.asarray(cells, np.float64) + 0.5, 1.0)


def some_cells(seed=0):
    """Cells (C, 3) in the order of their keys: dense on both sides of the origin, and isolated far away."""
    rng = np.random.default_rng(seed)
    crowd, far = rng.integers(-6, 7, (700, 3)), rng.integers(-900_000, 900_000, (100, 3))
    cells = np.unique(np.concatenate([crowd, far]), axis=0)
    return cells[np.argsort(keys_of(cells))]


def test_rows_are_positions_of_keys_and_absent_cells_have_none():
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
def test_neighbour_sums_equal_a_plain_loop(weight, columns):
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
    count, num_cells, leaf_m = 50_000, 300, 0.2  # enough for several threads
    quantum_m = leaf_m / QUANTA
    points, directions = (rng.normal(size=(count, 3)).astype(np.float32) for _ in range(2))
    ranges_m = rng.uniform(1, 100, count).astype(np.float32)
    cells = rng.integers(0, num_cells - 1, count).astype(np.int32)  # the last stays empty
    lattice = rng.integers(-20, 20, (num_cells, 3))
    x, y, z = (np.rint(points.astype(np.float64) / quantum_m).astype(np.int64) - QUANTA * lattice[cells]).T
    along = np.rint(directions * DIRECTION_QUANTA).astype(np.int64).T
    ranges = np.rint(ranges_m.astype(np.float64) / quantum_m).astype(np.int64)
    ones = np.ones(count, np.int64)
    expected = np.zeros((num_cells, 14), np.int64)
    for k, column in enumerate([ones, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, *along, ranges]):
        np.add.at(expected[:, k], cells, column)
    for num_threads in (0, 1, 3):
        sums = sum_returns(points, directions, ranges_m, cells, keys_of(lattice), leaf_m, num_threads)
        np.testing.assert_array_equal(sums, expected)


def test_medians_of_blocks():
    rng = np.random.default_rng(0)
    # Several tasks, and blocks across their ends.
    keys = np.unique(keys_of(rng.integers(-40, 40, (60_000, 3))))
    values, block = rng.integers(0, 9, len(keys)).astype(float), keys >> np.uint64(9)
    values[block == block[100]] = 0
    medians = block_medians(keys, values, 3, 1)
    np.testing.assert_array_equal(medians, block_medians(keys, values, 3, 3))
    for own in np.unique(block):
        positive = values[(block == own) & (values > 0)]
        expected = np.median(positive) if len(positive) else 0
        assert (medians[block == own] == expected).all()


def test_values_are_interpolated_between_the_centres_of_cells():
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


def test_principal_axes_equal_lapack():
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


LEAF_M = 0.2
OFFSETS_M = np.linspace(-0.3, 0.3, 7).astype(np.float32)


def rays_of(count, half_m=20.0):
    rng = np.random.default_rng(count)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return rng.uniform(-half_m, half_m, (count, 3)).astype(np.float32), directions.astype(np.float32)


def along(points, directions):
    return (points[:, None] + OFFSETS_M[:, None] * directions[:, None]).reshape(-1, 3)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 300, 70_000])  # the last exceeds one batch
def test_points_along_rays_insert_their_cells(count, threads):
    points, directions = rays_of(count)
    expected = np.unique(cell_keys(along(points, directions), LEAF_M))
    by_rays, by_points = CellSet(LEAF_M), CellSet(LEAF_M)
    by_rays.insert_along(points, directions, OFFSETS_M, threads)
    by_points.insert(along(points, directions), threads)
    for cells in (by_rays, by_points):
        np.testing.assert_array_equal(cells.sorted_keys(threads), expected)
        assert len(cells) == len(expected)


@pytest.mark.parametrize("highest", [1, 2**9, 2**40, 2**64])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_stable_order_equals_a_stable_sort(highest, count):
    keys = np.random.default_rng(count).integers(0, highest, count, np.uint64)
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("count", [0, 1, 40_000])
def test_gathered_rows_of_blocks_are_concatenated(count):
    generator = np.random.default_rng(0)
    blocks = [generator.normal(size=(50_000, width)).astype(np.float32) for width in (3, 1, 4)]
    order = generator.integers(0, 50_000, count, np.int32)
    for threads in (1, 3):
        out = np.zeros((count, 8), np.float32)
        gather_rows(blocks, order, out, threads)
        np.testing.assert_array_equal(out, np.concatenate(blocks, 1)[order])


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 7, 50_000])
def test_sparse_lattice_equals_numpy(threads, count):
    rng = np.random.default_rng(count)
    cells = rng.integers([-5, 1000, -(2**31)], [60, 1030, -(2**31) + 40], size=(count, 3), dtype=np.int64)
    unique, corners, cell_corners = sparse_lattice(cells, num_threads=threads)
    offsets = np.array(list(itertools.product((0, 1), repeat=3)))
    expected = np.unique(cells, axis=0)
    assert np.array_equal(unique, expected)
    all_corners = expected[:, None] + offsets
    assert np.array_equal(corners, np.unique(all_corners.reshape(-1, 3), axis=0))
    assert np.array_equal(corners[cell_corners], all_corners)


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
    """The cell of each view, as rows of integers."""
    edge, by_direction, by_incidence = kind
    columns = [np.floor(points.astype(float) / edge + offset)]
    if by_direction:
        columns.append(np.floor(directions.astype(float) / by_direction + offset + 0.37))
    if by_incidence:
        angle = np.floor(incidence.astype(float) / by_incidence + offset)
        columns.append(np.nan_to_num(angle, nan=-2)[:, None])
    return np.unique(np.concatenate(columns, 1), axis=0, return_inverse=True)[1].ravel()


def fitted_slowly(tiling, num_tilings, asked, values, weights, shrinkage, rounds):
    """The fitted part of the values by the means of one tiling, by definition."""
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
def test_means_equal_the_definition(rounds):
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


def test_small_means_are_omitted():
    asked, values = views(), np.random.default_rng(3).normal(size=3000).astype(np.float32)
    arguments = KINDS, 2, *asked, values, np.ones_like(values), 5.0, 2
    keys, means, explained = fit_cell_means(*arguments)
    large_keys, large_means, still_explained = fit_cell_means(*arguments, 0.1)
    kept = np.abs(means) >= np.float32(0.1)
    assert 0.1 < kept.mean() < 0.9
    np.testing.assert_array_equal(large_keys, keys[kept])
    np.testing.assert_array_equal(large_means, means[kept])
    np.testing.assert_array_equal(still_explained, explained)


def test_unobserved_cells_have_no_mean():
    asked, ones = views(), np.ones(3000, np.float32)
    cells = CellMeans(KINDS, 2, *fit_cell_means(KINDS, 2, *asked, ones, ones, 1.0, 2)[:2])
    assert cells.sums(*asked).min() > 0.5
    points = np.array([[1e5, 0, 0], [3e38, 0, 0]], np.float32)
    assert cells.sums(points, asked[1][:2].copy(), asked[2][:2].copy()).tolist() == [0, 0]
