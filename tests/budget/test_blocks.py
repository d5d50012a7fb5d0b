# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Blocks that rays pass are counted about right, and never bounded too low."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.budget import blocks
from radarsdf.fitting.estimate import estimate_rays
from radarsdf.returns.free_space import Passages
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import prepare

CONFIG = FitConfig.quick(returns={"passages": True})


@pytest.fixture(scope="module")
def rays():
    scans = radarsdf.simulate.hugin(frames=12, seed=4)
    return prepare(scans.points, scans.poses, scans.intensities)


def test_blocks_are_those_of_the_passages(rays, monkeypatch):
    sure = SensorNoise(0.0, 1e-6, 1e-6)  # whose rays tell all that they pass
    true = len(Passages.of(rays, sure, CONFIG.leaf_size_m).keys)
    assert 0.8 < blocks.count_blocks(rays, rays, CONFIG) / true < 1.3
    assert blocks.most_blocks(rays, CONFIG) >= true
    monkeypatch.setattr(blocks, "_MOST_POINTS", 50_000)
    assert 0.5 < blocks.count_blocks(rays, rays, CONFIG) / true < 1.3


def test_long_ways_take_memory_where_passages_are_kept(rays):
    """The same returns, seen from a kilometre away, in another direction each."""
    turns = np.random.default_rng(0).uniform(0, 2 * np.pi, len(rays))
    directions = np.stack([np.cos(turns), np.sin(turns), np.zeros(len(turns))], axis=1).astype(np.float32)
    spread = dataclasses.replace(
        rays,
        points=(1000 * directions).astype(np.float32),
        directions=directions,
        ranges_m=np.full(len(rays), 1000, np.float32),
    )
    with_passages, without = (
        estimate_rays(spread, config).peak_memory_bytes for config in (CONFIG, FitConfig.quick())
    )
    count = blocks.count_blocks(spread, spread, CONFIG)
    assert count > 100_000
    assert with_passages - without == pytest.approx(300 * count, rel=0.01)
    assert blocks.count_blocks(spread, spread, FitConfig.quick()) == 0


def test_of_a_tile_only_its_own_blocks_count(rays):
    inside = np.abs(rays.points[:, 1]) < 5
    part = blocks.count_blocks(rays, rays.select(inside), CONFIG)
    assert 0 < part < 0.7 * blocks.count_blocks(rays, rays, CONFIG)
