# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rows kept region by region, and ghosts that are asked for only there, against tables and ghosts of all at once."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf._core import cell_keys
from radarsdf.live.ghosts import means_of, surfels_of
from radarsdf.live.regions import REGION_CELLS, RegionTable, region_places
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.sums import lattice_of

RNG = np.random.default_rng(3)
CELLS = RNG.integers(-150, 150, (4000, 3))


def keys_of(cells):
    return np.unique(cell_keys(np.ascontiguousarray(cells, np.float64) + 0.5, 1.0))


@pytest.mark.parametrize("leaves_per_cell", [1, 2])
def test_rows_are_those_of_the_regions_that_their_cells_are_in(leaves_per_cell):
    keys = keys_of(CELLS)
    table = RegionTable(leaves_per_cell, number=np.zeros(1))
    regions = np.unique(table.regions_of(keys))
    table.put(regions, {"keys": keys, "number": np.arange(len(keys)) * 1.0})
    np.testing.assert_array_equal(table.regions, regions)
    whole = table.gather(regions)
    np.testing.assert_array_equal(whole["keys"], keys)
    np.testing.assert_array_equal(whole["number"], np.arange(len(keys)))
    edge = REGION_CELLS // leaves_per_cell
    for region, cube in zip(regions, region_places(regions), strict=True):
        expected = (lattice_of(keys) // edge == cube).all(axis=1)
        np.testing.assert_array_equal(table.gather(region[None])["number"], np.flatnonzero(expected))
    some = regions[::3]
    table.put(some, {"keys": keys[:0], "number": np.zeros(0)})
    np.testing.assert_array_equal(table.regions, np.setdiff1d(regions, some))
    assert table.num_rows == (~np.isin(table.regions_of(keys), some)).sum()
    assert table.num_bytes == 16 * table.num_rows


def test_ghosts_are_those_of_all_rays_and_planes():
    scans = radarsdf.simulate.oculii(seed=6, frames=16)
    known = {"range_noise_m": 0.09, "azimuth_noise_rad": 0.012, "elevation_noise_rad": 0.02}
    live = LiveMap(FitConfig(num_threads=1, returns=known), origin=(0, 0, 0))
    found = []
    for i in range(16):
        live.integrate(scans.points[i], scans.poses[i], scan_id=i)
        if i >= 8:
            live.remove(2 * (i - 8))
        if i % 8 == 7:
            live.mesh()
            surface = live._state._surface
            leaves, cells = (table.gather(table.regions) for table in (surface._leaves, surface._cells))
            surfels = surfels_of(cells, 0.2)
            ghosts = find_ghosts(surfels, means_of(leaves), live._state.noise)
            np.testing.assert_array_equal(cells["ghosts"], ghosts)
            found.append(int(ghosts.sum()))
    assert min(found) > 50
