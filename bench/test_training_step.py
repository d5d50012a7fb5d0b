"""Time of a training step on one of two threads: the whole step, and its matrix products alone.

There is a group per stage of the schedule: geometry alone, geometry and intensity together, and intensity with
frozen geometry. All cases of a group run as many steps per round, so that times can be compared.
"""

import numpy as np
import pytest
import torch
from radarsdf import FitConfig
from radarsdf.field.field import NeuralField
from radarsdf.fitting.estimate import Schedule
from radarsdf.fitting.sampling import FREE_SAMPLES, NEAR_SAMPLES
from radarsdf.fitting.surface_returns import near_leaf_keys
from radarsdf.fitting.train import Training
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import prepare
from radarsdf.threads import ThreadPool

from .conftest import surface_points

STAGES = ("geometry", "joint", "intensity")
CONFIG = FitConfig(num_threads=1, returns={"drop_ghosts": False})
SHARE = 2  # a fit splits its batches among two threads


@pytest.fixture(scope="module")
def steps(smoke):
    """After 100 steps, a training checks its parameters and keeps a copy."""
    return 10 if smoke else 100


@pytest.fixture(scope="module")
def rays():
    scan = surface_points(100_000, dtype=np.float64) - [0, 0, 8]
    intensities = 10 * np.sin(scan[:, 0]) - 40 * np.log10(np.linalg.norm(scan, axis=1))
    return prepare([scan], np.eye(4)[None], [intensities])


@pytest.fixture(scope="module")
def leaf_keys(rays):
    return near_leaf_keys(rays, CONFIG, 1)


def new_field(stage, leaf_keys):
    field = NeuralField(leaf_keys, CONFIG, with_intensity=stage != "geometry", num_threads=1)
    field.initialise(torch.Generator().manual_seed(0))
    return field


def batch_size(stage):
    training = CONFIG.training
    return (training.intensity_batch_size if stage == "intensity" else training.batch_size) // SHARE


def group(stage, steps):
    return f"training step, {stage}, {batch_size(stage)} samples, {steps} steps a round"


@pytest.mark.parametrize("stage", STAGES)
def test_whole(benchmark, stage, steps, rays, leaf_keys):
    """Steps of `Training` on one thread. The stage with frozen geometry follows one step of geometry."""
    field = new_field(stage, leaf_keys)
    scale = IntensityScale.of(rays.intensities) if stage != "geometry" else None
    config = CONFIG.override(
        training={
            "batch_size": CONFIG.training.batch_size // SHARE,
            "intensity_batch_size": CONFIG.training.intensity_batch_size // SHARE,
            "sdf_iterations": 1 if stage == "intensity" else steps,
            "intensity_iterations": {"geometry": 1, "joint": 1, "intensity": steps + 1}[stage],
        }
    )
    count, vertices = len(rays), field.cells.table.num_rows
    labelled = [] if scale is None else [count]
    schedule = Schedule.of(config, surface_returns=count, vertices=vertices, labelled=labelled)
    losses = []

    def setup():
        field.requires_grad_(True)  # a training freezes all parameters at its end
        return (Training(field, rays, rays, scale, schedule, config, pool),), {}

    def run(training):
        training.run(progress=False)
        losses.append(training.losses["intensity" if stage == "intensity" else "sdf"])

    benchmark.group = group(stage, steps)
    with ThreadPool(1) as pool:
        benchmark.pedantic(run, setup=setup, rounds=10, warmup_rounds=1)
        while len(losses) < 5:  # with --benchmark-disable there is one round
            run(*setup()[0])
    # Each round continues the training of the previous one; after convergence, the last losses are noise.
    assert min(losses[1:]) < losses[0]


def products(stage, field):
    """Operands of all matrix products of the layers: forward, gradients of the weights, gradients of the inputs."""
    size = batch_size(stage)
    num_near = size * NEAR_SAMPLES // (NEAR_SAMPLES + FREE_SAMPLES)
    geometry = linear(field.sdf_network)
    operands = [
        operand for layer in geometry for operand in layer_products(layer, size, stage != "intensity", True)
    ]
    if stage != "geometry":
        rows = size if stage == "intensity" else num_near
        for i, layer in enumerate(linear(field.intensity_network)):
            operands += layer_products(layer, rows, True, i > 0 or stage == "joint")
    return operands


def layer_products(layer, rows, to_weights, to_inputs):
    inputs, grad = torch.randn(rows, layer.in_features), torch.randn(rows, layer.out_features)
    weight = layer.weight.detach()
    operands = [(inputs, weight.T)] + to_weights * [(inputs.T, grad)]
    return operands + (to_weights and to_inputs) * [(grad, weight)]


def linear(network):
    return [layer for layer in network.layers if isinstance(layer, torch.nn.Linear)]


@pytest.mark.parametrize("stage", STAGES)
def test_matrix_products(benchmark, stage, steps, leaf_keys):
    """Matrix products of the networks, forward and backward: no encoding, loss, bias, ReLU or optimiser."""
    operands = products(stage, new_field(stage, leaf_keys))
    benchmark.group = group(stage, steps)

    def run():
        for _ in range(steps):
            result = [torch.mm(a, b) for a, b in operands]
        return result

    with ThreadPool(1):
        found = benchmark.pedantic(run, rounds=10, warmup_rounds=1)
    for product, (a, b) in zip(found, operands, strict=True):
        expected = a.double().sum(0) @ b.double().sum(1)
        scale = (product.double() ** 2).sum().sqrt()
        assert abs(product.double().sum() - expected) < 1e-3 * scale
