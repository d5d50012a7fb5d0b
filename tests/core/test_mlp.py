"""The kernel of the networks, against a sequence of PyTorch operations."""

import functools
import itertools

import numpy as np
import pytest
import torch
from radarsdf import _core
from radarsdf.field.kernels import mlp
from radarsdf.threads import ThreadPool

# Sizes around its partitions: tiles of 64 rows, chunks of 2048, 16 columns.
COUNTS = [0, 1, 7, 64, 65, 4100]
SHAPES = [([24, 60], [32, 32, 1]), ([8], [2, 1]), ([3], [5]), ([17, 1, 16], [33, 16, 7, 18])]


def make(widths, outputs, count, dtype=torch.float64, seed=0):
    """Inputs and layers, all with gradients."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape, scale=1.0):
        return (torch.randn(*shape, generator=generator, dtype=dtype) * scale).requires_grad_()

    sizes = [sum(widths), *outputs]
    layers = [(normal(n, k, scale=k**-0.5), normal(n, scale=0.1)) for k, n in itertools.pairwise(sizes)]
    return [normal(count, width) for width in widths], layers


def plain(inputs, layers):
    x = torch.cat(inputs, 1)
    for i, (weight, bias) in enumerate(layers):
        x = torch.nn.functional.linear(x if i == 0 else x.clamp_min(0), weight, bias)
    return x


def flat(inputs, layers):
    return [*inputs, *itertools.chain(*layers)]


def assert_same(found, expected, dtype, count=1):
    # Relative to the largest: a sum of many terms that cancel is as exact as its terms.
    tolerance = (3e-6 if dtype == torch.float32 else 1e-14) * max(1, count) ** 0.5
    scale = expected.abs().max().item() if expected.numel() else 0
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance * max(scale, 1e-3))


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_values_and_gradients_equal_pytorch(shape, count, dtype):
    inputs, layers = make(*shape, count, dtype)
    out, expected = mlp(inputs, layers), plain(inputs, layers)
    assert_same(out, expected, dtype)
    grad = torch.randn(out.shape, dtype=dtype, generator=torch.Generator().manual_seed(1))
    wanted = flat(inputs, layers)
    for ours, theirs in zip(
        torch.autograd.grad(out, wanted, grad), torch.autograd.grad(expected, wanted, grad), strict=True
    ):
        assert_same(ours, theirs, dtype, count)


@pytest.mark.parametrize(
    "chosen", [["inputs", 1], ["weights", 0], ["biases", 1], ["inputs", 0, "weights", 1]], ids=str
)
def test_only_requested_gradients_are_computed(chosen):
    inputs, layers = make([5, 20, 3], [18, 4], 100)
    every = {"inputs": inputs, "weights": [w for w, _ in layers], "biases": [b for _, b in layers]}
    wanted = [every[name][i] for name, i in zip(chosen[::2], chosen[1::2], strict=True)]
    for tensor in flat(inputs, layers):
        tensor.requires_grad_(any(tensor is other for other in wanted))
    expected = torch.autograd.grad(plain(inputs, layers).square().sum(), wanted)
    found = torch.autograd.grad(mlp(inputs, layers).square().sum(), wanted)
    for ours, theirs in zip(found, expected, strict=True):
        assert_same(ours, theirs, torch.float64, 100)


def test_gradcheck_and_gradgradcheck():
    inputs, layers = make([3, 2], [4, 3, 2], 5)

    def function(*tensors):
        return mlp(tensors[:2], pairs(tensors[2:]))

    assert torch.autograd.gradcheck(function, flat(inputs, layers))
    assert torch.autograd.gradgradcheck(function, flat(inputs, layers))


def pairs(tensors):
    return list(zip(tensors[::2], tensors[1::2], strict=True))


def test_same_bits_for_any_number_of_threads():
    inputs, layers = make([24, 60], [32, 32, 1], 40_000, torch.float32)
    found = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            out = mlp(inputs, layers)
            found.append([out, *torch.autograd.grad(out.square().sum(), flat(inputs, layers))])
    finally:
        torch.set_num_threads(threads)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_nan_propagates_through_relu():
    # A ReLU that maps NaN to zero would hide divergence.
    inputs, layers = make([4], [16, 1], 3, torch.float32)
    with torch.no_grad():
        inputs[0][1, 2] = float("nan")
    out = mlp(inputs, layers)
    assert out.isnan()[:, 0].tolist() == [False, True, False]
    with ThreadPool(1):
        grads = torch.autograd.grad(out.sum(), [layers[0][0]])
    assert grads[0].isnan().any()


RATE = 1e-2


class Reference:
    """SOAP as published, with bases updated after 1, 2, 4, …, 32, 64, 96, … steps, and vectors as rows."""

    def __init__(self, rows, columns, longest=512):
        self.sides = [
            {"sum": np.zeros((n, n)), "basis": np.eye(n), "turns": n <= longest} for n in (rows, columns)
        ]
        self.mean, self.square, self.step = np.zeros((rows, columns)), np.zeros((rows, columns)), 0
        self.mean_square = 0.0  # of whole gradients

    def turned(self, matrix, forth):
        left, right = (side["basis"] if forth else side["basis"].T for side in self.sides)
        return left @ matrix @ right.T

    def move(self, weights, gradient, rate):
        self.step += 1
        for side, g in zip(self.sides, (gradient, gradient.T), strict=True):
            side["sum"] = 0.95 * side["sum"] + g @ g.T
        if self.step in (1, 2, 4, 8, 16) or self.step % 32 == 0:
            mean = self.turned(self.mean, forth=False)
            for side in self.sides:
                if not side["turns"]:
                    continue
                vectors = side["basis"] @ side["sum"] * (len(side["sum"]) / np.trace(side["sum"]))
                q, r = np.linalg.qr((vectors + 1e-3 * side["basis"]).T)
                side["basis"] = (q * np.sign(np.diag(r))).T
            self.mean = self.turned(mean, forth=True)
        turned = self.turned(gradient, forth=True)
        self.mean = 0.95 * self.mean + 0.05 * turned
        self.square = 0.95 * self.square + 0.05 * turned**2
        self.mean_square = 0.95 * self.mean_square + 0.05 * (gradient**2).mean()
        grown = 1 - 0.95**self.step
        way = self.mean / np.sqrt(grown) / (np.sqrt(self.square) + 1e-2 * np.sqrt(self.mean_square))
        return weights - rate * self.turned(way, forth=False)


def memory_of(weights):
    return np.zeros(_core.soap_memory_size(*weights.shape), weights.dtype)


@functools.cache
def way_of_the_formula(rows, columns):
    """Initial weights, and gradient and weights of each step; for all instruction sets."""
    rng = np.random.default_rng(0)
    weights, reference, steps = rng.normal(size=(rows, columns)), Reference(rows, columns), []
    expected = weights
    for _ in range(1, 40):
        mix = rng.normal(size=(columns, columns)) * np.geomspace(0.1, 1, columns)
        gradient = rng.normal(size=(rows, columns)) @ mix  # correlated columns, as of correlated inputs
        expected = reference.move(expected, gradient, RATE)
        steps.append((gradient, expected))
    return weights, steps


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(("rows", "columns"), [(20, 37), (2, 3), (3, 520)])
def test_steps_equal_the_formula(rows, columns):
    start, steps = way_of_the_formula(rows, columns)
    weights = start.astype(np.float32)
    memory = memory_of(weights)
    for step, (gradient, expected) in enumerate(steps, start=1):
        _core.soap_step([weights], [gradient.astype(np.float32)], [memory], step, RATE)
        np.testing.assert_allclose(weights, expected, atol=3e-4)
    assert np.abs(weights).max() > 10 * RATE


@pytest.mark.usefixtures("instruction_set")
def test_degenerate_gradients_give_finite_weights():
    rng = np.random.default_rng(2)
    for scale in (0.0, 1e-30, 1e-10, 1e12):
        weights = np.zeros((24, 40), np.float32)
        memory = memory_of(weights)
        for step in range(1, 100):
            gradient = scale * rng.normal(size=weights.shape)
            gradient[:, ::3] = 0  # unused inputs
            gradient[:, 1] = gradient[:, 4]  # two identical inputs
            if step == 50:
                gradient[:] = 0
            _core.soap_step([weights], [gradient.astype(np.float32)], [memory], step, RATE)
        assert np.isfinite(weights).all()
        assert np.isfinite(memory).all()
        assert np.abs(weights).max() < 100 * 20 * RATE
        assert (np.abs(weights).max() > RATE) == (scale > 1e-15)  # smaller: no effect, as with Adam
