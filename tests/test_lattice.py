# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The lattice of the world, on which the cells of all maps lie."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.lattice import WorldLattice

LATTICE = WorldLattice(0.2, 32)


def test_positions_and_cells_are_inverse():
    cells = np.random.default_rng(0).integers(-(10**7), 10**7, (100, 3))
    np.testing.assert_allclose(LATTICE.cells(LATTICE.position(cells)), cells, rtol=0, atol=1e-6)
    np.testing.assert_allclose(LATTICE.position(cells + 5) - LATTICE.position(cells), 1.0, atol=1e-8)


def test_the_nearest_block_is_within_half_a_block():
    places = np.random.default_rng(1).uniform(-1e6, 1e6, (1000, 3))
    blocks = LATTICE.nearest_block(places)
    assert (blocks % 32 == 0).all()
    assert np.abs(LATTICE.position(blocks) - places).max() <= 3.2 + 1e-9


@pytest.mark.parametrize("level", range(6))
@pytest.mark.parametrize("coordinate_m", [0.0, 0.2, 1.0, -2.0, 5.0, 6.4, 12.8, 100.0])
def test_no_plane_at_a_round_coordinate_is_a_face_of_cells(level, coordinate_m):
    place = LATTICE.cells(coordinate_m) / 2**level
    assert abs(place - np.round(place)) * 2**level > 0.3  # leaf cells


def test_maps_of_overlapping_scans_share_their_cells():
    scans = radarsdf.simulate.wall(frames=8)
    config = FitConfig.quick()
    corners = [
        config.lattice.cells(radarsdf.fit(scans.points[part], scans.poses[part], config=config).origin)
        for part in (slice(0, 4), slice(4, 8))
    ]
    for corner in corners:
        np.testing.assert_allclose(corner, 32 * np.round(corner / 32), rtol=0, atol=1e-9)
    assert not np.allclose(corners[0], corners[1])
