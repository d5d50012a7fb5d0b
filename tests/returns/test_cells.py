# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The cells that hold returns."""

import numpy as np
import pytest
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import ReturnCells, merged_keys


@pytest.mark.parametrize("size_m", [0.1, 0.2, 0.37])
@pytest.mark.parametrize("extent_m", [1.0, 30.0, 9e4])
def test_merged_cells_are_those_of_twice_the_size(size_m, extent_m):
    points = np.random.default_rng(0).uniform(-extent_m, extent_m, (2000, 3))
    rays = prepare([points], np.eye(4)[None])
    leaves, found = ReturnCells.of(rays, size_m), ReturnCells.of(rays, 2 * size_m)
    merged = merged_keys(leaves.keys)
    np.testing.assert_array_equal(np.unique(merged), found.keys)
    np.testing.assert_array_equal(merged[leaves.cell_of_ray], found.keys[found.cell_of_ray])
