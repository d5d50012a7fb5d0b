"""Contents of each part of an encoding, and the support of features."""

import numpy as np
import pytest
import torch
from radarsdf._core import CellSet
from radarsdf.field import kernels
from radarsdf.field.field import GridField

LEAF_M = 0.2


def tensor(values):
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def test_fourier_frequencies_are_the_requested_ones():
    points = tensor(np.random.default_rng(0).uniform(-3, 3, (50, 3)))
    whole = kernels.fourier(points, 4.0, 0, 6).view(-1, 2, 6, 3)
    part = kernels.fourier(points, 4.0, 2, 3)
    assert torch.equal(part.view(-1, 2, 3, 3), whole[:, :, 2:5])
    # Sines come first and are odd; the longest wave has a length of two half widths.
    assert torch.equal(kernels.fourier(-points, 4.0, 0, 6).view(-1, 2, 6, 3)[:, 0], -whole[:, 0])
    np.testing.assert_allclose(kernels.fourier(points + 8.0, 4.0, 0, 6).view(-1, 2, 6, 3), whole, atol=1e-4)
    assert kernels.fourier(points, 4.0, 0, 0).shape == (50, 0)


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


def test_linear_functions_are_reproduced(field):
    x = inside(field)
    np.testing.assert_allclose(field.sdf(torch.from_numpy(x)).detach(), x @ SLOPE + 0.1, atol=1e-6)
    np.testing.assert_allclose(
        field.plane(torch.from_numpy(x))[:, 1:], np.tile(SLOPE, (len(x), 1)), atol=1e-5
    )


def test_the_core_interpolates_like_autograd(field):
    with torch.no_grad():
        field.distances_m.normal_(generator=torch.Generator().manual_seed(0))
    x = torch.from_numpy(np.concatenate([inside(field), [[9, 0, 0]]]).astype(np.float32))
    points = x.clone().requires_grad_()
    expected = field.sdf(points)
    (gradient,) = torch.autograd.grad(expected.sum(), points)
    expected = torch.cat([expected[:, None], gradient], 1).detach().numpy()
    found = field.plane(x).numpy()
    # PyTorch rounds once in a fused multiplication and addition, if the processor has it.
    fused = torch.backends.cpu.get_cpu_capability() in ("AVX2", "AVX512")
    np.testing.assert_allclose(found, expected, rtol=0, atol=0 if fused else 1e-5)
    with torch.no_grad():
        np.testing.assert_array_equal(field.sdf(x), found[:, 0])


def test_points_on_faces_move_into_a_leaf_cell(field):
    rng = np.random.default_rng(2)
    cells = field.table.leaf_cells()
    corners = cells + rng.integers(0, 2, cells.shape) + rng.uniform(-1e-6, 1e-6, cells.shape)
    x = np.concatenate([corners * LEAF_M, rng.uniform(-2.5, 2.5, (400, 3))]).astype(np.float32)
    step_m, leaf_m = np.float32(1e-3 * LEAF_M), np.float32(LEAF_M)
    expected, inside = x.copy(), field.occupied(torch.from_numpy(x)).numpy()
    on_face = (np.abs(x / leaf_m - np.round(x / leaf_m)) * leaf_m <= step_m).any(axis=1)
    for shift in np.ndindex(2, 2, 2):
        moved = x + step_m * (2 * np.array(shift, np.float32) - 1)
        here = ~inside & on_face & field.occupied(torch.from_numpy(moved)).numpy()
        expected[here], inside = moved[here], inside | here
    assert (expected != x).any()
    for num_threads in (1, 2):
        found = x.copy()
        np.testing.assert_array_equal(field.table.into_cells(found, step_m, num_threads), inside)
        np.testing.assert_array_equal(found, expected)


def test_the_gradient_is_the_derivative(field):
    with torch.no_grad():
        field.distances_m.normal_(generator=torch.Generator().manual_seed(0))
    field.double()
    x = torch.from_numpy(inside(field, 20).astype(np.float64)).requires_grad_()
    assert torch.autograd.gradcheck(field.sdf, (x,), eps=1e-6)


@pytest.mark.parametrize("far", [5.0, 1e9, float("inf"), float("nan")])
def test_points_outside_all_cells_are_unobserved(field, far):
    x = torch.full((3, 3), far)
    assert (field.sdf(x) == 0).all()
    assert not field.occupied(x).any()
