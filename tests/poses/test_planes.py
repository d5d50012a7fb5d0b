# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Common planes, and scans that move in groups."""

import numpy as np
import pytest
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.planes import PlaneGrid, SensorReturns, common_planes, unbiased_normals
from radarsdf.returns.planes import Surfels


def surfels_of(points):
    """Of returns (N, 3) around the sensor."""
    returns = SensorReturns.of([points], 0.0, None)
    return Surfels.of(returns.posed(np.eye(4)[None]), 0.2)


def test_normals_of_a_wall_do_not_point_along_it():
    rng = np.random.default_rng(0)
    wall = np.column_stack(
        [rng.normal(5, 0.05, 20_000), rng.uniform(-6, 6, 20_000), rng.uniform(-1, 2, 20_000)]
    )
    surfels = surfels_of(wall)
    flat = surfels.is_flat()
    along, observed = surfels.normals[flat, 1], unbiased_normals(surfels, 1)[flat, 1]
    assert along.std() > 0.003
    assert observed.std() < 0.2 * along.std()


def test_scans_that_move_together_cost_nothing():
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0, 0.5, 1.2]
    scans = [np.column_stack([rng.uniform(2, 9, (3000, 2)), rng.normal(-1, 0.05, 3000)]) for _ in poses]
    returns = SensorReturns.of(scans, 0.0, None)
    planes, _ = common_planes(returns, poses, PlaneGrid(3, False, 0.4), None, ReturnsConfig(), 1)
    weak = np.tile(np.eye(6), (3, 1, 1))
    pull = np.zeros((3, 6))
    for k, direction in enumerate(np.eye(3)):
        # A pull that would move all scans together by one metre if they were free.
        pull[:] = 0
        pull[:, :3] = -direction
        free = planes.solve(weak, np.zeros((2, 6, 6)), pull, 1e-9, 200, False, 1)[0]
        still = planes.solve(weak, np.zeros((2, 6, 6)), 0 * pull, 1e-9, 200, False, 1)[0]
        assert (free - still)[:, :3] == pytest.approx(np.tile(direction, (3, 1)), abs=1e-2), k


@pytest.mark.parametrize("height_m", [-2.05, -1.95])
def test_a_noisy_scan_is_as_high_as_others(height_m):
    # Noise reaches over the borders of cells, 0.4 m high.
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = 0.2 * np.arange(10)
    noises_m = np.tile([0.02, 0.15], 5)
    scans = [
        np.column_stack([rng.uniform(-3, 3, (3000, 2)), rng.normal(height_m, noise_m, 3000)])
        for noise_m in noises_m
    ]
    returns = SensorReturns.of(scans, 0.0, None)
    planes, _ = common_planes(returns, poses, PlaneGrid(10, False, 0.4), None, ReturnsConfig(), 1)
    weak = np.tile(np.eye(6), (10, 1, 1))
    moved = planes.solve(weak, np.zeros((9, 6, 6)), np.zeros((10, 6)), 1e-6, 100, False, 1)[0][:, 2]
    assert (
        abs(moved[::2].mean() - moved[1::2].mean()) < 0.01
    )  # 0.02, if returns belonged to the cell that they lie in
