"""Losses and gradients of the core, against autograd of the definitions of field and losses."""

import dataclasses

import numpy as np
import pytest
import torch
from radarsdf import FitConfig, _core
from radarsdf.field.field import NeuralField
from radarsdf.fitting.sampling import Batch, RaySampler
from radarsdf.fitting.steps import AutogradGradients, CoreGradients
from radarsdf.fitting.surface_returns import near_leaf_keys
from radarsdf.returns.rays import prepare
from radarsdf.threads import ThreadPool

from ..settings import grouped

CONFIGS = {
    "default": {},
    "octree": {"kind": "octree", "geometry_feature_dim": 3, "fourier_count": 0},
    "features": {"geometry_feature_dim": 15, "fourier_count": 4},
    "free space": {"intensity_in_free_space": True, "dropout": False},
    "blind": {"view_direction": False, "log_range": False, "intensity_hidden": (5,)},
    "not all": {"log_range": False, "intensity_hidden": (17, 16, 3)},
}
STAGES = ("sdf", "joint", "intensity")


@pytest.fixture(scope="module")
def rays():
    generator = np.random.default_rng(0)
    scan = generator.normal(size=(300, 3)) * [2, 2, 0.1] + [0, 0, -4]
    return prepare([scan], np.eye(4)[None], [generator.uniform(size=300)])


@dataclasses.dataclass
class Made:
    """A field, and a batch of samples in three parts."""

    field: NeuralField
    config: FitConfig
    batch: Batch

    def gradients(self, kind, stage, threads=2, **training):
        """Gradients by a back end with 0.7 of the dropout, on `threads` threads."""
        config, generator = self.config.override(training=training), torch.Generator().manual_seed(5)
        with ThreadPool(threads) as workers:
            backend = kind(self.field, config, 0.7, generator, workers)
            found, result = backend.of(stage, self.batch, lambda: "meanwhile")
            assert result == "meanwhile"
            # Copies, since the back end reuses its arrays.
            return dataclasses.replace(found, by_parameters=[p.clone() for p in found.by_parameters])


def make_batch(rays, batch_size=400, parts=3, **changes):
    config = FitConfig(**grouped(**changes))
    field = NeuralField(near_leaf_keys(rays, config, 1), config, with_intensity=True)
    field.initialise(torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.cells.features.mul_(6)
    generator = torch.Generator().manual_seed(1)
    sampler = RaySampler(
        rays, config, batch_size, generator, intensities=torch.from_numpy(rays.intensities.copy())
    )
    batch = sampler.batch(parts)
    return Made(field, config, batch)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("changes", CONFIGS.values(), ids=CONFIGS)
def test_losses_and_gradients_equal_autograd(rays, changes, stage):
    batch = make_batch(rays, **changes)
    found, expected = (
        batch.gradients(kind, stage, optimiser="adam") for kind in (CoreGradients, AutogradGradients)
    )
    assert found.touched is None
    assert expected.touched is None
    tolerance = 3e-5
    assert found.losses.keys() == expected.losses.keys()
    for name, loss in found.losses.items():
        assert loss == pytest.approx(expected.losses[name], rel=tolerance)
        assert loss > 0.01
    assert len(found.by_parameters) == len(expected.by_parameters)
    for a, b in zip(found.by_parameters, expected.by_parameters, strict=True):
        assert b.abs().max() > 0
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance * max(b.abs().max().item(), 1e-3))


@pytest.mark.parametrize("stage", ["joint", "intensity"])
def test_nan_labels_have_no_loss(rays, stage):
    batch = make_batch(rays)
    whole = batch.gradients(CoreGradients, stage).losses["intensity"]
    for every, share in ((3, 2 / 3), (1, 0)):
        batch.batch.of_ray[::every, _core.RAY_INTENSITY] = np.nan
        found, expected = (
            batch.gradients(kind, stage, optimiser="adam") for kind in (CoreGradients, AutogradGradients)
        )
        assert found.losses["intensity"] == pytest.approx(share * whole, rel=0.1)
        assert found.losses == pytest.approx(expected.losses, rel=3e-5)
        for a, b in zip(found.by_parameters, expected.by_parameters, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=3e-5 * max(b.abs().max().item(), 1e-3))
    assert expected.by_parameters[-1].abs().max() == 0


@pytest.mark.parametrize("stage", ["sdf", "joint"])
def test_touched_features_have_the_gradient_of_autograd(rays, stage):
    batch = make_batch(rays)
    dense, rows = (batch.gradients(CoreGradients, stage, optimiser=name) for name in ("adam", "soap"))
    touched, by_features = rows.touched, torch.zeros_like(batch.field.cells.features)
    columns = touched.points, touched.located, None, touched.gradient
    batch.field.cells.table.scatter(*columns, by_features.numpy())
    torch.testing.assert_close(by_features, dense.by_parameters[0], rtol=0, atol=1e-6)
    assert len(rows.by_parameters) == len(dense.by_parameters) - 1
    near = np.abs(batch.batch.sdf_m) < 0.1
    assert (touched.located[near, 0] >= 0).mean() > 0.9


@pytest.mark.parametrize("stage", STAGES)
def test_threads_change_no_bit_and_parts_only_rounding(rays, stage):
    one, two, seven = (make_batch(rays).gradients(CoreGradients, stage, threads=n) for n in (1, 2, 7))
    for other in (two, seven):
        assert one.losses == other.losses
        for a, b in zip(one.by_parameters, other.by_parameters, strict=True):
            assert torch.equal(a, b)
    whole = make_batch(rays, parts=1).gradients(CoreGradients, stage)
    if stage != "sdf":  # dropout depends on positions of samples, which parts change
        return
    assert whole.losses == pytest.approx(one.losses, rel=1e-6)
    for a, b in zip(one.by_parameters, whole.by_parameters, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * b.abs().max().item())


@pytest.mark.parametrize("stage", STAGES)
def test_extreme_logits_and_empty_batches_are_finite(rays, stage):
    made = make_batch(rays)
    batch = made.batch
    with torch.no_grad():
        for parameter in made.field.sdf_network.parameters():
            parameter.mul_(30)
    found = made.gradients(CoreGradients, stage, optimiser="adam")
    assert all(np.isfinite(loss) for loss in found.losses.values())
    assert all(p.isfinite().all() for p in found.by_parameters)
    none = {name: getattr(batch, name)[:0] for name in ("points", "sdf_m", "of_ray")}
    made.batch = dataclasses.replace(batch, parts=[(0, 0)] * 2, **none)
    found = made.gradients(CoreGradients, stage, optimiser="adam")
    assert set(found.losses.values()) == {0.0}
    assert not any(p.any() for p in found.by_parameters)
