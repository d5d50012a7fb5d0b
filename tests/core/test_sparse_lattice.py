# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The lattice of a set of cells, and the checks of what is extracted from it."""

import itertools

import numpy as np
import pytest
from radarsdf.map.marching_cubes import sparse_lattice


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 7, 50_000])
def test_sparse_lattice_against_numpy(threads, count):
    rng = np.random.default_rng(count)
    cells = rng.integers([-5, 1000, -(2**31)], [60, 1030, -(2**31) + 40], size=(count, 3), dtype=np.int64)
    unique, corners, cell_corners = sparse_lattice(cells, num_threads=threads)
    offsets = np.array(list(itertools.product((0, 1), repeat=3)))
    expected = np.unique(cells, axis=0)
    assert np.array_equal(unique, expected)
    all_corners = expected[:, None] + offsets
    assert np.array_equal(corners, np.unique(all_corners.reshape(-1, 3), axis=0))
    assert np.array_equal(corners[cell_corners], all_corners)
