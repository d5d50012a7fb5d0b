# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Training at the edges of its settings: every number stays finite."""

from __future__ import annotations

import pytest
import torch
from radarsdf import FitConfig
from radarsdf.field.losses import sdf_loss
from radarsdf.fitting.stopping import DivergenceWatch

from .extreme import CASES, fitted, free_and_solid


@pytest.mark.parametrize("name", CASES)
def test_every_number_stays_finite(name):
    _, end = fitted(CASES[name], 40)
    if name.startswith("learning rates 1"):  # too much: answers beyond all measure
        assert "the sdf loss is" in end
        assert "more than if all distances had the wrong sign, at iteration 39 of 40" in end
    else:
        assert end == "done"


@pytest.mark.parametrize("optimiser", ["soap", "adam"])
@pytest.mark.parametrize("joint", [True, False])
@pytest.mark.parametrize(
    ("rate", "loss"), [("learning_rate", "sdf"), ("intensity_learning_rate", "intensity")]
)
def test_answers_beyond_all_measure_are_a_divergence_although_finite(rate, loss, joint, optimiser):
    radar_map, end = fitted({"training": {rate: 1e3, "joint": joint, "optimiser": optimiser}}, 40)
    assert "more than" in end
    assert loss in end or joint  # jointly, one network ruins the other too
    assert radar_map.sdf([[0.0, 0.0, 0.0]], extrapolate=True)[0] > -1
    assert abs(radar_map.intensity([[4.0, 0.0, 0.0]], [0.0, 0.0, 0.0], extrapolate=True)[0]) < 1000


def test_the_bound_of_the_distances_is_one():
    labels = torch.linspace(-30, 30, 500)
    for scale in (0.01, 1.0, 10.0):
        distances_m, config = scale * labels, FitConfig()
        for wrong in (-distances_m, torch.zeros(500)):
            loss = float(sdf_loss(wrong / config.sigma_m, distances_m, config.sigma_m))
            watch = DivergenceWatch(config)
            watch.add({"sdf": loss}, distances_m)
            assert watch.fault() is None
        longer = float(sdf_loss(-2 * distances_m / config.sigma_m - 9, distances_m, config.sigma_m))
        watch.add({"sdf": 2 * longer}, distances_m)
        assert "wrong sign" in watch.fault()


def test_a_few_bad_iterations_are_no_divergence_and_the_count_goes_on():
    sdf_m = torch.full((8,), 0.1)  # one sigma: at worst 2
    watch, again = DivergenceWatch(FitConfig()), DivergenceWatch(FitConfig())
    for i in range(100):
        watch.add({"sdf": 50.0 if i in (3, 4) else 0.3, "intensity": 20.0 if i == 5 else 0.02}, sdf_m)
    assert watch.fault() is None
    again.restore(watch.state().clone())
    for _ in range(4):
        for one in (watch, again):
            one.add({"intensity": 40.0}, sdf_m)
    assert watch.fault() == again.fault()
    assert "range of intensities" in watch.fault()


def test_a_loss_without_weight_is_no_fault():
    watch = DivergenceWatch(FitConfig(training={"sdf_loss_weight": 0.0}))
    watch.add({"sdf": 0.0, "intensity": 0.5}, torch.ones(3))
    assert watch.fault() is None


def test_the_default_finds_the_walls():
    radar_map, _ = fitted(CASES["default"], 200)
    assert min(free_and_solid(radar_map)) > 0.9


def test_a_rate_of_a_tenth_still_finds_them():
    radar_map, _ = fitted(CASES["learning rates 0.1"], 200)
    assert min(free_and_solid(radar_map)) > 0.8


def test_what_overflows_is_said_and_the_map_before_is_kept():
    radar_map, end = fitted({"training": {"learning_rate": 1e30, "cosine_schedule": False}}, 40)
    assert "loss is" in end or "not finite" in end
    assert sum(radar_map.report["iterations_done"].values()) < 80
