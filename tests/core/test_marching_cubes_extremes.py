# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Marching cubes on the worst volumes that chance finds, and on the largest and smallest numbers."""

from __future__ import annotations

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from radarsdf.map.marching_cubes import extract_cells, marching_cubes, sparse_lattice

from ..mesh_checks import (
    cells_in_use,
    euler_characteristic,
    has_single_cycle_links,
    noise,
    normals,
    on_border,
    same_mesh,
    single_edges,
    sphere,
    torus,
)
from ..reference_marching_cubes import reference_marching_cubes

EXAMPLES = int(os.environ.get("RADARSDF_EXAMPLES", "0"))
LIMITS = settings(max_examples=EXAMPLES or 40, derandomize=not EXAMPLES, deadline=None, database=None)

SAMPLES = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    np.nan,
    np.inf,
    -np.inf,
    3.4028235e38,
    -3.4028235e38,
    1e-45,
    -1e-45,
    1e-38,
]
LEVELS = [
    0.0,
    -0.0,
    0.5,
    1.0,
    3.4028234663852886e38,
    -3.4028234663852886e38,
    1e39,
    1e-45,
    -1e-45,
    5e-324,
    1e-38,
    1e300,
]


def check(volume, level, mask=None):
    """All that the docstring promises, on the unit lattice."""
    vertices, faces = mesh = marching_cubes(volume, level, mask=mask)
    used = cells_in_use(volume, mask)
    assert np.isfinite(vertices).all()
    assert np.unique(faces).size == len(vertices) == len(np.unique(vertices, axis=0))
    assert (np.linalg.norm(normals(vertices, faces), axis=1) > 0).all()
    # Where no triangle joins, there is no cell; single_edges fails for two that run the same way. Cells that meet along
    # a lattice edge only, beside cells that are not in use, share a vertex but no fan of triangles.
    border = single_edges(faces)
    assert on_border(vertices, border, used).all()
    manifold = has_single_cycle_links(faces, len(vertices))
    manifold[border] = True
    assert manifold.all()
    assert same_mesh(mesh, reference_marching_cubes(volume, level, mask=mask))
    for threads in (1, 3):
        again = marching_cubes(volume, level, mask=mask, num_threads=threads)
        assert all(a.tobytes() == b.tobytes() for a, b in zip(mesh, again, strict=True))
    _, corners, cells = sparse_lattice(np.argwhere(used))
    values = volume[tuple(corners.T)]
    assert same_mesh(mesh, extract_cells(corners, values, cells, level, num_threads=2))
    return mesh


@LIMITS
@given(
    volume=hnp.arrays(
        st.sampled_from([np.float32, np.float64]),
        hnp.array_shapes(min_dims=3, max_dims=3, min_side=1, max_side=5),
        elements=st.sampled_from(SAMPLES),
        fill=st.nothing(),
    ),
    level=st.sampled_from(LEVELS),
    data=st.data(),
)
def test_worst_volumes_give_manifolds(volume, level, data):
    mask = data.draw(st.none() | hnp.arrays(np.bool_, volume.shape))
    check(volume, level, mask)


@pytest.mark.parametrize(("field", "characteristic"), [(sphere, 2), (torus, 0)])
@pytest.mark.parametrize(
    "spacing", [(1, 1, 1), (1e-3, 1.0, 1e3), (1e-150, 1e-140, 1e-145), (1e100, 1e90, 1e95)]
)
def test_topology_of_any_spacing(field, characteristic, spacing):
    n = 24
    vertices, faces = marching_cubes(field(n).astype(np.float32), spacing=spacing)
    assert euler_characteristic(vertices, faces) == characteristic
    assert len(single_edges(faces)) == 0
    assert has_single_cycle_links(faces, len(vertices)).all()
    unit, same_faces = marching_cubes(field(n).astype(np.float32))
    assert np.array_equal(faces, same_faces)
    np.testing.assert_allclose(vertices / spacing, unit, rtol=1e-15)


def test_positions_that_float64_cannot_hold_are_refused():
    with pytest.raises(ValueError, match="beyond float64"):
        marching_cubes(noise(0), spacing=(1e308, 1, 1))


def test_far_from_the_origin_vertices_keep_apart_as_far_as_the_docstring_says():
    vertices, faces = marching_cubes(noise(1), origin=(1e12, -1e12, 1e12))
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert (np.linalg.norm(normals(vertices - vertices[0], faces), axis=1) > 0).all()
