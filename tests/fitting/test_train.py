"""Losses of a training: their history, detection of divergence, and the partition of batches."""

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.fitting import train
from radarsdf.fitting.estimate import Schedule
from radarsdf.fitting.steps import CoreGradients, sdf_loss
from radarsdf.fitting.train import LossHistory

from ..settings import grouped
from .extreme import CASES, fitted, free_and_solid

NONE = np.zeros(1)


def history(config=None, **iterations):
    found = LossHistory(iterations or {"sdf": 10**6, "intensity": 10**6}, config or FitConfig())
    found.start()
    return found


def test_loss_history_has_the_means_of_all_iterations(monkeypatch):
    monkeypatch.setattr(train, "_MOST_SPANS", 4)
    losses = history(sdf=10, intensity=0)
    for done in range(1, 11):
        losses.add({"sdf": float(done)}, {"sdf": done}, NONE)
    found = losses.to_report()
    assert list(found) == ["sdf"]
    assert found["sdf"]["iterations"] == [3, 5, 8, 10]
    assert found["sdf"]["losses"] == [2.0, 4.5, 7.0, 9.5]
    assert found["sdf"]["seconds"] == sorted(found["sdf"]["seconds"])


def test_the_bound_of_distances_is_an_upper_bound():
    labels = torch.linspace(-30, 30, 500)
    for scale in (0.01, 1.0, 10.0):
        distances_m, config = scale * labels, FitConfig()
        for wrong in (-distances_m, torch.zeros(500)):
            loss = float(sdf_loss(wrong / config.sigma_m, distances_m, config.sigma_m))
            losses = history()
            losses.add({"sdf": loss}, {"sdf": 1}, distances_m.numpy())
            assert losses.fault() is None
        longer = float(sdf_loss(-2 * distances_m / config.sigma_m - 9, distances_m, config.sigma_m))
        losses.add({"sdf": 2 * longer}, {"sdf": 2}, distances_m.numpy())
        assert "wrong sign" in losses.fault()


def test_a_few_bad_iterations_are_no_divergence():
    sdf_m = np.full(8, 0.1)  # one sigma: at worst 2
    losses, again = history(), history()
    for i in range(100):
        found = {"sdf": 50.0 if i in (3, 4) else 0.3, "intensity": 20.0 if i == 5 else 0.02}
        losses.add(found, dict.fromkeys(found, i + 1), sdf_m)
    assert losses.fault() is None
    for name, tensor in again.state().items():
        tensor.copy_(losses.state()[name])
    for i in range(100, 104):
        for one in (losses, again):
            one.add({"intensity": 40.0}, {"intensity": i + 1}, sdf_m)
    assert losses.fault() == again.fault()
    assert "range of intensities" in losses.fault()
    reports = [one.to_report()["intensity"] for one in (losses, again)]
    assert reports[0]["losses"] == reports[1]["losses"]


@pytest.mark.parametrize("name", CASES)
def test_every_number_stays_finite(name):
    _, end = fitted(CASES[name], 40)
    if name.startswith("learning rates 1"):  # excessive predictions
        assert "more than if all distances had the wrong sign, at iteration 39 of 40" in end
    else:
        assert end == "done"


@pytest.mark.parametrize("rate", ["learning_rate", "intensity_learning_rate"])
def test_excessive_finite_predictions_are_a_divergence(rate):
    radar_map, end = fitted({"training": {rate: 1e3}}, 40)
    assert "more than" in end
    assert radar_map.sdf([[0.0, 0.0, 0.0]], extrapolate=True)[0] > -1
    assert abs(radar_map.intensity([[4.0, 0.0, 0.0]], [0.0, 0.0, 0.0], extrapolate=True)[0]) < 1000


def test_the_default_reconstructs_the_walls():
    assert min(free_and_solid(fitted(CASES["default"], 200)[0])) > 0.9


def test_joint_iterations_are_spread_over_the_sdf_stage(scene, monkeypatch):
    kinds, usual = [], CoreGradients.of
    monkeypatch.setattr(
        CoreGradients, "of", lambda self, kind, *of: kinds.append(kind) or usual(self, kind, *of)
    )
    monkeypatch.setattr("radarsdf.fitting.estimate._MOST_JOINT_ITERATIONS", 50)
    config = FitConfig(effort=0.2, training={"batch_size": 64, "intensity_batch_size": 64})
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    done = radar_map.report["iterations_done"]
    counted = {"sdf": kinds.index("intensity"), "intensity": len(kinds) - kinds.count("sdf")}
    assert done == radar_map.report["iterations"] == counted
    joint = [-1, *(i for i, kind in enumerate(kinds) if kind == "joint")]
    assert (len(joint) - 1, joint[-1] + 1) == (10, done["sdf"])
    assert np.ptp(np.diff(joint)) <= 1


def test_frozen_geometry_is_unchanged(scene):
    # Without dropout, which depends on the number of iterations and affects the joint stage.
    config = FitConfig(
        training={"sdf_iterations": 20, "intensity_iterations": 20, "batch_size": 1024},
        networks={"dropout": False},
    )
    fields = [
        radarsdf.fit(
            scene.points,
            scene.poses,
            scene.intensities,
            config=config.override(training={"intensity_iterations": n}),
        ).field
        for n in (20, 40)
    ]
    assert torch.equal(*(field.cells.features for field in fields))
    change = np.subtract(*(field.intensity_network.layers[0].weight.detach().numpy() for field in fields))
    # Regression: the second stage inherited the learning rate, decayed to zero by the first.
    assert np.abs(change).max() > config.training.intensity_learning_rate


def schedule(returns, vertices=10**9, *, with_intensity=True, **changes):
    config = FitConfig(**grouped(**changes))
    labelled = [returns] * with_intensity
    return Schedule.of(config, surface_returns=returns, vertices=vertices, labelled=labelled)


@pytest.mark.parametrize(
    ("returns", "changes", "expected"),
    [
        (100_000, {}, 180),  # half a pass is nearly enough
        (200_000, {}, 352),  # and here more than enough
        (50_000, {}, 176),  # a pass is not enough, but more would overfit
        (2_000, {}, 150),  # minimum for a surface
        (2_000, {"effort": 1e-9}, 1),
        (20_000, {"sdf_iterations": 7, "effort": 3.0}, 7),
    ],
)
def test_iterations_converge_the_surface_without_overfitting_noise(returns, changes, expected):
    assert schedule(returns, 10**6, **changes).sdf_iterations == expected


def test_averaged_fits_have_no_iterations():
    assert schedule(10**5, train=False).iterations == {"sdf": 0, "intensity": 0}


def test_iterations_are_limited_by_the_number_of_vertices():
    assert schedule(10**6).sdf_iterations == pytest.approx(0.6 * 12e6 / 4096, abs=1)
    assert schedule(10**6, vertices=50_000).sdf_iterations == pytest.approx(20 * 50_000 / 4096, abs=1)
    assert schedule(10**6, vertices=100_000).sdf_iterations == 300
    assert schedule(10**6, vertices=300_000).sdf_iterations == pytest.approx(10 * 300_000 / 4096, abs=1)
    assert schedule(10**6, vertices=100).sdf_iterations == 150


def test_each_radar_of_a_rig_has_the_intensity_iterations_of_a_fit_of_its_own():
    def of(*labelled):
        found = Schedule.of(FitConfig(), surface_returns=sum(labelled), vertices=10**9, labelled=[*labelled])
        return found.intensity_iterations

    assert of(10**5, 2 * 10**5, 0, 10**6) == of(10**5) + of(2 * 10**5) + of(10**6)


def test_batches_grow_to_limit_iterations():
    many = schedule(10**7)
    assert many.sdf_iterations == 5000
    assert many.sdf_iterations * many.batch_size == pytest.approx(0.6 * 12e7, rel=1e-3)
    assert many.batch_size > 3 * FitConfig().training.batch_size
    assert schedule(10**6).batch_size == FitConfig().training.batch_size


def test_batches_of_maps_beyond_the_caches_are_runs_of_neighbours():
    sizes = ((10**6, 500_000), (10**6, 500_001), (500_000, 10**6))
    assert [schedule(returns, vertices).neighbours for returns, vertices in sizes] == [1, 8, 1]


def test_joint_iterations_are_limited_and_spread_over_the_sdf_stage():
    assert schedule(10**5).joint_iterations == schedule(10**5).sdf_iterations == 180
    large = schedule(2 * 10**6)
    assert (large.sdf_iterations, large.joint_iterations, large.intensity_iterations) == (3516, 1450, 1750)
    explicit = schedule(2 * 10**6, intensity_iterations=9)
    assert explicit.joint_iterations == explicit.sdf_iterations


def test_a_small_scene_trains_its_intensities_for_long_and_with_more_dropout():
    small, large = schedule(10_000), schedule(10**6)
    assert small.intensity_iterations == 500
    assert 0 < large.dropout_scale < 0.5 < small.dropout_scale < 1
    assert schedule(10_000, with_intensity=False).iterations["intensity"] == 0


@pytest.mark.parametrize("returns", [2000, 10**5, 5 * 10**5])
def test_effort_multiplies_the_iterations(returns):
    half, whole, twice = (schedule(returns, effort=effort) for effort in (0.5, 1.0, 2.0))
    for one, other in ((half, whole), (whole, twice)):
        assert 2 * one.sdf_iterations == pytest.approx(other.sdf_iterations, abs=1)
        assert other.passes == pytest.approx(2 * one.passes, rel=0.01)
        assert other.intensity_iterations > 1.1 * one.intensity_iterations
    assert half.batch_size == whole.batch_size == twice.batch_size == FitConfig().training.batch_size


def test_a_batch_of_few_returns_has_the_samples_of_one_pass():
    few = schedule(5)
    assert (few.batch_size, few.intensity_batch_size) == (5 * 12, 5 * 6)
    assert few.neighbours == 1
    assert few.iterations == {"sdf": 150, "intensity": 500}
    usual = schedule(400)
    assert (usual.batch_size, usual.intensity_batch_size) == (4096, 1024)
    published = schedule(5, sdf_iterations=1000, intensity_iterations=4000)
    assert (published.batch_size, published.intensity_batch_size) == (4096, 1024)
