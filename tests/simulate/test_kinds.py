# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scenes of each kind are what their name says, and their radars and drives differ."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from radarsdf import simulate as sim
from scipy.spatial import cKDTree


@pytest.fixture(scope="module")
def scenes():
    return {name: make(seed=3, frames=2) for name, make in sim.KINDS.items()}


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


def test_radars_are_sparse_and_dense_clean_and_false(scenes):
    per_scan = {name: np.mean([len(p) for p in s.points]) for name, s in scenes.items()}
    false = {name: 1 - s.is_surface().mean() for name, s in scenes.items()}
    assert min(per_scan.values()) < 800
    assert max(per_scan.values()) > 10_000
    assert min(false.values()) < 0.05
    assert max(false.values()) > 0.15


def test_what_is_enclosed_has_a_roof(scenes):
    roofed = {name for name, simulation in scenes.items() if np.isfinite(ranges_up(simulation)).all()}
    assert {"hall", "tunnel"} <= roofed
    assert not roofed & {"yard", "slope", "facade", "car_park", "fences"}


def test_a_facade_is_seen_from_three_places_and_looked_at():
    simulation = sim.KINDS["facade"](seed=3, frames=6)
    position = simulation.poses[:, :3, 3]
    steps_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    assert sorted(np.flatnonzero(steps_m > 5)) == [1, 3]
    assert (steps_m[[0, 2, 4]] < 1).all()
    ahead = simulation.scene.raycast(position, simulation.poses[:, :3, 0], 60.0)
    assert (ahead.range_m < 40).all()


def test_a_slope_is_steep(scenes):
    hillside, flat = (scenes[name].scene.terrain for name in ("slope", "yard"))
    line = np.column_stack([np.linspace(0, 40, 50), np.zeros(50)])
    assert np.abs(hillside.slope(line)[:, 1]).mean() > 0.2 > np.abs(flat.slope(line)[:, 1]).mean()


def test_a_fence_is_thin_and_has_posts_and_rails():
    terrain = sim.Terrain.random(np.random.default_rng(0), 0.2, sim.materials.GRASS)
    site = sim.site.Site(np.random.default_rng(1), terrain, [])
    assert site.fence(np.array([3.0, 2.0]), 0.7)
    assert not site.fence(np.array([3.0, 2.0]), 0.7)  # no place is taken twice
    posts = [s for s in site.solids if isinstance(s, sim.Pole)]
    rails = [s for s in site.solids if isinstance(s, sim.Box)]
    assert len(posts) >= 4
    assert len(rails) == 2
    assert cKDTree([p.base[:2] for p in posts]).query([p.base[:2] for p in posts], k=2)[0][
        :, 1
    ] == pytest.approx(2)
    # From post to post, both rails are met between them.
    middle = (posts[0].base[:2] + posts[1].base[:2]) / 2
    for rail in rails:
        assert rail.signed_distance(np.array([[*middle, rail.center[2]]]))[0] < 0


def test_a_seed_gives_the_same_bits_and_another_seed_another_scene(scenes):
    again, other = (sim.KINDS["hall"](seed=seed, frames=2) for seed in (3, 4))
    assert_array_equal(again.world_points(), scenes["hall"].world_points())
    assert_array_equal(again.ground_truth, scenes["hall"].ground_truth)
    assert len(other.world_points()) != len(again.world_points())
