# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a plan says of memory and time follows from each tile's own rays."""

from __future__ import annotations

import numpy as np
import pytest
from radarsdf import FitConfig
from radarsdf.budget.estimate import estimate_rays
from radarsdf.io import Scan
from radarsdf.tiles.fit_tiles import plan_tiles
from radarsdf.tiles.plan import Plan, report_of
from radarsdf.tiles.planning import read_rays


def test_a_tile_of_two_returns_makes_no_other_one_larger(drive, tmp_path):
    away = np.eye(4)
    away[:3, 3] = 1e6, 0, 0
    few = Scan(drive.points[0][:2], away @ drive.poses[0], drive.intensities[0][:2])
    config = FitConfig(num_threads=1)
    here = plan_tiles(drive, tmp_path / "here", tile_size=512, config=config)
    both = plan_tiles([*drive, few], tmp_path / "both", tile_size=512, config=config)
    (small,) = (tile for tile in both.tiles if tile.tile[0] > 100)
    assert small.returns == 2
    assert small.memory_bytes < 40e6
    assert small.seconds < 1
    for tile in here.tiles:
        same = both.by_tile[tile.tile]
        assert (same.memory_bytes, same.seconds) == (tile.memory_bytes, tile.seconds)
        assert tile.memory_bytes < 300e6


def test_the_cells_are_those_that_the_fit_of_the_tile_has(folder):
    plan = Plan.load(folder)
    for tile in plan.tiles:
        rays, inside = read_rays(folder, plan, tile)
        assert inside.sum() < len(rays)  # others only pass
        report, expected = report_of(folder, tile), estimate_rays(rays, plan.config, inside)
        assert expected.returns == inside.sum()
        assert expected.leaf_cells == pytest.approx(report["leaf_cells"], rel=0.15)
        assert expected.vertices == pytest.approx(report["vertices"], rel=0.15)
        assert (tile.memory_bytes, tile.seconds) == (
            expected.peak_memory_bytes,
            pytest.approx(expected.seconds, abs=1e-3),
        )
