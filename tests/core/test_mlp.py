# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The networks' kernel against PyTorch's operations one after the other."""

import itertools

import pytest
import torch
from radarsdf.field.kernels import mlp
from radarsdf.threads import ThreadPool

# What it has to be cut into: tiles of 64 rows, pieces of 2048, 16 columns.
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
def test_values_and_gradients(shape, count, dtype):
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
def test_gradients_only_where_they_are_wanted(chosen):
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


def test_what_is_not_a_number_stays_so():
    # A rectifier that made zero of it would hide that a training has diverged.
    inputs, layers = make([4], [16, 1], 3, torch.float32)
    with torch.no_grad():
        inputs[0][1, 2] = float("nan")
    out = mlp(inputs, layers)
    assert out.isnan()[:, 0].tolist() == [False, True, False]
    with ThreadPool(1):
        grads = torch.autograd.grad(out.sum(), [layers[0][0]])
    assert grads[0].isnan().any()
