# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Connected components against their definition and against SciPy."""

import numpy as np
import pytest
from radarsdf.map.marching_cubes import marching_cubes, mesh_components

from ..mesh_checks import directed_edges, grid, noise


def test_components_are_labelled_in_order():
    x, y, z = grid(40)
    spheres = np.minimum(np.hypot(np.hypot(x - 0.5, y), z) - 0.3, np.hypot(np.hypot(x + 0.6, y), z) - 0.15)
    vertices, faces = marching_cubes(spheres)
    is_small = vertices[faces[:, 0], 0] < 17
    assert is_small[0], "the small sphere comes first along x"
    for order in (slice(None), slice(None, None, -1)):
        labels, sizes = mesh_components(faces[order], len(vertices))
        assert labels[0] == 0
        assert np.array_equal(labels == labels[0], is_small[order] == is_small[order][0])
        assert np.array_equal(sizes, np.bincount(labels))
        assert len(sizes) == 2


def test_components_against_scipy():
    sparse = pytest.importorskip("scipy.sparse")
    vertices, faces = marching_cubes(noise(17) + 1.6)
    edges = directed_edges(faces)
    graph = sparse.coo_array((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    count, of_vertex = sparse.csgraph.connected_components(graph, directed=False)
    labels, sizes = mesh_components(faces, len(vertices))
    assert len(sizes) == count > 10
    pairs = np.unique(np.stack([labels, of_vertex[faces[:, 0]]]), axis=1)
    assert pairs.shape[1] == count


def test_components_of_nothing_and_of_wrong_faces():
    labels, sizes = mesh_components(np.zeros((0, 3), dtype=np.int32), 0)
    assert labels.shape == sizes.shape == (0,)
    for bad in ([[0, 1, 3]], [[-1, 0, 1]]):
        with pytest.raises(ValueError, match="does not exist"):
            mesh_components(bad, 3)
