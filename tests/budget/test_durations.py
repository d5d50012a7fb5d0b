# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a fit has to do is counted as it is done; how long that takes is for `python -m bench.estimates durations`."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.budget import durations
from radarsdf.budget.schedule import Schedule
from radarsdf.field.widths import intensity_widths, parameters_of, sdf_widths, weights_of
from radarsdf.fitting.core_gradients import CoreGradients
from torch import nn

from ..settings import grouped

BOTH = FitConfig(
    training={
        "sdf_iterations": 100,
        "intensity_iterations": 300,
        "batch_size": 1000,
        "intensity_batch_size": 500,
    }
)
COUNTS = {"returns": 1000, "cells": 3000, "rows": 2000}


def work(config=BOTH, *, with_intensity=True, **changes):
    counts = COUNTS | {k: v for k, v in changes.items() if k in COUNTS}
    config = config.override(**grouped(**{k: v for k, v in changes.items() if k not in COUNTS}))
    schedule = Schedule.of(
        config, surface_returns=counts["returns"], returns=counts["returns"], vertices=counts["rows"],
        with_intensity=with_intensity,
    )  # fmt: skip
    return durations.work_of(config, schedule, with_intensity=with_intensity, **counts)


def test_all_that_is_counted_has_its_seconds():
    assert work().keys() == durations.SECONDS.keys()
    assert all(seconds >= 0 for seconds in durations.SECONDS.values())
    assert all(np.isfinite(amount) and amount >= 0 for amount in work().values())


@pytest.mark.parametrize("config", [FitConfig(), FitConfig.paper(), FitConfig(encoding={"kind": "octree"})])
def test_multiplications_are_those_of_the_networks(scene, config):
    config = config.override(
        training={"sdf_iterations": 1, "intensity_iterations": 1, "batch_size": 64},
        networks={"normals": False},
    )
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    field = radar_map.field
    (encoding,) = {sum(part.shape[1] for part in field.encode(torch.zeros(1, 3)))}
    assert sdf_widths(config)[0] == encoding
    for network, widths in (
        (field.sdf_network, sdf_widths(config)),
        (field.intensity_network, intensity_widths(config)),
    ):
        layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
        assert weights_of(widths) == sum(layer.weight.numel() for layer in layers)
        assert parameters_of(widths) == sum(p.numel() for p in network.parameters())


def test_what_makes_more_work():
    base = work()
    assert work(sdf_iterations=200, intensity_iterations=600)["iteration"] == 2 * base["iteration"]
    assert base["iteration"] == 300  # the first 100 are of both networks
    assert work(joint=False)["iteration"] == 400
    assert work(with_intensity=False)["iteration"] == 100
    for changes in (
        {"batch_size": 2000},
        {"intensity_batch_size": 1000},
        {"sdf_hidden": (64, 64)},
        {"intensity_hidden": (128, 128)},
        {"normals": True},
        {"intensity_in_free_space": True},
    ):
        assert work(**changes)["multiplication"] > base["multiplication"], changes
    for changes in ({"num_levels": 6}, {"fourier_count": 16}, {"batch_size": 2000}):
        assert work(**changes)["encoded number"] > base["encoded number"], changes
    assert base["moved row"] == 0 < work(row_updates=False)["moved row"] == 100 * 2000
    assert work(normals=True)["moved row"] > 0  # as Training does
    assert work(returns=5000)["return"] == 5 * base["return"]
    assert work(cells=9000)["cell"] == 3 * base["cell"]
    assert work(FitConfig.quick(), with_intensity=False)["iteration"] == 0


def test_threads_share_what_can_be_shared_as_far_as_there_are_processors(monkeypatch):
    monkeypatch.setattr(durations, "processors", lambda: 4)
    base = work()
    for threads, share in ((1, 1), (2, 2), (4, 4), (64, 4)):
        shared = durations.shared(base, threads)
        assert shared["multiplication"] == base["multiplication"] / share
        assert shared["iteration"] == base["iteration"]


@pytest.mark.parametrize(
    ("returns", "with_intensity", "changes"),
    [
        (1, False, {}),
        (7, True, {}),
        (60, True, {"joint": False}),
        (60, True, {"batch_size": 700, "intensity_in_free_space": True}),
        (400, True, {"sdf_iterations": 3, "intensity_iterations": 5}),
    ],
)
def test_samples_are_those_that_the_training_sees(scene, monkeypatch, returns, with_intensity, changes):
    seen = {"sdf": 0, "joint": 0, "intensity": 0}
    for name in seen:
        counted(monkeypatch, name, seen)
    points, intensities = scene.points[0][:returns], scene.intensities[0][:returns]
    config = FitConfig(num_threads=1, returns={"drop_ghosts": False}, training=changes)
    given = ([points], scene.poses[:1], [intensities] if with_intensity else None)
    report = radarsdf.fit(*given, config=config, progress=False).report
    rows, cells = report["vertices"], report["leaf_cells"]
    schedule = Schedule.of(
        config, surface_returns=returns, returns=returns, vertices=rows, with_intensity=with_intensity
    )
    expected = durations.work_of(
        config, schedule, returns=returns, cells=cells, rows=rows, with_intensity=with_intensity
    )
    evaluations = 3 * (seen["sdf"] + seen["joint"]) + seen["intensity"]
    assert expected["encoded number"] == sdf_widths(config)[0] * evaluations
    assert evaluations <= 3 * 500 * 12 * returns or "sdf_iterations" in changes


def counted(monkeypatch, name, seen):
    """Adds the samples of each batch to `seen`."""
    gradients = getattr(CoreGradients, name)

    def counting(backend, batch, meanwhile):
        seen[name] += len(batch.points)
        return gradients(backend, batch, meanwhile)

    monkeypatch.setattr(CoreGradients, name, counting)


def test_the_estimate_is_the_sum(scene):
    config = BOTH.override(num_threads=1, returns={"drop_ghosts": False})
    estimate = radarsdf.estimate(scene.points, scene.poses, scene.intensities, config=config)
    counted = work(config, returns=estimate.returns, cells=estimate.leaf_cells, rows=estimate.vertices)
    assert estimate.seconds == pytest.approx(sum(durations.SECONDS[k] * v for k, v in counted.items()))
