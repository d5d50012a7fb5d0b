# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A fit by the compiled core is one by autograd: the same losses, distances and intensities, up to rounding.

Batch by batch, ``core/test_field_loss.py`` compares the gradients themselves.
"""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.fitting import training
from radarsdf.fitting.gradients import AutogradGradients
from radarsdf.fitting.gradients import CoreGradients

from ..conftest import ground_and_wall
from ..settings import grouped

SCENE = ground_and_wall(scans=3, returns_per_scan=400)
POINTS = np.concatenate([p @ T[:3, :3].T + T[:3, 3] for p, T in zip(SCENE.points, SCENE.poses, strict=True)])
SENSORS = np.repeat(SCENE.poses[:, :3, 3], [len(p) for p in SCENE.points], axis=0)
# Found: 1e-7, 1e-8 m and 1e-6 dB after so few iterations; after more, units that rounding turns on or off part the fits.
# With Adam: SOAP makes whole steps along axes that the first gradients do not determine, and so of their roundings.
# Each wrong gradient below makes at least five times as much as is let through.
LOSS, DISTANCE_M, INTENSITY_DB = 2e-4, 2e-4, 0.01

NO_DROPOUT = {"feature_dropout": 0.0, "fourier_dropout": 0.0}


@pytest.fixture(autouse=True)
def two_parts(monkeypatch):
    """With other parts, the samples of a batch come in another order, and others are hidden by the dropout."""
    for kind in (CoreGradients, AutogradGradients):
        monkeypatch.setattr(kind, "num_parts", lambda _backend, _batch_size: 2)


def fitted(gradients, *, with_intensity=True, **changes):
    settings = {
        "sdf_iterations": 12,
        "intensity_iterations": 24,
        "batch_size": 512,
        "intensity_batch_size": 256,
        "sigma_cells": 0.75,
        "optimiser": "adam",
    }
    config = FitConfig(num_threads=2, **grouped(gradients=gradients, **(settings | changes)))
    intensities = SCENE.intensities if with_intensity else None
    return radarsdf.fit(SCENE.points, SCENE.poses, intensities, config=config, progress=False)


def assert_same_fit(one, other):
    losses = other.report["losses"]
    assert one.report["losses"] == pytest.approx(losses, rel=LOSS)
    assert np.median(np.abs(one.sdf(POINTS) - other.sdf(POINTS))) < DISTANCE_M
    if other.has_intensity:
        differences = one.intensity(POINTS, SENSORS) - other.intensity(POINTS, SENSORS)
        assert np.median(np.abs(differences)) < INTENSITY_DB


@pytest.mark.parametrize("dropout", [False, True])
@pytest.mark.parametrize("fit", ["geometry", "joint", "one after the other"])
@pytest.mark.parametrize("kind", ["tri-quadtree", "octree"])
def test_both_back_ends_give_the_same_fit(kind, fit, dropout):
    changes = {"kind": kind, "joint": fit == "joint", "with_intensity": fit != "geometry"}
    changes |= {} if dropout else NO_DROPOUT
    core, autograd = (fitted(gradients, **changes) for gradients in ("core", "autograd"))
    assert_same_fit(core, autograd)
    # It has learnt something: else equal fits would say little.
    start = fitted("autograd", **changes, learning_rate=1e-9, intensity_learning_rate=1e-9)
    with pytest.raises(AssertionError):
        assert_same_fit(core, start)


@pytest.mark.parametrize(
    "changes",
    [
        {"row_updates": False},
        {"geometry_feature_dim": 3, "intensity_in_free_space": True},
        {"sdf_input": False, "view_direction": False, "log_range": False},
        {"sdf_loss_weight": 0.3, "feature_dropout": 0.0},
    ],
    ids=str,
)
def test_settings_that_the_back_ends_must_heed(changes):
    assert_same_fit(fitted("core", **changes), fitted("autograd", **changes))


def forget(parameter):
    return lambda found: found.by_parameters[parameter].zero_()


def turn_a_level(found):
    found.touched[0].gradient[:, :8].neg_()


def mix_rows(found):
    found.by_parameters[0].copy_(found.by_parameters[0].roll(1, 0))


WRONG = {
    "a bias of the SDF network is forgotten": forget(1),
    "the last bias of the SDF network is forgotten": forget(5),
    "the last bias of the intensity network is forgotten": forget(-1),
    "units of the SDF network get each other's": mix_rows,
    "features of a level go the wrong way": turn_a_level,
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_gradient_would_be_seen(monkeypatch, wrong):
    joint = CoreGradients.joint

    def wrong_joint(backend, batch, meanwhile):
        found, result = joint(backend, batch, meanwhile)
        WRONG[wrong](found)
        return found, result

    autograd = fitted("autograd")
    monkeypatch.setattr(CoreGradients, "joint", wrong_joint)
    with pytest.raises(AssertionError):
        assert_same_fit(fitted("core"), autograd)


def test_another_dropout_would_be_seen():
    with pytest.raises(AssertionError):
        assert_same_fit(fitted("core"), fitted("autograd", **NO_DROPOUT))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"gradients": "core"}, CoreGradients),
        ({"gradients": "autograd"}, AutogradGradients),
        ({"gradients": "core", "normals": True}, AutogradGradients),  # which the core does not know
        ({"gradients": "core", "normals": True, "with_intensity": False}, CoreGradients),  # nobody sees them
    ],
)
def test_the_back_end_is_the_one_that_was_asked_for(monkeypatch, changes, expected):
    made = []
    backend = training._backend
    monkeypatch.setattr(training, "_backend", lambda *given: made.append(backend(*given)) or made[-1])
    fitted(**changes)
    assert [type(backend) for backend in made] == [expected]
