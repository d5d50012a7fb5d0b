# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The lattice of a set of cells, and the checks of what is extracted from it."""

import itertools

import numpy as np
import pytest
from radarsdf.map.marching_cubes import extract_cells, sparse_lattice


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 7, 200_000])
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


def test_sparse_lattice_at_the_limits():
    empty = sparse_lattice(np.zeros((0, 3), dtype=np.int32))
    assert [a.shape for a in empty] == [(0, 3), (0, 3), (0, 8)]
    assert len(sparse_lattice([[-(2**31), 0, 0], [2**31 - 2, 0, 0]])[1]) == 16
    with pytest.raises(ValueError, match="beyond int32"):
        sparse_lattice([[2**31 - 1, 0, 0]])
    last = 2**21 - 2  # the lower corner of a cell: corners to 2^21 - 1 along three axes take 63 bits
    assert sparse_lattice([[0, 0, 0], [last] * 3])[1][[0, -1]].tolist() == [[0, 0, 0], [last + 1] * 3]
    for far in ([last + 1, last, last], [2**31 - 2] * 3):
        with pytest.raises(ValueError, match="too far apart"):
            sparse_lattice([[0, 0, 0], far])
    with pytest.raises(ValueError, match="range of int32"):
        sparse_lattice([[2**31, 0, 0]])
    with pytest.raises(TypeError, match="integers"):
        sparse_lattice([[0.5, 0, 0]])
    with pytest.raises(ValueError, match="shape"):
        sparse_lattice([[0, 0]])


def test_sparse_cells_are_checked():
    _, corners, cells = sparse_lattice([[0, 0, 0]])
    values = np.array([1.0, -1, -1, -1, -1, -1, -1, -1])
    assert extract_cells(corners[:0], values[:0], cells[:0])[1].shape == (0, 3)
    for bad in (cells + 1, cells - 1):
        with pytest.raises(ValueError, match="does not exist"):
            extract_cells(corners, values, bad)
    with pytest.raises(ValueError, match="C order"):
        extract_cells(corners, values, cells[:, ::-1])
    with pytest.raises(ValueError, match="one for each corner"):
        extract_cells(corners, values[:-1], cells)
    with pytest.raises(ValueError, match="level"):
        extract_cells(corners, values, cells, np.nan)
