# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Distances of a grid at the corners of voxels, and the areas of triangles at their vertices."""

import numpy as np
import pytest
import torch
import trimesh
from radarsdf._core import Encoding, VertexTable, cell_keys, vertex_areas
from radarsdf.field.grid_field import GridField

LEAF_M = 0.25


def grid_field(cells, seed=0):
    """A field of random distances on leaf cells with these coordinates (C, 3)."""
    centres = np.ascontiguousarray((np.asarray(cells) + 0.5) * LEAF_M, np.float32)
    field = GridField(np.unique(cell_keys(centres, LEAF_M)), LEAF_M)
    with torch.no_grad():
        field.distances_m.copy_(
            torch.randn(field.table.num_rows, generator=torch.Generator().manual_seed(seed))
        )
    return field


def distances_at(field, corners, parts, num_threads=1):
    return field.table.distances_at(field.leaf_corners().distances_m, corners, parts, num_threads)


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_corners_inside_a_cell_have_the_value_of_the_field(parts):
    rng = np.random.default_rng(1)
    cells = rng.integers(-6, 6, (200, 3))
    field = grid_field(cells)
    corners = (
        (cells[:, None] * parts + np.indices((parts + 1,) * 3).reshape(3, -1).T)
        .reshape(-1, 3)
        .astype(np.int32)
    )
    found = distances_at(field, corners, parts)
    # Moved into the cell by a millionth: outside there may be none.
    centres = np.repeat((cells + 0.5) * LEAF_M, (parts + 1) ** 3, axis=0)
    inside = corners * (LEAF_M / parts) + 1e-6 * (centres - corners * (LEAF_M / parts))
    expected = field.sdf(torch.from_numpy(inside.astype(np.float32))).detach().numpy()
    np.testing.assert_allclose(found, expected, atol=3e-5)
    for threads in (2, 3):
        assert distances_at(field, corners, parts, threads).tobytes() == found.tobytes()


def test_corners_of_cells_have_the_stored_distances():
    field = grid_field(np.indices((3, 3, 3)).reshape(3, -1).T - 1)
    stored = field.leaf_corners()
    np.testing.assert_array_equal(distances_at(field, 3 * stored.corners, 3), stored.distances_m)


def test_a_corner_in_no_cell_has_no_distance():
    field = grid_field([[0, 0, 0]])
    corners = np.array([[0, 0, 0], [2, 2, 2], [3, 0, 0], [-1, 0, 0], [2**30, 0, 0]], np.int32)
    assert np.isnan(distances_at(field, corners, 2)).tolist() == [False, False, True, True, True]
    flat = VertexTable(field.table.leaf_keys(), LEAF_M, 1, Encoding.TRI_QUADTREE)
    with pytest.raises(ValueError, match="octree"):
        flat.distances_at(np.zeros(flat.num_rows, np.float32), corners, 2)
    with pytest.raises(ValueError, match="distances_m"):
        field.table.distances_at(np.zeros(3, np.float32), corners, 2)
    with pytest.raises(ValueError, match="parts"):
        distances_at(field, corners, 0)


def test_areas_at_vertices_are_thirds_of_the_triangles():
    mesh = trimesh.creation.icosphere(2)
    found = vertex_areas(mesh.vertices.copy(), mesh.faces.astype(np.int32))
    assert found.sum() == pytest.approx(mesh.area)
    expected = np.zeros(len(mesh.vertices))
    np.add.at(expected, mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3))
    np.testing.assert_allclose(found, expected)
    for wrong in (-1, len(mesh.vertices)):
        with pytest.raises(ValueError, match="vertex"):
            vertex_areas(mesh.vertices.copy(), np.array([[0, 1, wrong]], np.int32))
