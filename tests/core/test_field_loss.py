# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The core's losses and gradients against what autograd makes of the field and the losses as they are defined."""

from __future__ import annotations

import copy
import dataclasses
import gc

import numpy as np
import pytest
import torch
from radarsdf import FitConfig, _core
from radarsdf.field.field import Field
from radarsdf.fitting.autograd_gradients import AutogradGradients
from radarsdf.fitting.core_gradients import CoreGradients, _layers
from radarsdf.fitting.gradients import Share
from radarsdf.fitting.sampling import RaySampler
from radarsdf.returns.rays import prepare
from radarsdf.threads import Workers

from ..settings import grouped

CONFIGS = {
    "default": {},
    "octree": {"kind": "octree", "geometry_feature_dim": 3, "fourier_count": 0},
    "features": {"geometry_feature_dim": 15, "num_levels": 2, "fourier_count": 4},
    "free space": {"intensity_in_free_space": True, "feature_dropout": 0.0, "fourier_dropout": 0.0},
    "one dropout": {"feature_dropout": 0.0, "sdf_loss_weight": 0.3},
    "blind": {"sdf_input": False, "view_direction": False, "log_range": False, "intensity_hidden": (5,)},
    "not all": {"sdf_input": False, "log_range": False, "sdf_hidden": (17, 16, 3)},
    "intensities alone": {"sdf_loss_weight": 0.0},
}
STAGES = ("sdf", "joint", "intensity")


@pytest.fixture(scope="module")
def rays():
    generator = np.random.default_rng(0)
    scan = generator.normal(size=(300, 3)) * [2, 2, 0.1] + [0, 0, -4]
    return prepare([scan], np.eye(4)[None], [generator.uniform(size=300)])


@dataclasses.dataclass
class Batch:
    """A field, and what a thread would have of a batch."""

    field: Field
    config: FitConfig
    samples: object

    def backend(self, kind, **training):
        """Of one of two threads, with 0.7 of the dropout."""
        share = Share(0.7, torch.Generator().manual_seed(5))
        return kind(self.field, self.config.override(training=training), share)


def make_batch(rays, dtype=torch.float32, batch_size=400, **changes):
    config = FitConfig(**grouped(**changes))
    cells = _core.CellSet(config.leaf_size_m)
    for chunk in rays.along(np.linspace(-0.3, 0.3, 7)):
        cells.insert(chunk)
    field = Field(cells.sorted_keys(), config, with_intensity=True)
    field.initialise(torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.cells.features.mul_(6)
    generator = torch.Generator().manual_seed(1)
    sampler = RaySampler(
        rays, config, batch_size, generator, intensities=torch.from_numpy(rays.intensities.copy())
    )
    (samples,) = sampler.batch()
    exact = {name: getattr(samples, name).to(dtype) for name in ("points", "sdf_m", "of_ray")}
    return Batch(
        field.to(dtype), config, dataclasses.replace(samples, share=0.5, labelled_share=0.4, **exact)
    )


@pytest.fixture
def default_dtype(dtype):
    """What a dropout's factors have."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("instruction_set", "default_dtype")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("changes", CONFIGS.values(), ids=CONFIGS)
def test_same_as_autograd(rays, changes, stage, dtype):
    batch = make_batch(rays, dtype, **changes)
    backends = [batch.backend(kind, row_updates=False) for kind in (CoreGradients, AutogradGradients)]
    with Workers(1):
        found, expected = (getattr(backend, stage)(batch.samples) for backend in backends)
    assert found.touched is None
    assert expected.touched is None
    weight = batch.config.training.sdf_loss_weight
    tolerance = 3e-5 if dtype == torch.float32 else 1e-12
    assert found.losses.keys() == expected.losses.keys()
    for name, loss in found.losses.items():
        assert loss == pytest.approx(expected.losses[name], rel=tolerance)
        assert loss > 0.01 or (name, weight) == ("sdf", 0)
    assert len(found.by_parameters) == len(expected.by_parameters)
    for a, b in zip(found.by_parameters, expected.by_parameters, strict=True):
        assert b.abs().max() > 0 or (stage == "joint" and weight == 0)
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance * max(b.abs().max().item(), 1e-3))


@pytest.mark.usefixtures("default_dtype")
@pytest.mark.parametrize("dtype", [torch.float64])
@pytest.mark.parametrize("stage", ["sdf", "joint"])
@pytest.mark.parametrize("kind", [CoreGradients, AutogradGradients])
def test_the_touched_features_get_the_same_gradient(rays, kind, stage, dtype):
    batch = make_batch(rays, dtype)
    samples = batch.samples
    with Workers(1):
        dense, rows = (
            getattr(batch.backend(kind, row_updates=row_updates), stage)(samples)
            for row_updates in (False, True)
        )
        touched = rows.touched
        assert touched is not None
        by_features = torch.zeros_like(batch.field.cells.features)
        batch.field.cells.table.scatter(
            touched.points.numpy(),
            touched.located.numpy(),
            None,
            touched.gradient.numpy(),
            by_features.numpy(),
        )
    torch.testing.assert_close(by_features, dense.by_parameters[0], rtol=0, atol=1e-15)
    assert len(rows.by_parameters) == len(dense.by_parameters) - 1
    assert (touched.located[: samples.num_near, 0] >= 0).float().mean() > 0.9


@pytest.mark.parametrize("stage", STAGES)
def test_extreme_logits_and_no_samples(rays, stage):
    batch = make_batch(rays)
    samples = batch.samples
    with torch.no_grad():
        for parameter in batch.field.sdf_network.parameters():
            parameter.mul_(30)
    backend = batch.backend(CoreGradients, row_updates=False)
    with Workers(1):
        found = getattr(backend, stage)(samples)
        assert all(np.isfinite(loss) for loss in found.losses.values())
        assert all(p.isfinite().all() for p in found.by_parameters)
        none = dataclasses.replace(
            samples,
            points=samples.points[:0],
            sdf_m=samples.sdf_m[:0],
            of_ray=samples.of_ray[:0],
            num_near=0,
            num_labelled=0,
        )
        found = getattr(backend, stage)(none)
    assert set(found.losses.values()) == {0.0}
    assert not any(p.any() for p in found.by_parameters)


def test_not_a_number_is_passed_on(rays):
    batch = make_batch(rays)
    samples, backend = batch.samples, batch.backend(CoreGradients)
    samples.sdf_m[3] = float("nan")
    with Workers(1):
        assert np.isnan(backend.sdf(samples).losses["sdf"])
        samples.sdf_m[3] = 0
        samples.of_ray[2, 7] = float("nan")
        losses = backend.joint(samples).losses
    assert np.isnan(losses["intensity"])
    assert np.isfinite(losses["sdf"])


def core_arguments(batch):
    field = batch.field
    return {
        "table": field.cells.table,
        "features": field.cells.features.detach().numpy(),
        "frequencies": (409.6, 0, 10),
        "sdf": _layers(field.sdf_network),
        "intensity": _layers(field.intensity_network),
        "sees": (True, True, True),
        "sigma_m": batch.config.sigma_m,
        "intensity_in_free_space": False,
    }


def one_more_output(layers):
    weights, biases = layers
    return [*weights[:-1], np.repeat(weights[-1], 2, 0)], [*biases[:-1], np.repeat(biases[-1], 2)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frequencies": (409.6, 0, 9)}, "encodings of cells and positions"),
        ({"frequencies": (409.6, 20, 10)}, "frequencies must lie in"),
        ({"frequencies": (409.6, -1, 10)}, "frequencies must lie in"),
        ({"frequencies": (0.0, 0, 10)}, "half_width_m must be positive"),
        ({"sigma_m": 0.0}, "sigma_m must be positive"),
        ({"sigma_m": float("nan")}, "sigma_m must be positive"),
        ({"sees": (False, True, True)}, "see what it is said to"),
        ({"features": np.zeros((3, 8), np.float32)}, "features must have shape"),
        ({"sdf": ([], [])}, "at least one"),
        ({"intensity": one_more_output}, "one output"),
    ],
)
def test_the_core_refuses_networks_that_do_not_fit(rays, changes, message):
    arguments = core_arguments(make_batch(rays))
    _core.FieldLoss(**arguments)
    changes = {k: change(arguments[k]) if callable(change) else change for k, change in changes.items()}
    with pytest.raises(ValueError, match=message):
        _core.FieldLoss(**(arguments | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_labelled": 401}, "of the batch"),
        ({"num_labelled": -1}, "of the batch"),
        ({"points": np.zeros((400, 2), np.float32)}, "points must have shape"),
        ({"sdf_m": np.zeros(399, np.float32)}, "sdf_m must have shape"),
        ({"sdf_m": np.zeros((400, 1), np.float32)}, "sdf_m must have shape"),
        ({"rays": np.zeros((400, 7), np.float32)}, "rays must have shape"),
        ({"rays": np.zeros((8, 400), np.float32).T}, "contiguous rows"),
        ({"located": np.zeros((400, 2), np.int32)}, "located must have shape"),
        ({"interpolated_grad": np.zeros((400, 16), np.float32)}, "interpolated_grad must have shape"),
        ({"dropout": [(np.zeros((200, 23), np.uint8), 3)]}, "dropout must have shape"),
        ({"dropout": [(np.zeros((200, 24), np.uint8), 0)]}, "keep something"),
        ({"dropout": [(np.zeros((200, 24), np.uint8), 1)] * 3}, "only the two encodings"),
    ],
)
def test_the_core_refuses_batches_that_do_not_fit(rays, changes, message):
    made = make_batch(rays)
    samples = made.samples
    loss = _core.FieldLoss(**core_arguments(made))
    batch = {
        "points": samples.points.numpy(),
        "sdf_m": samples.sdf_m.numpy(),
        "rays": samples.of_ray.numpy(),
        "num_labelled": 200,
        "dropout": [],
    }
    outputs = {
        "located": np.zeros((400, 3), np.int32),
        "interpolated_grad": np.zeros((400, 24), np.float32),
    }
    calls = {
        loss.sdf: {"points": batch["points"], "sdf_m": batch["sdf_m"], "weight": 1.0} | outputs,
        loss.joint: batch | outputs | {"weights": (1.0, 1.0)},
        loss.intensity: batch | {"weight": 1.0},
    }
    refused = 0
    for call, arguments in calls.items():
        assert np.min(call(**arguments)) > 0
        if changes.keys() <= arguments.keys():
            refused += 1
            with pytest.raises(ValueError, match=message):
                call(**(arguments | changes))
    assert refused > 0


def test_the_core_refuses_other_types_and_a_missing_network(rays):
    batch = make_batch(rays)
    samples, arguments = batch.samples, core_arguments(batch)
    outputs = [np.zeros((400, 3), np.int32), np.zeros((400, 24), np.float64)]
    points, sdf_m = (samples.points.numpy().astype(np.float64), samples.sdf_m.numpy().astype(np.float64))
    with pytest.raises(TypeError, match="dtype of the features"):
        _core.FieldLoss(**arguments).sdf(points, sdf_m, 1.0, *outputs)
    with pytest.raises(TypeError):
        _core.FieldLoss(**(arguments | {"features": np.zeros((3, 8), np.int32)}))
    loss = _core.FieldLoss(**(arguments | {"intensity": None}))
    assert loss.intensity_gradients == []
    with pytest.raises(ValueError, match="no intensity network"):
        loss.intensity(samples.points.numpy(), samples.sdf_m.numpy(), samples.of_ray.numpy(), 200, [], 1.0)


def test_the_core_keeps_what_it_reads(rays):
    made = make_batch(rays)
    samples, arguments = made.samples, core_arguments(made)
    arguments["table"] = _core.VertexTable(
        made.field.cells.table.leaf_keys(), made.config.leaf_size_m, made.config.encoding.num_levels
    )
    for name in ("features", "sdf", "intensity"):
        arguments[name] = copy.deepcopy(arguments[name])
    loss = _core.FieldLoss(**arguments)
    batch = (samples.points.numpy(), samples.sdf_m.numpy(), samples.of_ray.numpy(), 200, [], 1.0)
    before = loss.intensity(*batch)
    gradients = loss.intensity_gradients
    arguments.clear()
    gc.collect()
    assert loss.intensity(*batch) == before
    del loss
    gc.collect()
    assert all(np.isfinite(gradient).all() for gradient in gradients)
