# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rounding errors of the kernels against float64, and where very large, very small and infinite numbers go."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from radarsdf import _core

from . import rounding as stress

DTYPES = [np.float32, np.float64]
interpolation_case = functools.cache(stress.interpolation_case)  # of all instruction sets


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("encoding", stress.ENCODINGS.values(), ids=stress.ENCODINGS)
@pytest.mark.parametrize("place", stress.PLACES)
def test_interpolation_and_its_derivatives_are_good_to_a_few_roundings(dtype, encoding, place):
    for count in (0, 1, 7, 1031):
        errors = stress.interpolation_errors(interpolation_case(place, count, dtype, encoding))
        assert len(errors) == 6
        assert max(errors.values()) < 4 * np.finfo(dtype).eps, (count, errors)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("dtype", DTYPES)
def test_fixed_encodings_are_good_to_a_few_roundings(dtype):
    for count in (0, 1, 7, 1031):
        errors = stress.fourier_error(count, dtype) | {"harmonics": stress.harmonics_error(count, dtype)}
        assert max(errors.values()) < 4 * np.finfo(dtype).eps, (count, errors)


@pytest.mark.parametrize("same_sign", [True, False])
def test_a_row_that_a_whole_training_batch_hits(same_sign):
    assert stress.one_row_error(8192, np.float32, same_sign=same_sign) < 1e-5
    assert stress.one_row_error(8192, np.float64, same_sign=same_sign) < 1e-14


def sums(features, points, g, directions, encoding):
    """Value, gradient by the features and gradient by the points."""
    table, _ = stress.table_and_reference("anywhere", points.dtype, encoding)
    located = np.zeros((len(points), stress.NUM_LEVELS), np.int32)
    table.locate(points, located)
    y, df, dx = np.zeros_like(g), np.zeros_like(features), np.zeros_like(points)
    table.interpolate(features, points, located, directions, y)
    table.scatter(points, located, directions, g, df)
    table.coordinate_gradient(features, points, located, directions, g, dx)
    return table, located, y, df, dx


def arguments(dtype, encoding, count=300):
    rng = np.random.default_rng(0)
    table, _ = stress.table_and_reference("anywhere", dtype, encoding)
    features = rng.normal(size=(table.num_rows, 8)).astype(dtype)
    g = rng.normal(size=(count, 8 * stress.NUM_LEVELS)).astype(dtype)
    return features, stress.points_of("anywhere", count, dtype), g, rng.normal(size=(count, 3)).astype(dtype)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("encoding", stress.ENCODINGS.values(), ids=stress.ENCODINGS)
@pytest.mark.parametrize("power", [-100, 100])  # of two: 1e-30 to 1e30
@pytest.mark.parametrize("with_directions", [False, True])
def test_a_power_of_two_goes_through_exactly(dtype, encoding, power, with_directions):
    features, points, g, v = arguments(dtype, encoding)
    # Terms far smaller than others could fall below the smallest number, and would then not scale.
    features, g = np.round(features * 8) + 9, np.round(g * 8) + 9
    v = v if with_directions else None
    factor = dtype(2.0) ** dtype(power)
    _, _, y, df, dx = sums(features, points, g, v, encoding)
    _, _, scaled_y, _, scaled_dx = sums(features * factor, points, g, v, encoding)
    np.testing.assert_array_equal(scaled_y, y * factor)
    np.testing.assert_array_equal(scaled_dx, dx * factor)
    _, _, _, scaled_df, scaled_dx = sums(features, points, g * factor, v, encoding)
    np.testing.assert_array_equal(scaled_df, df * factor)
    np.testing.assert_array_equal(scaled_dx, dx * factor)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("encoding", stress.ENCODINGS.values(), ids=stress.ENCODINGS)
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("with_directions", [False, True])
def test_infinities_stay_where_they_belong(dtype, encoding, value, with_directions):
    features, points, g, v = arguments(dtype, encoding)
    v = v if with_directions else None
    _, located, y, df, dx = sums(features, points, g, v, encoding)

    # A gradient that is infinite in one number of one point: only rows of that point's cell, and only that number.
    damaged = g.copy()
    damaged[5, 8 + 3] = value  # second level, fourth feature
    _, _, _, damaged_df, damaged_dx = sums(features, points, damaged, v, encoding)
    touched = ~np.isfinite(damaged_df)
    assert 0 < touched.sum() <= (12 if encoding == _core.Encoding.TRI_QUADTREE else 8)
    assert touched[:, 3].sum() == touched.sum()
    np.testing.assert_array_equal(damaged_df[~touched], df[~touched])
    np.testing.assert_array_equal(np.isfinite(damaged_dx).all(axis=1), np.arange(len(points)) != 5)
    np.testing.assert_array_equal(np.delete(damaged_dx, 5, 0), np.delete(dx, 5, 0))

    # A feature of one row that is infinite: only points in the cells round that vertex, and only that number.
    row = int(np.flatnonzero(touched[:, 3])[0])
    damaged = features.copy()
    damaged[row, 3] = value
    _, _, damaged_y, _, _ = sums(damaged, points, g, v, encoding)
    touched = ~np.isfinite(damaged_y)
    assert touched[5, 8 + 3]
    assert touched[:, 8 + 3].sum() == touched.sum()
    neighbours = np.flatnonzero(touched.any(axis=1))
    assert len(np.unique(located[neighbours, 1])) < len(np.unique(located[:, 1])) / 4
    np.testing.assert_array_equal(damaged_y[~touched], y[~touched])
