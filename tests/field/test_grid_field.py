# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Distances at corners: what is stored there, what is linear in between, and nothing outside."""

import numpy as np
import pytest
import torch
from radarsdf._core import CellSet
from radarsdf.field.grid_field import GridField

LEAF_M = 0.2
SLOPE = np.array([0.3, -0.5, 0.8], np.float32)


@pytest.fixture
def field():
    cells = CellSet(LEAF_M)
    points = np.random.default_rng(0).uniform(-2, 2, (300, 3)).astype(np.float32)
    cells.insert(points)
    field = GridField(cells.sorted_keys(), LEAF_M)
    corners = field.table.leaf_vertices()[0]
    with torch.no_grad():
        field.distances_m.copy_(torch.from_numpy(corners @ SLOPE * LEAF_M + 0.1))
    return field


def inside(field, count=2000):
    rng = np.random.default_rng(1)
    cells = field.table.leaf_cells()
    return ((cells[rng.integers(0, len(cells), count)] + rng.uniform(0.01, 0.99, (count, 3))) * LEAF_M).astype(np.float32)  # fmt: skip


def test_what_is_linear_stays_linear(field):
    x = inside(field)
    np.testing.assert_allclose(field.sdf(torch.from_numpy(x)).detach(), x @ SLOPE + 0.1, atol=1e-6)
    np.testing.assert_allclose(field.gradient(torch.from_numpy(x)), np.tile(SLOPE, (len(x), 1)), atol=1e-5)


def test_the_gradient_is_the_derivative(field):
    with torch.no_grad():
        field.distances_m.normal_(generator=torch.Generator().manual_seed(0))
    field.double()
    x = torch.from_numpy(inside(field, 20).astype(np.float64)).requires_grad_()
    assert torch.autograd.gradcheck(field.sdf, (x,), eps=1e-6)


def test_corners_are_those_that_are_stored(field):
    corners, of_cells, distances_m = field.leaf_corners()
    x = torch.from_numpy(((field.table.leaf_cells() + 0.5) * LEAF_M).astype(np.float32))
    np.testing.assert_allclose(field.sdf(x).detach(), distances_m[of_cells].mean(axis=1), atol=1e-6)
    np.testing.assert_allclose(distances_m, corners @ SLOPE * LEAF_M + 0.1, atol=1e-6)


@pytest.mark.parametrize("far", [5.0, 1e9, float("inf"), float("nan")])
def test_outside_there_is_nothing(field, far):
    x = torch.full((3, 3), far)
    assert (field.sdf(x) == 0).all()
    assert not field.occupied(x).any()
