# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""An estimate refuses what a fit refuses, and counts the cells of long ways round each return."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, _core
from radarsdf.budget import estimate as budget
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import lattice_of

from bench.growth.street import street

FAR = (
    {"leaf_size_m": 1e-9},
    {"leaf_size_m": 1e-9, "encoding": {"kind": "octree"}},
    {"sampling": {"near_band_cells": 1e7}},
)


@pytest.mark.parametrize("changes", FAR, ids=str)
def test_what_a_fit_refuses_is_not_estimated(scene, changes):
    messages = []
    for function in (radarsdf.fit, radarsdf.estimate):
        with pytest.raises(ValueError, match="are not within a million cells") as refusal:
            function(scene.points, scene.poses, scene.intensities, config=FitConfig(**changes))
        messages.append(str(refusal.value))
    assert messages[0] == messages[1]


@pytest.mark.parametrize("kind", ["tri-quadtree", "octree"])
def test_a_long_way_round_each_return_is_counted_whole(kind):
    scans = street(1500)
    config = FitConfig(
        leaf_size_m=0.02,
        returns={"drop_ghosts": False},
        encoding={"kind": kind, "bridge_cells": 0},
        sampling={"near_band_cells": 100.0},
        training={"sdf_iterations": 1, "batch_size": 16},
    )
    estimate = radarsdf.estimate(scans.points, scans.poses, config=config)
    report = radarsdf.fit(scans.points, scans.poses, config=config, progress=False).report
    assert estimate.leaf_cells == pytest.approx(report["leaf_cells"], rel=0.02)
    assert estimate.vertices == pytest.approx(report["vertices"], rel=0.02)


@pytest.mark.parametrize(("near_band_cells", "most"), [(1.5, 60_000), (20.0, 1_000_000)])
def test_a_sample_of_long_ways_tells_about_as_much(monkeypatch, near_band_cells, most):
    scans = street(20_000)
    rays = prepare(scans.points, scans.poses)
    config = FitConfig(sampling={"near_band_cells": near_band_cells})
    monkeypatch.setattr(budget, "_MOST_POINTS", 10**9)
    whole = budget._count_cells(rays, config)
    monkeypatch.setattr(budget, "_MOST_POINTS", most)
    sampled = budget._count_cells(rays, config)
    assert whole != sampled
    assert sampled == pytest.approx(whole, rel=0.4)


def test_coordinates_are_those_of_the_keys():
    rng = np.random.default_rng(0)
    lattice = rng.integers(-(10**6), 10**6, (1000, 3))
    keys = _core.cell_keys(lattice + 0.5, 1.0)
    assert np.array_equal(lattice_of(keys), lattice)
