"""Inputs and outputs of the networks, and the parameters trained by each loss."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from radarsdf import FitConfig
from radarsdf._core import CellSet
from radarsdf.field.field import Geometry, IntensityNetwork, NeuralField, cells_width, fourier_width
from radarsdf.fitting.steps import sdf_loss

BARE = FitConfig(networks={"view_direction": False, "log_range": False})


def geometry_of(config, count=20):
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    encoding = (normal(count, cells_width(config)), normal(count, fourier_width(config)))
    feature = normal(count, config.networks.geometry_feature_dim)
    normals = torch.nn.functional.normalize(normal(count, 3), dim=1) if config.networks.normals else None
    return Geometry(encoding, normal(count), feature, normals)


def make_field(config, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = np.random.default_rng(seed).uniform(-1, 1, (2000, 3)).astype(np.float32)
    cells = CellSet(config.leaf_size_m)
    cells.insert(points)
    field = NeuralField(cells.sorted_keys(), config, with_intensity=True)
    field.initialise(generator)
    torch.nn.init.normal_(field.cells.features, generator=generator)
    return field, torch.from_numpy(points[:200])


def views(points):
    rays = points - torch.tensor([0.0, 0.0, 8.0])
    return rays / rays.norm(dim=1, keepdim=True), rays.norm(dim=1)


@pytest.mark.parametrize(
    ("setting", "seen", "width"),
    [
        ({"geometry_feature_dim": 15}, "feature", 15),
        ({"normals": True}, "normals", 3),
        ({"view_direction": True}, "directions", 16),
        ({"log_range": True}, "ranges_m", 1),
    ],
)
def test_the_intensity_network_uses_the_chosen_inputs(setting, seen, width):
    config = BARE.override(encoding={"fourier_count": 1}, networks=setting)
    network = IntensityNetwork(config)
    network.initialise(torch.Generator().manual_seed(0))
    assert network.layers[0].in_features == 24 + 6 + 1 + width
    geometry, (directions, ranges_m) = geometry_of(config), views(torch.rand(20, 3))
    before = network(geometry, directions, ranges_m)
    assert before.shape == (20,)
    for name in ("logit", "feature", "normals"):
        value = getattr(geometry, name)
        if value is not None and value.numel():
            changed = dataclasses.replace(geometry, **{name: value.roll(1, 0)})
            assert not torch.equal(network(changed, directions, ranges_m), before), name
    assert torch.equal(network(geometry, directions.roll(1, 0), ranges_m), before) != (seen == "directions")
    assert torch.equal(network(geometry, directions, ranges_m.roll(1, 0)), before) != (seen == "ranges_m")


def intensity(field, points, *, frozen=True):
    return field.intensity_network(field.geometry(points, frozen=frozen), *views(points))


@torch.no_grad()
def test_with_a_closed_form_predictions_stay_in_the_training_range():
    field, points = make_field(FitConfig())
    alone = field.intensity(points, *views(points))
    assert torch.equal(alone, intensity(field, points))
    for added in (-5.0, 0.1, 5.0):
        added_at = lambda x, *_, a=added: np.full(len(x), a, np.float32)
        field.reflectance = SimpleNamespace(network_share=0.5, at=added_at)
        expected = (added + alone / 2).clamp(0, 1)
        np.testing.assert_allclose(field.intensity(points, *views(points)), expected, atol=1e-6)


def test_normals_are_the_normalised_gradient():
    config = FitConfig(networks={"normals": True, "intensity_hidden": (8,)})
    field, points = make_field(config)
    seen = []
    field.intensity_network.register_forward_pre_hook(lambda _, given: seen.append(given[0].normals))
    intensity(field, points)
    x = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(field.logit(x).sum(), x)
    np.testing.assert_allclose(seen[0], gradient / gradient.norm(dim=1, keepdim=True), atol=1e-5)


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("geometry_frozen", [False, True])
def test_the_intensity_loss_trains_geometry_only_if_enabled(normals, geometry_frozen):
    field, points = make_field(FitConfig(networks={"normals": normals, "geometry_feature_dim": 3}))
    intensity(field, points, frozen=geometry_frozen).sum().backward()
    geometry = [*field.cells.parameters(), *field.sdf_network.parameters()]
    assert all(p.grad is not None and p.grad.any() for p in field.intensity_network.parameters())
    assert any(p.grad is not None and bool(p.grad.any()) for p in geometry) != geometry_frozen


def test_the_sdf_loss_is_lowest_where_the_logit_is_the_label():
    sdf_m = torch.linspace(-0.3, 0.3, 13)
    logit = (sdf_m / 0.1).requires_grad_()
    loss = sdf_loss(logit, sdf_m, 0.1)
    (gradient,) = torch.autograd.grad(loss, logit)
    assert gradient.abs().max() < 1e-7
    # Entropy of sigmoid(label / sigma), the lower bound of the loss.
    p = torch.sigmoid(sdf_m / 0.1)
    entropy = -(p * p.log() + (1 - p) * (1 - p).log()).mean()
    assert loss.item() == pytest.approx(entropy.item(), rel=1e-5)
    assert sdf_loss(-logit, sdf_m, 0.1) > loss
