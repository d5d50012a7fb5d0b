# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Where one tile has observed a point and its neighbour has not, answers have no step."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from radarsdf.map import queries
from radarsdf.tiles.blend import knowledge

from .conftest import TILE_M

OFFSET_M = 0.3  # between what the two tiles say
STEP_M = 2e-3
SENSOR = [0.0, 0.0, 1.0]


@pytest.fixture
def disputed(city, points_on_border, monkeypatch):
    """A city of which one tile knows nothing in every second cell in height, and says other distances than the rest."""
    tile = next(tile for tile in city.plan.grid.counting(points_on_border) if city.has(tile))
    contents = city.contents_of(tile)
    field, leaf_m = contents.field, city.config.leaf_size_m
    occupied, sdf = field.occupied, field.sdf
    monkeypatch.setattr(
        field, "occupied", lambda p: occupied(p) & (torch.floor(p[:, 2] / (4 * leaf_m)) % 2 == 0)
    )
    monkeypatch.setattr(field, "sdf", lambda p: sdf(p) + OFFSET_M)
    return city


@pytest.fixture
def points_on_border(drive):
    """Returns of the wall near a border between two tiles, (N, 3)."""
    points = np.concatenate([scan.world_points for scan in drive])
    return points[np.abs(points[:, 1] - np.round(points[:, 1] / TILE_M) * TILE_M) < 1.0][:200]


@pytest.fixture
def quarrelling(city, points_on_border, monkeypatch):
    """A city of which each tile knows nothing in some cells more than a cell from borders, and says other distances."""
    leaf_m = city.config.leaf_size_m
    counting = [tile for tile in city.plan.grid.counting(points_on_border) if city.has(tile)]
    for number, tile in enumerate(counting):
        contents = city.contents_of(tile)
        field, occupied = contents.field, contents.field.occupied
        shift_m = number * OFFSET_M
        distance = field.sdf

        def knows(p, occupied=occupied, number=number, contents=contents):
            cells = torch.floor(p * np.float32(1 / leaf_m)).double()
            y = (cells[:, 1] + 0.5) * leaf_m + contents.origin[1]
            near_border = (y - torch.round(y / TILE_M) * TILE_M).abs() < 1.1 * leaf_m
            lacks = (cells @ torch.tensor([3.0, 5.0, 7.0], dtype=torch.float64)) % 5 == number
            return occupied(p) & ~(lacks & ~near_border)

        monkeypatch.setattr(contents.field, "occupied", knows)
        monkeypatch.setattr(field, "sdf", lambda p, d=distance, shift_m=shift_m: d(p) + shift_m)
    return city


def test_the_tile_of_a_cell_says_whether_it_was_observed(quarrelling, points_on_border):
    x = np.repeat(points_on_border, 20, axis=0).astype(np.float64)
    x += np.random.default_rng(0).normal(0, 0.3, x.shape)
    owners = quarrelling.plan.grid.tiles_of(x)
    expected = np.zeros(len(x), bool)
    disputed = 0
    for share in quarrelling.shares(x):
        observed = queries.occupied(share.contents, share.local).numpy()
        own = (owners[share.rows] == share.tile).all(axis=1)
        expected[share.rows[own]] = observed[own]
    for share in quarrelling.shares(x):
        disputed += (queries.occupied(share.contents, share.local).numpy() != expected[share.rows]).sum()
    assert disputed > 100
    # But for points on the border of an observed cell.
    assert (quarrelling.observed(x) != expected).mean() < 0.005


@pytest.mark.parametrize("kind", ["disputed", "quarrelling"])
def test_answers_have_no_step_where_one_tile_stops_knowing(kind, points_on_border, request):
    disputed = request.getfixturevalue(kind)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=points_on_border.shape)
    ways *= STEP_M / np.linalg.norm(ways, axis=1, keepdims=True)
    lines = points_on_border[:, None] + np.arange(-100, 100)[None, :, None] * ways[:, None]
    seen = disputed.observed(lines.reshape(-1, 3)).reshape(lines.shape[:2])
    distance_m = disputed.sdf(lines.reshape(-1, 3)).reshape(lines.shape[:2])
    both = seen[:, 1:] & seen[:, :-1]
    assert both.sum() > 10_000
    # Over an edge of a cell, 0.2 m, one tile hands over to the other, and both change themselves.
    assert np.abs(np.diff(distance_m))[both].max() < 2 * STEP_M + STEP_M * OFFSET_M / 0.2


def test_the_gradient_is_that_of_the_distance_there(disputed, points_on_border):
    x = points_on_border + [0.05, 0.03, 0.02]
    x = x[disputed.observed(x)]
    step = 1e-3
    ends = [[disputed.sdf(x + sign * step * axis) for sign in (1, -1)] for axis in np.eye(3)]
    expected = np.stack([(after - before) / (2 * step) for after, before in ends], axis=1)
    error = np.linalg.norm(disputed.gradient(x) - expected, axis=1)
    assert np.nanmedian(error) < 0.01
    assert np.nanquantile(error, 0.8) < 0.1


def everywhere(cells):
    """Other tiles have observed all cells."""
    return np.ones(len(cells), bool)


def test_knowledge_is_the_distance_to_what_is_not_observed(city):
    tile = city.tiles[0].tile
    contents = city.contents_of(tile)
    leaf_m = city.config.leaf_size_m
    cells = contents.field.table.leaf_cells()[::50].astype(np.float32)
    points = torch.from_numpy(
        (cells + np.random.default_rng(0).uniform(0.05, 0.95, cells.shape)).astype(np.float32) * leaf_m
    )
    known, slopes = knowledge(contents, points, everywhere)
    assert (known > 0).all()
    # Nothing nearer than that is unobserved, and something just beyond it is.
    ways = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3, indexing="ij"), -1).reshape(-1, 3)
    shares = []
    for scale in (0.98, 1.05):
        moved = points.numpy()[:, None] + scale * leaf_m * known[:, None, None] * ways
        shares.append(
            queries.occupied(contents, torch.from_numpy(moved.reshape(-1, 3).astype(np.float32)))
            .numpy().reshape(len(points), -1)
        )  # fmt: skip
    assert shares[0].all()
    assert not shares[1].all(axis=1)[known < 0.9].any()
    step = 1e-3 * leaf_m
    for axis in range(3):
        way = torch.zeros(3)
        way[axis] = step
        difference = (
            knowledge(contents, points + way, everywhere)[0]
            - knowledge(contents, points - way, everywhere)[0]
        ) / (2 * step)
        assert np.quantile(np.abs(difference - slopes[:, axis]), 0.95) < 1e-2
    assert knowledge(contents, torch.tensor([[0.0, 0.0, 1e4]]), everywhere)[0] == 0
