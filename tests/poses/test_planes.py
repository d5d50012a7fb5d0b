# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Common planes, and scans that move in groups."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.motion import Motion
from radarsdf.poses.planes import Groups, PlaneGrid, SensorReturns, common_planes, unbiased_normals
from radarsdf.poses.rigid import aligned, moved
from radarsdf.returns.planes import Surfels
from radarsdf.simulate import drifted, simulate

from .drift import position_error_m, trajectory


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
    along, told = surfels.normals[flat, 1], unbiased_normals(surfels, 1)[flat, 1]
    assert along.std() > 0.003
    assert told.std() < 0.2 * along.std()


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


@pytest.mark.parametrize(("count", "size"), [(13, 4), (12, 4), (9, 8), (16, 2), (7, 1)])
def test_groups_cost_what_the_increments_of_their_scans_cost(count, size):
    rng = np.random.default_rng(count)
    poses = trajectory(count)
    motion = Motion.of(drifted(poses, 0.1, 0.01, 1), 0.1, 0.01)
    diagonal, below, gradient = motion.prior(poses)
    groups = Groups(count, size)
    of_groups = groups.prior((diagonal, below, gradient), poses)
    for _ in range(3):
        few = rng.normal(size=(len(groups.middles), 6))
        many = groups.increments(few, poses)
        assert many.shape == (count, 6)
        assert cost(*of_groups, few) == pytest.approx(cost(diagonal, below, gradient, many), rel=1e-9)


def cost(diagonal, below, gradient, x):
    """Of increments x (F, 6): the quadratic function that a solver makes least."""
    own = np.einsum("fi,fij,fj->", x, diagonal, x) / 2
    return own + np.einsum("fi,fij,fj->", x[1:], below, x[:-1]) + np.einsum("fi,fi->", x, gradient)


def test_groups_with_a_share_of_the_returns_close_a_loop():
    court = radarsdf.simulate.oculii(seed=5, frames=60)
    true = np.concatenate([court.poses, court.poses[:20]])
    laps = simulate(court.scene, court.sensor, true, name="laps")
    given = drifted(true, 0.0, 0.0, 1, 0.002)
    returns = SensorReturns.of(laps.points, 0.5, None)
    errors_m = []
    for together in (1, 4):
        grid, groups = PlaneGrid(len(true), False, 2.0, together), Groups(len(true), together)
        planes, _ = common_planes(returns, given, grid, None, ReturnsConfig(), 1)
        prior = groups.prior(Motion.of(given, 0.1, 0.01).prior(given), given)
        found = planes.solve(*prior, 1e-4, 100, False, 1)[0]
        assert found.shape == (-(-len(true) // together), 6)
        poses = moved(given, groups.increments(found, given))
        errors_m.append(position_error_m(aligned(poses, true), true))
    assert errors_m[0] < 0.6 * position_error_m(aligned(given, true), true)
    assert errors_m[1] < 1.1 * errors_m[0]
