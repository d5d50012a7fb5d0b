# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scenes of each kind are what their name says, and their radars and drives differ."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from bench.kinds import KINDS


@pytest.fixture(scope="module")
def scenes():
    return {name: make(seed=3, frames=2) for name, make in KINDS.items()}


def ranges_up(simulation):
    """Distance straight up from each sensor to the first surface, m."""
    at = simulation.poses[:, :3, 3]
    return simulation.scene.raycast(at, np.tile([0.0, 0.0, 1.0], (len(at), 1)), 100.0).range_m


def test_returns_labelled_surface_are_near_one_and_others_are_not(scenes):
    for name, simulation in scenes.items():
        surface = simulation.is_surface()
        distance_m = np.abs(simulation.scene.signed_distance(simulation.world_points()))
        assert np.median(distance_m[surface]) < 0.15, name
        assert surface.mean() > 0.5, name
        if (~surface).sum() > 20:
            assert np.median(distance_m[~surface]) > 2 * np.median(distance_m[surface]), name


def test_what_is_enclosed_has_a_roof(scenes):
    roofed = {name for name, simulation in scenes.items() if np.isfinite(ranges_up(simulation)).all()}
    assert {"hall", "tunnel"} <= roofed
    assert not roofed & {"yard", "slope", "facade", "car_park", "fences"}


def test_a_seed_gives_the_same_bits_and_another_seed_another_scene(scenes):
    again, other = (KINDS["hall"](seed=seed, frames=2) for seed in (3, 4))
    assert_array_equal(again.world_points(), scenes["hall"].world_points())
    assert_array_equal(again.ground_truth, scenes["hall"].ground_truth)
    assert len(other.world_points()) != len(again.world_points())
