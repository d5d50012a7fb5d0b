# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Any scans for a fit and its estimate, and any arrays for the functions on lattices and meshes.

As in `test_arguments`.
"""

from __future__ import annotations

import numpy as np
import radarsdf
from hypothesis import given
from hypothesis import strategies as st
from radarsdf import FitConfig
from radarsdf.map.isosurface import extract_cells, mesh_components, sparse_lattice

from .test_arguments import FLOATS, THINGS, answer, arrays, examples, mostly, pose

TINY = FitConfig(
    num_threads=1,
    max_memory_bytes=10**9,
    returns={"min_range_m": 0.0},
    encoding={"num_levels": 2, "fourier_count": 2},
    networks={"sdf_hidden": (4,), "intensity_hidden": (4,)},
    training={"sdf_iterations": 1, "intensity_iterations": 1, "batch_size": 16, "intensity_batch_size": 16},
)


@examples(60)
@given(
    sizes=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    poses=mostly(st.none(), arrays(2, 4, 4)),
    far=mostly(st.just(0.0), FLOATS),
    data=st.data(),
)
def test_fit_and_estimate(sizes, poses, far, data):
    points = [data.draw(arrays(size, 3)) for size in sizes]
    intensities = data.draw(st.sampled_from([None, [data.draw(arrays(size)) for size in sizes]]))
    if poses is None:
        poses = [pose(far * i) for i in range(len(sizes))]
    radar_map = answer(radarsdf.fit, points, poses, intensities, config=TINY, progress=False)
    estimate = answer(radarsdf.estimate, points, poses, intensities, config=TINY)
    if radar_map is None:
        return
    assert estimate is not None
    assert radar_map.report["returns_used"] <= estimate.returns
    assert 0 < estimate.peak_memory_bytes <= 10**9
    assert 0 < estimate.seconds < 60
    centres = (radar_map.field.cells.table.leaf_cells() + 0.5) * TINY.leaf_size_m + radar_map.origin
    for values in (radar_map.sdf(centres), radar_map.gradient(centres), radar_map.confidence(centres)):
        assert np.isfinite(values).all()


WHOLE = st.integers(-4, 4) | st.sampled_from([2**31 - 1, -(2**31), 2**30, 2**31, 2**62, -1, 10**9])


@st.composite
def lattices(draw, columns):
    """Rows of whole numbers, now and then of another type or shape."""
    rows = draw(st.integers(0, 6))
    if draw(st.integers(0, 7)) == 7:
        return draw(arrays(rows, columns))
    values = draw(st.lists(WHOLE, min_size=rows * columns, max_size=rows * columns))
    return np.array(values or [], np.int32 if fits(values) else np.int64).reshape(rows, columns)


def fits(values):
    return all(-(2**31) <= value < 2**31 for value in values)


@examples(100)
@given(cells=lattices(3), num_threads=mostly(st.integers(0, 3), THINGS))
def test_sparse_lattice(cells, num_threads):
    found = answer(sparse_lattice, cells, num_threads=num_threads)
    if found is None:
        return
    unique, corners, cell_corners = found
    np.testing.assert_array_equal(unique, np.unique(np.asarray(cells).reshape(-1, 3), axis=0))
    assert cell_corners.shape == (len(unique), 8)
    np.testing.assert_array_equal(corners[cell_corners[:, 0]], unique)
    np.testing.assert_array_equal(corners[cell_corners[:, 7]], unique + 1)
    assert len(np.unique(corners, axis=0)) == len(corners)


@examples(100)
@given(cells=lattices(8), values=arrays(8), level=mostly(st.floats(-9, 9), THINGS), shift=WHOLE)
def test_extract_cells(cells, values, level, shift):
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3) + shift
    found = answer(extract_cells, corners, values, cells, level)
    if found is None:
        return
    vertices, faces = found
    assert np.isfinite(vertices).all()
    assert not len(faces) or 0 <= faces.min() <= faces.max() < len(vertices)


@examples(100)
@given(faces=lattices(3), num_vertices=mostly(st.integers(0, 9), THINGS))
def test_mesh_components(faces, num_vertices):
    found = answer(mesh_components, faces, num_vertices)
    if found is None:
        return
    labels, sizes = found
    np.testing.assert_array_equal(np.bincount(labels, minlength=len(sizes)), sizes)
