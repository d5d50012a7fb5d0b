"""Adam equals PyTorch's, without its imports; sparse Adam equals a dense one if all rows are touched; SOAP."""

import numpy as np
import pytest
import torch
from radarsdf._core import CellSet, Encoding
from radarsdf.field import kernels
from radarsdf.field.field import VertexFeatures
from radarsdf.fitting.steps import Adam, RowAdam, Soap, Touched
from radarsdf.threads import ThreadPool


def test_same_bits_as_pytorch_s():
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator) for shape in ((300, 8), (7,), (32, 20))]
    ours, theirs = ([p.clone().requires_grad_() for p in start] for _ in range(2))
    adam = Adam(ours, 1e-2)
    reference = torch.optim.Adam(theirs, lr=1e-2, eps=1e-15, fused=True)
    for i in range(20):
        reference.param_groups[0]["lr"] = 1e-2 * (1 - i / 20)
        gradients = [torch.randn(p.shape, generator=generator) for p in ours]
        for parameter, gradient in zip(theirs, gradients, strict=True):
            parameter.grad = gradient.clone()
        adam.step(gradients, i + 1, 1 - i / 20, None)
        reference.step()
        for a, b in zip(ours, theirs, strict=True):
            assert torch.equal(a, b)
    assert not torch.equal(ours[0], start[0])


def test_soap_resumes_from_its_state_and_threads_change_no_bit():
    generator, shapes = torch.Generator().manual_seed(1), ((6, 9), (6,), (5, 6), (5,), (1, 5), (1,))
    whole = [torch.randn(shape, generator=generator).requires_grad_() for shape in shapes]
    gradients = [[torch.randn(shape, generator=generator) for shape in shapes] for _ in range(50)]
    resumed = [p.detach().clone().requires_grad_() for p in whole]
    soap, first, second = Soap(whole, 1e-2), Soap(resumed, 1e-2), Soap(resumed, 1e-2)
    with ThreadPool(3) as pool:
        for i, step in enumerate(gradients, 1):
            soap.step(step, i, 1.0, None)
            (first if i <= 20 else second).step(step, i, 1.0, pool)
            if i == 20:
                for name, value in second.state().items():
                    value.copy_(first.state()[name])
    for a, b in zip(whole, resumed, strict=True):
        assert torch.equal(a, b)


def cells_and_points(encoding, half_m=1.0, count=500):
    generator = torch.Generator().manual_seed(1)
    points = (2 * torch.rand(count, 3, generator=generator) - 1) * half_m
    occupied = CellSet(0.2)
    occupied.insert(points.numpy())
    cells = VertexFeatures(occupied.sorted_keys(), 0.2, 3, encoding)
    with torch.no_grad():
        cells.features.copy_(torch.randn(cells.features.shape, generator=generator))
    return cells, points, generator


def steps(cells, batches, threads, learning_rate=1e-2):
    """Features after one step of RowAdam per batch of parts; the loss is the sum of interpolated features times weights."""
    adam = RowAdam(cells, learning_rate)
    with ThreadPool(threads) as pool:
        for i, parts in enumerate(batches, 1):
            points = torch.cat([points for points, _ in parts])
            shape = cells.interpolated_dim
            gradient = np.concatenate([np.broadcast_to(w, (len(p), shape)).copy() for p, w in parts])
            touched = Touched(points.numpy(), kernels.locate(points, cells.table).numpy(), gradient)
            adam.step(touched, i, 1.0, pool, meanwhile=lambda: None)
    return cells.features.detach().clone()


@pytest.mark.parametrize("encoding", [Encoding.TRI_QUADTREE, Encoding.OCTREE])
def test_sparse_adam_equals_dense_adam_if_all_rows_are_touched(encoding):
    cells, points, generator = cells_and_points(encoding)
    weights = torch.randn(10, len(points), cells.table.num_levels * 8, generator=generator)
    dense = cells.features.detach().clone().requires_grad_()
    mean, square = torch.zeros_like(dense), torch.zeros(len(dense), 1)
    for i, w in enumerate(weights, 1):
        loss = (kernels.interpolate(dense, points, cells.table) * w).sum()
        (gradient,) = torch.autograd.grad(loss, [dense])
        assert gradient.any(dim=1).all()
        mean = 0.9 * mean.bfloat16().float() + 0.1 * gradient
        square = 0.999 * square + 0.001 * (gradient**2).mean(1, keepdim=True)
        with torch.no_grad():
            dense -= 1e-2 / (1 - 0.9**i) * mean / (square / (1 - 0.999**i)).sqrt()
    before = cells.features.detach().clone()
    half = len(points) // 2  # as two threads' shares
    batches = [((points[:half], w[:half]), (points[half:], w[half:])) for w in weights]
    after = steps(cells, batches, threads=2)
    # Sums that differ in their last bit may round a mean to another bfloat16.
    difference = (after - dense.detach()).abs()
    assert (difference < 2e-5).float().mean() > 0.999
    assert difference.max() < 0.01 * 2**-6
    assert (after - before).abs().max() > 0.05


def test_untouched_rows_stay_and_their_momentum_decays():
    cells, points, _ = cells_and_points(Encoding.TRI_QUADTREE)
    left, right = points[points[:, 0] < -0.6], points[points[:, 0] > 0.6]
    one = torch.ones(1, 24)
    start = cells.features.detach().clone()
    sequence = [[(left, one)], [(right, one)], [(right, one)], [(left, -one)]]
    first = steps(cells, sequence[:1], threads=1)
    touched = (first != start).any(dim=1)
    assert 0 < touched.sum() < len(start)
    with torch.no_grad():
        cells.features.copy_(start)
    after = steps(cells, sequence, threads=1)
    # Rows touched only by the left batches: a step of the full rate, then one from moments three steps old.
    with torch.no_grad():
        cells.features.copy_(start)
    only_right = (steps(cells, sequence[1:2], threads=1) != start).any(dim=1)
    own = touched & ~only_right
    mean = 0.9**3 * 0.1 - 0.1
    square = 0.999**3 * 0.001 + 0.001
    second = -1e-2 * (mean / (1 - 0.9**4)) / (square / (1 - 0.999**4)) ** 0.5
    # Adam is invariant to the scale of a row's gradient, which differs only in sign.
    np.testing.assert_allclose((after - start)[own], np.float32(-1e-2 + second), atol=2e-5)
