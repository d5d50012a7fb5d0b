# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time of a training step on one of two threads: the whole step, its parts, and its matrix products alone.

There is a group for each stage of the schedule: geometry alone, geometry and intensity together, and intensity with
frozen geometry. A round has `STEPS` steps in all cases of a group, so that times can be compared. The whole step is
that of `Training`, which gets losses and gradients from the core in one call. The parts are rebuilt here with autograd,
from the definitions of field and losses.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from radarsdf import FitConfig
from radarsdf.field.losses import intensity_loss, sdf_loss
from radarsdf.field.neural_field import NeuralField, cells_width, fourier_width
from radarsdf.fitting.average import near_leaf_keys
from radarsdf.fitting.gradients import FEATURE_DROPOUT, FOURIER_DROPOUT
from radarsdf.fitting.optimiser import Adam
from radarsdf.fitting.sampling import Dropout, RaySampler
from radarsdf.fitting.schedule import Schedule
from radarsdf.fitting.train import Training
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import prepare
from radarsdf.threads import Workers

from .conftest import Surface, surface_points

STEPS = 100  # after this many steps, a training checks its parameters and keeps a copy
STAGES = ("geometry", "joint", "intensity")
CONFIG = FitConfig(num_threads=1, returns={"drop_ghosts": False}, training={"cosine_schedule": False})
SHARE = 2  # a fit divides its batches among two threads


class Step:
    """One stage of a fit on one thread: its data and networks, and the parts of a step as methods."""

    def __init__(self, stage, rays, leaf_keys):
        self.stage = stage
        self.frozen = stage == "intensity"
        self.size = (
            CONFIG.training.intensity_batch_size if self.frozen else CONFIG.training.batch_size
        ) // SHARE
        self.field = NeuralField(leaf_keys, CONFIG, with_intensity=stage != "geometry")
        self.field.initialise(torch.Generator().manual_seed(0))
        if self.frozen:
            self.field.cells.requires_grad_(False)
            self.field.sdf_network.requires_grad_(False)
        self.parameters = [p for p in self.field.parameters() if p.requires_grad]
        unit = torch.from_numpy(IntensityScale.of(rays.intensities).to_unit(rays.intensities))
        self.generator = torch.Generator().manual_seed(0)
        self.sampler = RaySampler(rays, CONFIG, self.size, self.generator, intensities=unit)

    def samples(self):
        """Samples, and dropout factors for the inputs of the intensity network."""
        batch = self.sampler.spread(self.size) if self.frozen else self.sampler.batch()
        (samples,) = batch.split()
        if self.stage == "geometry":
            return samples, None
        dims = (cells_width(CONFIG), fourier_width(CONFIG))
        dropouts = (FEATURE_DROPOUT, FOURIER_DROPOUT)
        factors = [
            Dropout.draw(share, self.generator).factors(samples.num_near, dim)
            for dim, share in zip(dims, dropouts, strict=True)
        ]
        return samples, factors

    def encoded(self, samples):
        with torch.set_grad_enabled(not self.frozen):
            return self.field.encode(samples.points)

    def losses(self, samples, dropout, encoding):
        """Losses of the stage: of the SDF, of the intensity, or both."""
        with torch.set_grad_enabled(not self.frozen):
            logit, feature = self.field.sdf_network(encoding)
        losses = [] if self.frozen else [sdf_loss(logit, samples.sdf_m, CONFIG.sigma_m)]
        if self.stage != "geometry":
            near = slice(samples.num_near)
            predicted = self.field.intensity_network(
                [part[near] * factors for part, factors in zip(encoding, dropout, strict=True)],
                logit[near],
                feature[near],
                None,
                samples.directions[near],
                samples.ranges_m[near] - samples.sdf_m[near],
            )
            losses.append(intensity_loss(predicted, samples.intensities[near]))
        return losses

    def products(self):
        """Operands of all matrix products of the layers: forward, gradients of the weights, gradients of the inputs."""
        layers = []
        if not self.frozen:
            layers.append((self.field.sdf_network.layers, self.size, True))
        if self.stage != "geometry":
            rows = self.samples()[0].num_near
            layers.append((self.field.intensity_network.layers, rows, not self.frozen))
        operands = [] if not self.frozen else self._forward(self.field.sdf_network.layers, self.size)
        for modules, rows, to_inputs in layers:
            operands += self._forward(modules, rows)
            for i, layer in enumerate(linear(modules)):
                inputs, grad = torch.randn(rows, layer.in_features), torch.randn(rows, layer.out_features)
                operands.append((inputs.T, grad))
                if i > 0 or to_inputs:
                    operands.append((grad, layer.weight.detach()))
        return operands

    @staticmethod
    def _forward(modules, rows):
        return [(torch.randn(rows, layer.in_features), layer.weight.detach().T) for layer in linear(modules)]


def linear(modules):
    return [layer for layer in modules if isinstance(layer, torch.nn.Linear)]


@pytest.fixture(scope="module")
def rays():
    scan = surface_points(100_000, dtype=np.float64) - [0, 0, 8]
    intensities = 10 * np.sin(scan[:, 0]) - 40 * np.log10(np.linalg.norm(scan, axis=1))
    return prepare([scan], np.eye(4)[None], [intensities])


@pytest.fixture(scope="module")
def leaf_keys(rays):
    return near_leaf_keys(rays, CONFIG, 1)


@pytest.fixture(params=STAGES)
def step(request, rays, leaf_keys):
    with Workers(1):
        yield Step(request.param, rays, leaf_keys)


def measured(benchmark, step, function, *arguments):
    """Measure `function`, and return its last result."""
    benchmark.group = f"training step, {step.stage}, {step.size} samples, {STEPS} steps a round"

    def run():
        for _ in range(STEPS):
            result = function(*arguments)
        return result

    return benchmark.pedantic(run, rounds=10, warmup_rounds=1)


def test_samples(benchmark, step, rays):
    samples, dropout = measured(benchmark, step, step.samples)
    points = (samples.of_ray[:, :3] - samples.sdf_m[:, None] * samples.directions).numpy()
    off_m = np.linalg.norm(points - samples.points.numpy(), axis=1)
    # In the last stage, samples are spread across the beam.
    spread_m = CONFIG.training.cross_range_noise_rad * samples.ranges_m.numpy() if step.frozen else 1e-5
    assert (off_m < 6 * spread_m).all()
    assert np.median(off_m / spread_m) > 1 or not step.frozen
    assert len(samples.points) == step.size
    returns = np.unique(samples.of_ray[:, :3].numpy(), axis=0)
    assert np.isin(returns, rays.points).all()
    assert len(returns) > 0.45 * step.size
    if dropout is not None:
        factors = torch.cat(dropout, 1)
        assert factors.mean().item() == pytest.approx(1, abs=0.05)
        assert (factors == 0).float().mean().item() > FOURIER_DROPOUT


def test_encodings_forward(benchmark, step):
    samples, _ = step.samples()
    cells, fourier = (part.detach() for part in measured(benchmark, step, step.encoded, samples))
    angles = fourier.double().view(len(fourier), 2, -1)
    assert ((angles**2).sum(1) - 1).abs().max() < 1e-5
    points = samples.points.numpy()[: samples.num_near]
    known = step.field.occupied(samples.points[: samples.num_near]).numpy()
    assert known.mean() > 0.8
    surface = Surface(step.field.table, step.field.cells.features.detach())
    rows, weights = surface.rows_and_weights(points[known])
    expected = (surface.features.numpy()[rows] * weights[..., None]).sum(2).reshape(known.sum(), -1)
    found = cells[: samples.num_near].numpy()[known]
    assert np.abs(found - expected).max() < 1e-4


def test_networks_forward(benchmark, step):
    samples, dropout = step.samples()
    cells, fourier = (part.detach() for part in step.encoded(samples))
    encoding = (cells.requires_grad_(not step.frozen), fourier)
    losses = measured(benchmark, step, step.losses, samples, dropout, encoding)
    inputs = torch.cat(encoding, 1).detach().numpy()
    logit = mlp(step.field.sdf_network.layers, inputs)
    expected = []
    if not step.frozen:
        label = 1 / (1 + np.exp(-samples.sdf_m.double().numpy() / CONFIG.sigma_m))
        expected.append((np.logaddexp(0, logit) - label * logit).mean())
    if dropout is not None:
        near = slice(samples.num_near)
        range_m = (samples.ranges_m[near] - samples.sdf_m[near]).double().numpy()
        harmonics = step.field.intensity_network.harmonics(samples.directions[near]).numpy()
        factors = torch.cat(dropout, 1).numpy()
        inputs = [inputs[near] * factors, logit[near, None], harmonics, np.log10(range_m / 10)[:, None]]
        predicted = mlp(step.field.intensity_network.layers, np.concatenate(inputs, 1))
        expected.append(np.abs(predicted - samples.intensities[near].numpy()).mean())
    assert [loss.item() for loss in losses] == pytest.approx(expected, rel=1e-4)


def mlp(modules, inputs):
    layers = linear(modules)
    for i, layer in enumerate(layers):
        inputs = inputs.astype(np.float64) @ layer.weight.detach().double().numpy().T
        inputs = inputs + layer.bias.detach().double().numpy()
        inputs = inputs if i == len(layers) - 1 else np.maximum(inputs, 0)
    return inputs[:, 0]


def test_backward(benchmark, step):
    samples, dropout = step.samples()
    loss = sum(step.losses(samples, dropout, step.encoded(samples)))
    gradients = measured(
        benchmark, step, lambda: torch.autograd.grad(loss, step.parameters, retain_graph=True)
    )
    # The slope of the loss along its gradient is the squared length of the gradient. The forward pass, which is checked
    # above, gives this slope by finite differences: in double precision, and separately for the features, because the
    # gradient of the networks is larger.
    step.field.double()
    exact = {name: getattr(samples, name).double() for name in ("points", "sdf_m", "of_ray")}
    samples = dataclasses.replace(samples, **exact)
    dropout = None if dropout is None else [factors.double() for factors in dropout]
    gradients = dict(zip(step.parameters, gradients, strict=True))
    features = [p for p in step.field.cells.parameters() if p in gradients]
    networks = [p for p in step.parameters if all(p is not other for other in features)]
    for parameters in [networks] if step.frozen else [features, networks]:
        square = sum((gradients[p].double() ** 2).sum().item() for p in parameters)
        h = 1e-5 / square**0.5
        ends = []
        for share in (h, -2 * h, h):
            with torch.no_grad():
                for p in parameters:
                    p.add_(gradients[p].double(), alpha=share)
                ends.append(sum(step.losses(samples, dropout, step.encoded(samples))).item())
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(square, rel=0.01)


def test_adam(benchmark, step):
    samples, dropout = step.samples()
    loss = sum(step.losses(samples, dropout, step.encoded(samples)))
    gradients = torch.autograd.grad(loss, step.parameters)
    before = [p.detach().clone() for p in step.parameters]
    adam = Adam(step.parameters, CONFIG.training.learning_rate)
    steps = 0

    def run():
        nonlocal steps
        adam.step(gradients)
        steps += 1

    measured(benchmark, step, run)
    # With a constant gradient, each step of Adam has the length of the learning rate.
    check_moves(step, before, gradients, steps * CONFIG.training.learning_rate)
    # Then a gradient that is twice as large.
    before = [p.detach().clone() for p in step.parameters]
    adam.step([2 * gradient for gradient in gradients])
    mean = (0.9 * (1 - 0.9**steps) + 0.1 * 2) / (1 - 0.9 ** (steps + 1))
    square = (0.999 * (1 - 0.999**steps) + 0.001 * 4) / (1 - 0.999 ** (steps + 1))
    check_moves(step, before, gradients, CONFIG.training.learning_rate * mean / square**0.5)


def check_moves(step, before, gradients, length):
    for parameter, start, gradient in zip(step.parameters, before, gradients, strict=True):
        moved = (start - parameter.detach()) / length
        moves = gradient.abs() > 1e-9
        assert moves.any()
        torch.testing.assert_close(moved[moves], gradient[moves].sign(), rtol=0, atol=0.003)
        assert (moved[gradient == 0] == 0).all()


def test_matrix_products(benchmark, step):
    """Matrix products of the networks, forward and backward: no encoding, loss, bias, ReLU or optimiser."""
    operands = step.products()

    def run():
        return [torch.mm(a, b) for a, b in operands]

    products = measured(benchmark, step, run)
    for product, (a, b) in zip(products, operands, strict=True):
        expected = a.double().sum(0) @ b.double().sum(1)
        scale = (product.double() ** 2).sum().sqrt()
        assert abs(product.double().sum() - expected) < 1e-3 * scale


def test_whole(benchmark, step, rays):
    """`STEPS` steps of `Training` on one thread. The stage with frozen geometry follows one step of geometry."""
    field = NeuralField(
        step.field.table.leaf_keys(), CONFIG, with_intensity=step.stage != "geometry", num_threads=1
    )
    field.initialise(torch.Generator().manual_seed(0))
    scale = IntensityScale.of(rays.intensities) if step.stage != "geometry" else None
    joint = step.stage == "joint"
    config = CONFIG.override(
        training={
            "batch_size": CONFIG.training.batch_size // SHARE,
            "intensity_batch_size": CONFIG.training.intensity_batch_size // SHARE,
            "sdf_iterations": 1 if step.frozen else STEPS,
            "intensity_iterations": 1 if joint else STEPS,
            "joint": joint,
        }
    )
    schedule = Schedule.of(
        config,
        surface_returns=len(rays),
        returns=len(rays),
        vertices=field.table.num_rows,
        with_intensity=scale is not None,
    )
    losses = []

    def setup():
        field.requires_grad_(True)  # a training freezes all parameters at its end
        training = Training(field, rays, rays, scale, schedule, config, workers)
        return (training,), {}

    def run(training):
        training.run(progress=False)
        losses.append(training.losses)

    benchmark.group = f"training step, {step.stage}, {step.size} samples, {STEPS} steps a round"
    with Workers(1) as workers:
        benchmark.pedantic(run, setup=setup, rounds=10, warmup_rounds=1)
        if len(losses) == 1:  # with --benchmark-disable there is one round, too few steps for the check below
            for _ in range(4):
                run(*setup()[0])
    name = "intensity" if step.frozen else "sdf"
    samples, dropout = step.samples()
    untrained = sum(step.losses(samples, dropout, step.encoded(samples))).item()
    assert losses[-1][name] < 0.75 * untrained  # each round continues the training of the one before
