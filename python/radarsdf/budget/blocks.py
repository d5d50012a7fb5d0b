# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How many blocks of leaf cells rays pass, before they are followed cell by cell."""

from __future__ import annotations

import math

import numpy as np

from radarsdf._core import CellSet
from radarsdf.config.fit_config import FitConfig
from radarsdf.returns.free_space import BLOCK_CELLS
from radarsdf.returns.rays import Rays

_MOST_STEPS = 1000  # half blocks along a ray
_MOST_POINTS = 1_600_000  # in all. Where the ways are long, fewer rays are looked at.


def count_blocks(rays: Rays, learnt: Rays, config: FitConfig) -> int:
    """Number of blocks of leaf cells that rays pass in the box of the returns that are learnt, estimated from some of the rays."""
    if not config.returns.passages or len(learnt) == 0:
        return 0
    edge_m = BLOCK_CELLS * config.leaf_size_m
    steps = np.minimum(np.ceil(2 * rays.ranges_m / edge_m), _MOST_STEPS).astype(np.int64) + 1
    some = slice(None, None, max(1, math.ceil(int(steps.sum()) / _MOST_POINTS)))
    count = steps[some]
    number = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    before_m = (number / np.repeat(count, count)).astype(np.float32) * np.repeat(rays.ranges_m[some], count)
    points = np.repeat(rays.points[some], count, axis=0) - before_m[:, None] * np.repeat(
        rays.directions[some], count, axis=0
    )
    inside = ((points >= learnt.points.min(axis=0)) & (points <= learnt.points.max(axis=0))).all(axis=1)
    blocks = CellSet(edge_m)
    blocks.insert(np.ascontiguousarray(points[inside]), config.num_threads)
    return len(blocks.sorted_keys(config.num_threads))


def most_blocks(rays: Rays, config: FitConfig) -> int:
    """Not fewer blocks than rays can pass: those of the box round returns and sensors, or three for each block's edge of a way."""
    if not config.returns.passages or len(rays) == 0:
        return 0
    edge_m = BLOCK_CELLS * config.leaf_size_m
    sensors = rays.points - rays.directions * rays.ranges_m[:, None]
    ends = np.stack(
        [rays.points.min(axis=0), sensors.min(axis=0), rays.points.max(axis=0), sensors.max(axis=0)]
    )
    shape = np.ceil((ends[2:].max(axis=0) - ends[:2].min(axis=0)).astype(np.float64) / edge_m) + 1
    ways = float((3 * np.ceil(rays.ranges_m / edge_m) + 1).sum(dtype=np.float64))
    return int(min(float(shape.prod()), ways))
