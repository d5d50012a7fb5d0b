# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans that move in groups: as few unknowns as groups, and as much work in long windows as in short ones."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.estimate import plan_of
from radarsdf.poses.groups import Groups
from radarsdf.poses.motion import Motion
from radarsdf.poses.planes import PlaneGrid, SensorReturns, common_planes
from radarsdf.poses.rigid import aligned, moved
from radarsdf.simulate import Leg, drifted

from .drift import position_error_m, trajectory


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


def test_groups_turn_as_a_whole():
    poses, groups = trajectory(21), Groups(21, 4)
    turn = 1e-4 * np.array([1.0, -2.0, 3.0])
    middles = poses[groups.middles, :3, 3]
    few = np.column_stack([np.cross(turn, middles), np.tile(turn, (len(middles), 1))])
    found = moved(poses, groups.increments(few, poses))
    whole = np.eye(3) + np.cross(np.eye(3), turn)
    np.testing.assert_allclose(found[:, :3, 3], np.einsum("ij,fj->fi", whole, poses[:, :3, 3]), atol=1e-6)


def test_long_drives_take_as_many_rounds_of_all_returns_as_short_ones():
    def returns_of_windows(num_scans):
        return sum(1 / grid.together for grid in plan_of(num_scans, 0.2, 8) if grid.window < num_scans)

    assert returns_of_windows(128) == 8  # as before there were groups
    assert returns_of_windows(10**6) < 8 + 2
    for grid in plan_of(5000, 0.2, 8):
        assert grid.window == 5000 or grid.window <= 64 * grid.together


def test_groups_with_a_share_of_the_returns_close_a_loop():
    court = radarsdf.simulate.oculii(seed=5, frames=60)
    laps = radarsdf.simulate.drive_legs(court, [Leg(ahead_m=75)], speed_mps=8, rate_hz=5).simulation
    true = laps.poses
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
