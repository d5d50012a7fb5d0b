"""Speed of the encoding kernels against the same computation in PyTorch, and against a simple loop in C++.

Each case checks its result against NumPy in double precision, so that a wrong result cannot be the fastest. Compare
only times of one group and one run, not those of different runs or machines: see README.md.
"""

import ctypes
import math

import numpy as np
import pytest
import torch
from radarsdf._core import CellSet, VertexTable
from radarsdf.field import kernels

from .conftest import FEATURE_DIM, LEAF_M, NUM_LEVELS, surface_points


class Differentiated:
    """An interpolation `function` of the tensors `features`, differentiated by PyTorch."""

    def __init__(self, features, function):
        self._features = [tensor.clone().requires_grad_() for tensor in features]
        self._function = function
        self._out = None

    def forward(self):
        with torch.no_grad():
            return self._function(*self._features)

    def backward(self, out_grad):
        """Gradients of the features. The forward pass runs only once and is not measured."""
        if self._out is None:
            self._out = self._function(*self._features)
        return torch.autograd.grad(self._out, self._features, out_grad, retain_graph=True)

    def both(self, out_grad):
        return torch.autograd.grad(self._function(*self._features), self._features, out_grad)


def ours(surface, batch, _fixture):
    way = Differentiated([surface.features], lambda f: kernels.interpolate(f, batch.points, surface.table))
    return way, [surface.features]


def indexing(surface, batch, _fixture):
    def function(features):
        return (features[batch.rows] * batch.weights[..., None]).sum(2).flatten(1)

    return Differentiated([surface.features], function), [surface.features]


def embedding_bag(surface, batch, _fixture):
    rows, weights = batch.rows.view(-1, 12), batch.weights.view(-1, 12)

    def function(features):
        out = torch.nn.functional.embedding_bag(rows, features, per_sample_weights=weights, mode="sum")
        return out.view(len(batch.rows), -1)

    return Differentiated([surface.features], function), [surface.features]


class Roofline:
    """Loops of roofline.cpp, with one of its two schemes for the gradient."""

    def __init__(self, library, surface, batch, threads, scheme):
        self._library, self._scheme = library, scheme
        self._features, self._weights = surface.features, batch.weights
        self._rows, self._threads = batch.rows.int(), threads

    def forward(self):
        out = torch.empty(len(self._rows), NUM_LEVELS * FEATURE_DIM)
        self._call("gather", self._features, self._rows, self._weights, len(out), out, self._threads)
        return out

    def backward(self, out_grad):
        given, count = (self._rows, self._weights, out_grad), len(out_grad)
        num_rows = len(self._features)
        if self._scheme == "planes":
            gradient = torch.zeros(num_rows, FEATURE_DIM)
            self._call("scatter_by_planes", *given, count, gradient, self._threads)
            return [gradient]
        gradients = torch.zeros(self._threads, num_rows, FEATURE_DIM)
        self._call("scatter_to_copies", *given, count, gradients, num_rows, self._threads)
        return [gradients[0]]

    def _call(self, name, *arguments):
        getattr(self._library, name)(
            *(
                ctypes.c_void_p(a.data_ptr()) if isinstance(a, torch.Tensor) else ctypes.c_int64(a)
                for a in arguments[:-1]
            ),
            ctypes.c_int(arguments[-1]),
        )


def roofline_way(threads, scheme):
    def way(surface, batch, fixture):
        threads_used = threads or torch.get_num_threads()
        return Roofline(fixture("roofline"), surface, batch, threads_used, scheme), [surface.features]

    return way


FORWARD = {
    "ours, look-up included": ours,
    "indexing": indexing,
    "embedding_bag": embedding_bag,
}
ROOFLINE = {"roofline": roofline_way(0, "copies")}
# The best scheme depends on the numbers of threads and of rows per point.
ROOFLINES = {
    "roofline, one thread": roofline_way(1, "copies"),
    "roofline, a copy for each thread": roofline_way(0, "copies"),
    "roofline, planes over the threads": roofline_way(0, "planes"),
}


@pytest.fixture
def way(request, surface, batch):
    """An implementation of the interpolation, and its feature tensors."""
    return request.param(surface, batch, request.getfixturevalue)


def over(ways):
    return pytest.mark.parametrize("way", ways.values(), ids=ways.keys(), indirect=True)


@over(FORWARD | ROOFLINE)
def test_interpolation_forward(benchmark, batch, way):
    benchmark.group = f"interpolation forward, {len(batch.points)} points"
    out = benchmark(way[0].forward)
    assert out.shape == (len(batch.points), NUM_LEVELS * FEATURE_DIM)
    assert abs(out.double().sum().item() - batch.total) < 1e-3 * batch.scale


@over(FORWARD | ROOFLINES)
def test_interpolation_backward(benchmark, batch, way):
    benchmark.group = f"interpolation backward, {len(batch.points)} points"
    gradients = benchmark(way[0].backward, torch.ones(len(batch.points), NUM_LEVELS * FEATURE_DIM))
    check_gradients(gradients, way[1], batch)


@over(FORWARD)
def test_interpolation_forward_and_backward(benchmark, batch, way):
    benchmark.group = f"interpolation forward and backward, {len(batch.points)} points"
    gradients = benchmark(way[0].both, torch.ones(len(batch.points), NUM_LEVELS * FEATURE_DIM))
    check_gradients(gradients, way[1], batch)


def check_gradients(gradients, features, batch):
    # The output is linear in the features, so the product of features and gradients is the sum of the outputs.
    pairs = zip(gradients, features, strict=True)
    total = sum((gradient.double() * own.double()).sum().item() for gradient, own in pairs)
    assert abs(total - batch.total) < 1e-3 * batch.scale
    assert sum(gradient.double().sum().item() for gradient in gradients) == pytest.approx(
        3.0 * NUM_LEVELS * FEATURE_DIM * len(batch.points), rel=1e-5
    )


@pytest.mark.parametrize("way", ["ours", "torch"])
def test_fourier(benchmark, batch, way):
    points, half_width_m, count = batch.points, 409.6, 16
    benchmark.group = f"Fourier encoding, {len(points)} points"
    frequencies = math.pi / half_width_m * 2.0 ** torch.arange(count)

    def plain():
        angle = (points[:, None, :] * frequencies[:, None]).flatten(1)
        return torch.cat([torch.sin(angle), torch.cos(angle)], 1)

    def fused():
        return kernels.fourier(points, half_width_m, 0, count)

    out = benchmark(fused if way == "ours" else plain)
    angle = (points.double()[:, None, :] * frequencies.double()[:, None]).flatten(1)
    expected = torch.cat([torch.sin(angle), torch.cos(angle)], 1)
    assert (out - expected).abs().max() < 3e-4  # float32 angles reach 4000; ours is exact to 1e-6


@pytest.fixture(scope="module", params=[1_000_000, 10_000_000], ids=["1e6", "1e7"])
def cloud(request, smoke):
    points = surface_points(request.param // 100 if smoke else request.param, seed=1)
    inverse = np.float32(1 / LEAF_M)
    cells = np.floor(points * inverse).astype(np.int64) + (1 << 20)
    return points, len(np.unique(cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2]))


@pytest.mark.parametrize("threads", [1, 2])
def test_table_building(benchmark, cloud, threads):
    points, num_cells = cloud
    benchmark.group = f"table from {len(points):.0e} points"

    def build():
        cells = CellSet(LEAF_M)
        cells.insert(points, threads)
        return VertexTable(cells.sorted_keys(threads), LEAF_M, NUM_LEVELS, num_threads=threads)

    table = benchmark.pedantic(build, rounds=5, warmup_rounds=1)
    assert len(table.leaf_keys()) == num_cells
