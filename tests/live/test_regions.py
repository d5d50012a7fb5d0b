# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rows kept region by region, and ghosts that are asked for only there, against tables and ghosts of all at once."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf._core import cell_keys
from radarsdf.live.regions import REGION_CELLS, RegionTable, region_places
from radarsdf.returns.sums import lattice_of

from .test_live_map import mesh_bits

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
    whole = table.gather(regions)
    np.testing.assert_array_equal(whole["keys"], keys)
    np.testing.assert_array_equal(whole["number"], np.arange(len(keys)))
    edge = REGION_CELLS // leaves_per_cell
    for region, cube in zip(regions, region_places(regions), strict=True):
        expected = (lattice_of(keys) // edge == cube).all(axis=1)
        np.testing.assert_array_equal(table.gather(region[None])["number"], np.flatnonzero(expected))
    some = regions[::3]
    table.put(some, {"keys": keys[:0], "number": np.zeros(0)})
    left = table.gather()["keys"]
    np.testing.assert_array_equal(left, keys[~np.isin(table.regions_of(keys), some)])
    assert table.num_bytes == 16 * len(left)


def test_ghosts_of_a_grown_map_are_those_of_a_fresh_one():
    scans = radarsdf.simulate.oculii(seed=6, frames=16)
    known = {"range_noise_m": 0.09, "azimuth_noise_rad": 0.012, "elevation_noise_rad": 0.02}
    live, fresh = (LiveMap(FitConfig(num_threads=1, returns=known), origin=(0, 0, 0)) for _ in range(2))
    for i in range(16):
        live.integrate(scans.points[i], scans.poses[i], scan_id=i)
        if i >= 8:
            live.remove(2 * (i - 8))
        if i % 8 == 7:
            live.mesh()
    for i in live.scan_ids:
        fresh.integrate(scans.points[i], scans.poses[i], scan_id=i)
    assert mesh_bits(live.mesh()) == mesh_bits(fresh.mesh())
    assert len(live._state._surface._ghosts) > 50
