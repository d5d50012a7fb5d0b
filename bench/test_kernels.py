# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The kernels of encoding and training against the same computation in plain PyTorch.

Each case asserts a checksum from NumPy in double precision, so that a wrong answer cannot win. Ratios within a group
and one run mean something; times of different runs or machines do not: see README.md.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from radarsdf import FitConfig, kernels
from radarsdf._core import CellSet, VertexTable
from radarsdf.field import Field
from radarsdf.losses import sdf_loss
from radarsdf.optimiser import Adam
from radarsdf.sampling import RaySampler
from radarsdf.scans import prepare
from radarsdf.threads import Workers

from .conftest import FEATURE_DIM, LEAF_M, NUM_LEVELS, surface_points


def ours(features, points, surface, *_):
    return kernels.interpolate(features, points, surface.table)


def indexing(features, _points, _surface, rows, weights):
    return (features[rows] * weights[..., None]).sum(2).flatten(1)


def embedding_bag(features, _points, _surface, rows, weights):
    flat = torch.nn.functional.embedding_bag(
        rows.view(-1, 12), features, per_sample_weights=weights.view(-1, 12), mode="sum"
    )
    return flat.view(len(rows), -1)


WAYS = {"ours, look-up included": ours, "indexing": indexing, "embedding_bag": embedding_bag}


@pytest.mark.parametrize("way", WAYS)
def test_interpolation_forward(benchmark, surface, batch, way):
    points, rows, weights, expected, absolute = batch
    benchmark.group = f"interpolation forward, {len(points)} points"
    with torch.no_grad():
        out = benchmark(WAYS[way], surface.features, points, surface, rows, weights)
    assert out.shape == (len(points), NUM_LEVELS * FEATURE_DIM)
    assert abs(out.double().sum().item() - expected) < 1e-3 * absolute


@pytest.mark.parametrize("way", WAYS)
def test_interpolation_forward_and_backward(benchmark, surface, batch, way):
    points, rows, weights, expected, absolute = batch
    benchmark.group = f"interpolation forward and backward, {len(points)} points"
    features = surface.features.clone().requires_grad_()

    def run():
        out = WAYS[way](features, points, surface, rows, weights)
        return torch.autograd.grad(out.sum(), features)[0]

    gradient = benchmark(run)
    # The output is linear in the features, and so their product with its gradient is the output again.
    total = (gradient.double() * surface.features.double()).sum().item()
    assert abs(total - expected) < 1e-3 * absolute
    assert gradient.double().sum().item() == pytest.approx(
        3.0 * NUM_LEVELS * FEATURE_DIM * len(points), rel=1e-5
    )


@pytest.mark.parametrize("way", ["ours", "torch"])
def test_fourier(benchmark, batch, way):
    points, half_width_m, count = batch[0], 409.6, 16
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
    assert (out - expected).abs().max() < 3e-4  # of float32 angles up to 4000; ours is exact to 1e-6


@pytest.fixture(scope="module", params=[1_000_000, 10_000_000], ids=["1e6", "1e7"])
def cloud(request):
    points = surface_points(request.param, seed=1)
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


@pytest.mark.parametrize("batch_size", [1024, 8192])
def test_training_step(benchmark, batch_size):
    """Samples, both encodings, SDF network, loss, gradients and Adam, as one worker of a fit does it."""
    benchmark.group = f"training step, {batch_size} samples, one thread"
    config = FitConfig()
    scan = surface_points(100_000, dtype=np.float64) - [0, 0, 8]
    rays = prepare([scan], np.eye(4)[None])
    cells = CellSet(config.leaf_size_m)
    for chunk in rays.along(np.linspace(-config.near_band_m, config.near_band_m, 7)):
        cells.insert(chunk)
    torch.manual_seed(0)
    field = Field(cells.sorted_keys(), config, with_intensity=False)
    field.cells.initialise(config.feature_std)
    parameters = list(field.parameters())
    adam = Adam(parameters, config.learning_rate, config.adam_epsilon)
    sampler = RaySampler(rays, config, batch_size, torch.Generator().manual_seed(0))

    def step():
        samples = sampler.batch()
        loss = sdf_loss(field.logit(samples.points), samples.sdf_m, config.sigma_m)
        adam.step(torch.autograd.grad(loss, parameters))
        return loss.item()

    with Workers(1):
        before = step()
        benchmark.pedantic(step, rounds=100, warmup_rounds=5)
        after = [step() for _ in range(60)][
            -1
        ]  # enough to learn something where nothing is timed and there is one round
    assert after < 0.8 * before
