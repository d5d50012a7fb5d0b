# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The grid of tiles: weights that add up to one, and rays that cross."""

import numpy as np
import pytest
from radarsdf.tiles.plan import TileGrid, neighbours

GRID = TileGrid(tile_m=12.8, halo_m=6.4, corner_m=-2.0)


def test_weights_add_up_to_one_and_ignore_the_outer_half_of_the_halo():
    points = np.random.default_rng(0).uniform(0, 12.8, (500, 3))
    weights = np.stack([GRID.weights(tile, points) for tile in neighbours((0, 0))])
    np.testing.assert_allclose(weights.sum(axis=0), 1, atol=1e-12)
    assert (weights >= 0).all()
    beyond = points + [12.8 + 3.2, 0, 0]
    assert (GRID.weights((0, 0), beyond) == 0).all()
    middle = np.array([[6.4, 6.4, 0.0]])
    assert GRID.weights((0, 0), middle) == 1


@pytest.mark.parametrize("straight", [False, True])
def test_a_ray_goes_to_each_tile_that_it_crosses(straight):
    rng = np.random.default_rng(2)
    a, b = rng.uniform(-40, 40, (2, 200, 3))
    if straight:
        b[:, 0] = a[:, 0]  # parallel to the edges of tiles
    found = {
        (int(row), *tile)
        for rows, tiles in GRID.crossed(a, b)
        for row, tile in zip(rows, tiles.tolist(), strict=True)
    }
    assert found == {(row, i, j) for i in range(-5, 5) for j in range(-5, 5) for row in through((i, j), a, b)}


def through(tile, a, b):
    """Rows of the rays from a to b (N, 3) that go through a tile and its halo."""
    lower = GRID.lower_corner(tile) - GRID.halo_m
    sides = np.stack([lower, lower + GRID.tile_m + 2 * GRID.halo_m])[:, None]
    with np.errstate(
        divide="ignore"
    ):  # along an axis that a ray keeps its place on, it is there always or never
        shares = np.sort((sides - a[:, :2]) / (b - a)[:, :2], axis=0)
    first, last = shares[0].max(axis=1), shares[1].min(axis=1)
    return np.flatnonzero(np.maximum(first, 0) <= np.minimum(last, 1)).tolist()
