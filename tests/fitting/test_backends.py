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
from radarsdf.fitting import train
from radarsdf.fitting.gradients import AutogradGradients, CoreGradients

from ..conftest import ground_and_wall
from ..settings import grouped

SCENE = ground_and_wall(scans=3, returns_per_scan=400)
POINTS = np.concatenate([p @ T[:3, :3].T + T[:3, 3] for p, T in zip(SCENE.points, SCENE.poses, strict=True)])
SENSORS = np.repeat(SCENE.poses[:, :3, 3], [len(p) for p in SCENE.points], axis=0)
# Found: 1e-7, 1e-8 m and 1e-6 dB after so few iterations; after more, units that rounding turns on or off part the fits.
# With Adam: SOAP makes whole steps along axes that the first gradients do not determine, and so of their roundings.
# Each wrong gradient below makes at least five times as much as is let through.
LOSS, DISTANCE_M, INTENSITY_DB = 2e-4, 2e-4, 0.01


@pytest.fixture(autouse=True)
def two_parts(monkeypatch):
    """With other parts, the samples of a batch come in another order, and others are hidden by the dropout."""
    for kind in (CoreGradients, AutogradGradients):
        monkeypatch.setattr(kind, "num_parts", lambda _backend, _batch_size: 2)


def fitted(monkeypatch, backend, *, with_intensity=True, **changes):
    monkeypatch.setattr(train, "CoreGradients", backend)
    settings = {
        "sdf_iterations": 12,
        "intensity_iterations": 24,
        "batch_size": 512,
        "intensity_batch_size": 256,
        "sigma_cells": 0.75,
        "optimiser": "adam",
    }
    config = FitConfig(num_threads=2, **grouped(**(settings | changes)))
    intensities = SCENE.intensities if with_intensity else None
    return radarsdf.fit(SCENE.points, SCENE.poses, intensities, config=config, progress=False)


def assert_same_fit(one, other):
    losses = other.report["losses"]
    assert one.report["losses"] == pytest.approx(losses, rel=LOSS)
    assert np.median(np.abs(one.sdf(POINTS) - other.sdf(POINTS))) < DISTANCE_M
    if other.has_intensity:
        differences = one.intensity(POINTS, SENSORS) - other.intensity(POINTS, SENSORS)
        assert np.median(np.abs(differences)) < INTENSITY_DB


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"with_intensity": False},
        {"joint": False, "dropout": False},
        {"kind": "octree"},
        {"row_updates": False},
        {"geometry_feature_dim": 3, "intensity_in_free_space": True},
        {"sdf_input": False, "view_direction": False, "log_range": False},
        {"sdf_loss_weight": 0.3},
    ],
    ids=str,
)
def test_both_back_ends_give_the_same_fit(monkeypatch, changes):
    core, autograd = (
        fitted(monkeypatch, backend, **changes) for backend in (CoreGradients, AutogradGradients)
    )
    assert_same_fit(core, autograd)
    # It has learnt something: else equal fits would say little.
    start = fitted(monkeypatch, CoreGradients, **changes, learning_rate=1e-9, intensity_learning_rate=1e-9)
    with pytest.raises(AssertionError):
        assert_same_fit(core, start)


def forget(parameter):
    return lambda found: found.by_parameters[parameter].zero_()


WRONG = {
    "the last bias of the SDF network is forgotten": forget(5),
    "the last bias of the intensity network is forgotten": forget(-1),
    "features of a level go the wrong way": lambda found: found.touched[0].gradient[:, :8].neg_(),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_gradient_would_be_seen(monkeypatch, wrong):
    joint = CoreGradients.joint

    def wrong_joint(backend, batch, meanwhile):
        found, result = joint(backend, batch, meanwhile)
        WRONG[wrong](found)
        return found, result

    autograd = fitted(monkeypatch, AutogradGradients)
    monkeypatch.setattr(CoreGradients, "joint", wrong_joint)
    with pytest.raises(AssertionError):
        assert_same_fit(fitted(monkeypatch, CoreGradients), autograd)
