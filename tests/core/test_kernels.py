"""The compiled kernels against plain references, their gradients, and determinism on threads."""

import math

import numpy as np
import pytest
import torch
from radarsdf import _core
from radarsdf.field import kernels
from scipy.special import sph_harm_y

LEAF_M = 0.2
ENCODINGS = [_core.Encoding.TRI_QUADTREE, _core.Encoding.OCTREE]
PLANES = [(0, 1), (0, 2), (1, 2)]


def surface_points(count, seed=0, extent_m=4.0, dtype=np.float64):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-extent_m, extent_m, (count, 2))
    z = 0.7 * np.sin(xy[:, 0]) + rng.uniform(-0.3, 0.3, count)
    return np.column_stack([xy, z]).astype(dtype)


def make_table(points, num_levels=3, encoding=_core.Encoding.TRI_QUADTREE, num_threads=0):
    cells = _core.CellSet(LEAF_M)
    cells.insert(np.ascontiguousarray(points), num_threads)
    return _core.VertexTable(cells.sorted_keys(num_threads), LEAF_M, num_levels, encoding, num_threads)


class Reference:
    """The method as dictionaries and loops: slow, plain, and indexed by its own keys only."""

    def __init__(self, points, num_levels, encoding):
        leaf = {tuple(cell) for cell in np.floor(points / LEAF_M).astype(int).tolist()}
        self.cells = [{tuple(c >> level for c in cell) for cell in leaf} for level in range(num_levels)]
        self.groups = PLANES if encoding == _core.Encoding.TRI_QUADTREE else [(0, 1, 2)]

    def weights(self, point, level):
        """{(level, group, vertex): weight} of one point."""
        u = point / LEAF_M / 2**level
        cell = np.floor(u).astype(int)
        if tuple(cell) not in self.cells[level]:
            return {}
        result = {}
        for group in self.groups:
            for corner in np.ndindex(*(2,) * len(group)):
                vertex = tuple(int(cell[axis]) + step for axis, step in zip(group, corner, strict=True))
                factors = [
                    u[axis] - cell[axis] if step else 1 - (u[axis] - cell[axis])
                    for axis, step in zip(group, corner, strict=True)
                ]
                result[level, group, vertex] = math.prod(factors)
        return result

    def num_vertices(self):
        vertices = set()
        for level, cells in enumerate(self.cells):
            for cell in cells:
                for group in self.groups:
                    for corner in np.ndindex(*(2,) * len(group)):
                        vertices.add(
                            (level, group, tuple(cell[a] + s for a, s in zip(group, corner, strict=True)))
                        )
        return len(vertices)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("num_levels", [1, 3, 5])
def test_interpolation_equals_the_dictionary_reference(encoding, num_levels):
    occupied = surface_points(300)
    table = make_table(occupied, num_levels, encoding)
    reference = Reference(occupied, num_levels, encoding)
    assert table.num_rows == reference.num_vertices()

    rng = np.random.default_rng(1)
    queries = np.concatenate([occupied[:100], rng.uniform(-5, 5, (200, 3))])
    # One-hot features identify the row of each vertex: the map from vertices to rows must be one-to-one.
    features = rng.normal(size=(table.num_rows, 8))
    out = kernels.interpolate(torch.tensor(features), torch.tensor(queries), table).numpy()
    weights_of_rows = np.zeros((len(queries), num_levels, table.num_rows))
    for block in range(0, table.num_rows, 8):
        one_hot = np.zeros((table.num_rows, 8))
        width = min(8, table.num_rows - block)
        one_hot[block : block + width, :width] = np.eye(width)
        y = kernels.interpolate(torch.tensor(one_hot), torch.tensor(queries), table).numpy()
        weights_of_rows[:, :, block : block + width] = y.reshape(len(queries), num_levels, 8)[:, :, :width]

    row_of = {}
    for n, query in enumerate(queries):
        for level in range(num_levels):
            expected = reference.weights(query, level)
            found = {
                int(row): weights_of_rows[n, level, row] for row in np.flatnonzero(weights_of_rows[n, level])
            }
            assert sorted(found.values()) == pytest.approx(sorted(expected.values()), abs=1e-12)
            # Distinct weights identify the vertices.
            if len(set(np.round(list(expected.values()), 9))) == len(expected):
                by_weight = sorted(found, key=found.__getitem__)
                for vertex, row in zip(sorted(expected, key=expected.__getitem__), by_weight, strict=True):
                    assert row_of.setdefault(vertex, row) == row
    assert len(set(row_of.values())) == len(row_of)
    np.testing.assert_allclose(
        out.reshape(len(queries), num_levels, 8),
        np.einsum("nlr,rd->nld", weights_of_rows, features),
        atol=1e-12,
    )


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("count", [1, 7, 1000])
def test_float32_is_accurate_to_its_resolution(encoding, count):
    """Values and gradients up to second order, against float64, which other tests compare with definitions."""
    points = surface_points(count, dtype=np.float32)
    table = make_table(points, 3, encoding)
    generator = torch.Generator().manual_seed(0)
    given = [
        torch.randn(*shape, generator=generator) for shape in ((table.num_rows, 8), (count, 24), (count, 3))
    ]
    found = []
    for dtype in (torch.float32, torch.float64):
        features, grad, along = (array.to(dtype).requires_grad_() for array in given)
        x = torch.from_numpy(points).to(dtype).requires_grad_()
        y = kernels.interpolate(features, x, table)
        first = torch.autograd.grad(y, (features, x), grad, create_graph=True)
        second = torch.autograd.grad((first[1] * along).sum(), (features, grad))
        found.append([y, *first, *second])
    for single, double in zip(*found, strict=True):
        np.testing.assert_allclose(
            single.detach(), double.detach(), rtol=0, atol=1e-4 * double.abs().max().item()
        )


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_gradients_of_interpolation(encoding):
    surface = surface_points(40, extent_m=0.6)
    table = make_table(surface[:6], 2, encoding)
    # Away from cell borders, where gradients by points are discontinuous; some only in coarse cells.
    known = (kernels.locate(torch.tensor(surface), table) >= 0).numpy()
    points = np.concatenate([surface[known[:, 0]][:4], surface[known.any(1) & ~known[:, 0]][:2]])
    points = torch.tensor(
        (np.floor(points / LEAF_M) + 0.1 + 0.8 * np.random.default_rng(2).random(points.shape)) * LEAF_M
    )
    features = torch.randn(table.num_rows, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inputs = (features.requires_grad_(), points.requires_grad_())
    located = kernels.locate(points, table) >= 0
    assert located.any(1).all()
    assert located[:, 0].sum() == 4

    def function(f, x):
        return kernels.interpolate(f, x, table)

    assert torch.autograd.gradcheck(function, inputs, eps=1e-6, atol=1e-7)
    assert torch.autograd.gradgradcheck(function, inputs, eps=1e-6, atol=1e-7, fast_mode=True)

    def by_both(f, x):
        gradients = torch.autograd.grad(function(f, x).square().sum(), (f, x), create_graph=True)
        return sum(gradient.sin().sum() for gradient in gradients)

    assert torch.autograd.gradcheck(by_both, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


def test_gradients_of_fourier():
    points = torch.randn(
        7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    ).requires_grad_()
    function = lambda x: kernels.fourier(x, 3.0, 0, 4)
    assert torch.autograd.gradcheck(function, (points,))
    assert torch.autograd.gradgradcheck(function, (points,))


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-7), (torch.float64, 1e-15)])
def test_fourier_equals_sin_and_cos(dtype, tolerance):
    points = (torch.rand(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1).to(
        dtype
    )
    points[0] = torch.tensor([0.0, 1.0, -1.0])
    points[1] = torch.tensor([0.25, -0.5, 0.125])
    out = kernels.fourier(points, 1.0, 0, 16).double().view(-1, 2, 16, 3)
    # The angle modulo a full turn is exact in double precision, so the reference is good at every frequency.
    angle = torch.remainder(points.double()[:, None, :] * 2.0 ** torch.arange(16)[:, None], 2.0) * math.pi
    np.testing.assert_allclose(out[:, 0], torch.sin(angle), atol=tolerance)
    np.testing.assert_allclose(out[:, 1], torch.cos(angle), atol=tolerance)


def test_spherical_harmonics_equal_scipy():
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=1)
    polar, azimuth = (
        torch.arccos(directions[:, 2]).numpy(),
        torch.atan2(directions[:, 1], directions[:, 0]).numpy(),
    )
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            # Without the Condon-Shortley phase.
            y = sph_harm_y(degree, abs(order), polar, azimuth) * (-1.0) ** order
            part = y.real if order >= 0 else y.imag
            expected.append(part * (math.sqrt(2) if order else 1))
    np.testing.assert_allclose(kernels.spherical_harmonics(directions), np.stack(expected, 1), atol=1e-12)


def test_same_bits_for_any_number_of_threads():
    points = surface_points(20_000, dtype=np.float32)
    tables = [make_table(points, num_threads=threads) for threads in (1, 2, 3)]
    features = np.random.default_rng(0).normal(size=(tables[0].num_rows, 8)).astype(np.float32)
    grad = np.random.default_rng(1).normal(size=(len(points), 24)).astype(np.float32)
    answers = []
    for threads, table in zip((1, 2, 3), tables, strict=True):
        located = np.zeros((len(points), 3), np.int32)
        out, points_grad, features_grad = np.zeros_like(grad), np.zeros_like(points), np.zeros_like(features)
        table.encode(features, points, located, out, threads)
        table.scatter(points, located, None, grad, features_grad, threads)
        table.coordinate_gradient(features, points, located, None, grad, points_grad, threads)
        answers.append([located, out, features_grad, points_grad])
    for other in answers[1:]:
        for first, second in zip(answers[0], other, strict=True):
            np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e9])
def test_points_outside_every_lattice_have_no_cell(value):
    table = make_table(surface_points(100))
    assert (kernels.locate(torch.full((3, 3), value, dtype=torch.float64), table) == -1).all()
    cells = _core.CellSet(LEAF_M)
    with pytest.raises(ValueError, match="finite and within"):
        cells.insert(np.full((1, 3), value))
    assert len(cells) == 0


def test_a_block_of_columns_is_a_valid_gradient():
    table = make_table(surface_points(100, dtype=np.float32))
    points = torch.tensor(surface_points(50, dtype=np.float32))
    wide = torch.randn(50, 40)
    gradients = []
    for grad in (wide[:, 8:32], wide[:, 8:32].contiguous()):
        features = torch.zeros(table.num_rows, 8, requires_grad=True)
        kernels.interpolate(features, points, table).backward(grad)
        gradients.append(features.grad)
    assert torch.equal(*gradients)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("num_levels", [1, 3, 12])
def test_values_are_continuous_at_cell_borders(dtype, num_levels):
    # On a vertex, the adjacent numbers on both sides, both zeros, and the smallest numbers next to zero.
    border = (np.arange(-8, 8, dtype=dtype) * dtype(LEAF_M)).astype(dtype)
    # Scaled to the coarsest of 12 levels, this is still a normal number; below, a sign may be lost to underflow.
    tiny = np.finfo(dtype).smallest_normal * 2**12
    beside = [np.nextafter(border[border != 0], dtype(way)) for way in (-9, 9)]
    line = np.concatenate([border, *beside, np.array([0.0, -0.0, tiny, -tiny], dtype)])
    line = np.sort(line[(line > -1.5) & (line < 1.3)])
    cells = (np.stack(np.meshgrid(*[np.arange(-8, 8)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) * LEAF_M
    table = make_table(cells, num_levels)
    features = torch.tensor(np.random.default_rng(0).normal(size=(table.num_rows, 8)).astype(dtype))
    for axis in range(3):
        points = np.full((len(line), 3), 0.05, dtype)
        points[:, axis] = line
        points = torch.from_numpy(points)
        assert (kernels.locate(points, table) >= 0).all()
        out = kernels.interpolate(features, points, table)
        together = np.diff(line.astype(np.float64)) < 1e-5
        assert together.sum() >= 30
        # Weights change by the step over the cell size; a point in the wrong cell would jump by a feature.
        assert (out[1:] - out[:-1]).abs()[torch.from_numpy(together)].max() < 1e-3


@pytest.mark.usefixtures("instruction_set")
def test_cells_are_half_open():
    cells = np.array([[0.1, 0.1, 0.1], [-0.1, -0.1, -0.1]])
    table = make_table(cells, 1)
    corners = torch.tensor([[0.0] * 3, [-0.0] * 3, [-1e-300] * 3, [0.2] * 3, [-0.2] * 3], dtype=torch.float64)
    found = (kernels.locate(corners, table)[:, 0] >= 0).tolist()
    assert found == [True, True, True, False, True]
    # The set of cells and the table agree on the cells of points.
    keys = _core.cell_keys(corners.numpy(), LEAF_M)
    assert [key in table.leaf_keys() for key in keys] == found
    outside = torch.tensor([[0.1, 0.1, 0.2], [-0.1, -0.1, 1e-300]], dtype=torch.float64)
    assert (kernels.locate(outside, table) == -1).all()


@pytest.mark.usefixtures("instruction_set")
def test_the_outermost_cells_of_the_lattice():
    last = ((1 << 20) - (1 << 12) - 1) * LEAF_M
    points = np.array([[last] * 3, [-last] * 3, [last, -last, 0.0]])
    table = make_table(points, 12)
    assert (kernels.locate(torch.from_numpy(points), table) >= 0).all()
    ones = torch.ones(table.num_rows, 8, dtype=torch.float64)
    np.testing.assert_allclose(kernels.interpolate(ones, torch.from_numpy(points), table), 3.0, rtol=1e-9)
    with pytest.raises(ValueError, match="within a million cells"):
        make_table(points + LEAF_M * 2)
