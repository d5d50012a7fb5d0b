"""Marching cubes by property: topology, geometry, agreement of dense, sparse and reference."""

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from radarsdf._core import marching_cubes_sparse, mesh_components
from radarsdf.map.marching_cubes import marching_cubes, sparse_lattice

from ..mesh_checks import (
    area,
    cells_in_use,
    directed_edges,
    euler_characteristic,
    grid,
    has_single_cycle_links,
    noise,
    normals,
    on_border,
    plateaus,
    same_mesh,
    signed_volume,
    single_edges,
    sphere,
    torus,
)
from ..reference_marching_cubes import reference_marching_cubes


@pytest.mark.parametrize(
    ("field", "exact_area", "exact_volume", "characteristic"),
    [
        (sphere, 4 * np.pi * 0.8**2, 4 / 3 * np.pi * 0.8**3, 2),
        (torus, 4 * np.pi**2 * 0.6 * 0.25, 2 * np.pi**2 * 0.6 * 0.25**2, 0),
    ],
)
def test_closed_surfaces_have_the_exact_size_and_topology(field, exact_area, exact_volume, characteristic):
    n = 61
    h = 2 / (n - 1)
    vertices, faces = marching_cubes(field(n), spacing=[h] * 3, origin=[-1] * 3)
    assert vertices.dtype == np.float64
    assert faces.dtype == np.int32
    assert len(single_edges(faces)) == 0
    assert has_single_cycle_links(faces, len(vertices)).all()
    assert euler_characteristic(vertices, faces) == characteristic
    assert area(vertices, faces) == pytest.approx(exact_area, rel=3e-3)
    # normals point to larger values, that is outwards, so the volume is positive
    assert signed_volume(vertices, faces) == pytest.approx(exact_volume, rel=5e-3)
    x, y, z = vertices.T
    distance = (
        np.sqrt(x**2 + y**2 + z**2) - 0.8 if field is sphere else np.hypot(np.hypot(x, y) - 0.6, z) - 0.25
    )
    assert np.abs(distance).max() < h**2


@pytest.mark.parametrize("pattern", range(256))
def test_each_pattern_is_closed_in_any_neighbourhood(pattern):
    rng = np.random.default_rng(pattern)
    volume = np.where(rng.random((6, 6, 6)) < 0.5, 1.0, -1.0)
    volume[2:4, 2:4, 2:4] = np.array([1.0 if pattern >> c & 1 else -1.0 for c in range(8)]).reshape(2, 2, 2)
    volume = np.pad(volume, 1, constant_values=1.0)
    vertices, faces = marching_cubes(volume)
    assert len(single_edges(faces)) == 0
    assert has_single_cycle_links(faces, len(vertices)).all()
    # every volume here is negative inside of positive padding, so the normals point out of it
    assert signed_volume(vertices, faces) > 0


@pytest.mark.parametrize(
    "volume",
    [noise(2, (5, 6, 7)), noise(3, (3, 2, 70), np.float64), noise(5, (4, 4, 32)), plateaus(6, (5, 6, 35))],
)
@pytest.mark.parametrize("masked", [False, True])
def test_dense_and_sparse_equal_the_reference(volume, masked):
    volume = np.asarray(volume, dtype=np.float32)
    placement = {"level": 0.1, "spacing": (0.5, 2.0, 0.1), "origin": (-3.0, 1e3, 0.25)}
    mask = None
    if masked:
        rng = np.random.default_rng(7)
        mask = rng.random(volume.shape) < 0.9
        volume = np.where(rng.random(volume.shape) < 0.03, np.nan, volume)
        volume[0, 0, 0], volume[-1, -1, -1] = np.inf, -np.inf
    dense = marching_cubes(volume, mask=mask, **placement)
    assert same_mesh(dense, reference_marching_cubes(volume, mask=mask, **placement))
    _, corners, cell_corners = sparse_lattice(np.argwhere(cells_in_use(volume, mask)))
    placement = {"spacing": [1.0] * 3, "origin": [0.0] * 3, "level": 0.0} | placement
    sparse = marching_cubes_sparse(corners, volume[tuple(corners.T)], cell_corners, **placement)
    assert same_mesh(dense, sparse)


def test_float32_volumes_are_compared_with_the_level_in_float64():
    third = np.float32(0.1)  # larger than 0.1
    volume = np.zeros((2, 2, 2), dtype=np.float32)
    volume[1, 1, 1] = third
    assert len(marching_cubes(volume, 0.1)[1]) == 1
    assert len(marching_cubes(volume, float(third))[1]) == 0
    assert len(marching_cubes(-volume, -float(third))[1]) == 1


@pytest.mark.parametrize("n", [31, 32, 33, 65])
def test_rows_of_any_length_are_complete(n):
    volume = np.ones((4, 4, n))
    volume[1:3, 1:3, 1:-1] = -1
    vertices, faces = marching_cubes(volume)
    assert euler_characteristic(vertices, faces) == 2
    assert len(single_edges(faces)) == 0
    assert vertices[:, 2].min() == 0.5
    assert vertices[:, 2].max() == n - 1.5
    assert len(marching_cubes(volume > 0, 0.5)[1]) == len(faces)


def test_far_from_the_origin_the_mesh_keeps_its_shape():
    volume = plateaus(13)
    near, faces = marching_cubes(volume, spacing=[0.1] * 3)
    far, same_faces = marching_cubes(volume, spacing=[0.1] * 3, origin=(1e7, -1e7, 1e7))
    assert np.array_equal(faces, same_faces)
    assert np.abs(far - (1e7, -1e7, 1e7) - near).max() < 4e-9  # a few roundings at 1e7
    assert (np.linalg.norm(normals(far, faces), axis=1) > 0).all()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"volume": np.zeros((3, 3))}, ValueError, "three axes"),
        ({"volume": np.zeros((3, 3, 3), dtype=complex)}, TypeError, "real"),
        ({"level": np.nan}, ValueError, "level"),
        ({"spacing": (1, 1)}, ValueError, "spacing"),
        ({"spacing": (1, 0, 1)}, ValueError, "spacing"),
        ({"origin": (0, np.nan, 0)}, ValueError, "origin"),
        ({"mask": np.ones((3, 3, 2), dtype=bool)}, ValueError, "mask"),
        ({"mask": np.ones((3, 3, 3))}, TypeError, "mask"),
    ],
)
def test_wrong_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        marching_cubes(**{"volume": np.zeros((3, 3, 3)), **arguments})


EXAMPLES = int(os.environ.get("RADARSDF_EXAMPLES", "0"))
LIMITS = settings(max_examples=EXAMPLES or 40, derandomize=not EXAMPLES, deadline=None, database=None)
SAMPLES = [0.0, -0.0, 1.0, -1.0, 0.5, np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, -1e-45, 1e-38]
LEVELS = [0.0, -0.0, 0.5, 1.0, 3.4e38, -3.4e38, 1e39, 1e-45, -1e-45, 5e-324, 1e-38, 1e300]


def check(volume, level, mask=None):
    """Checks all promises of the docstring, on the unit lattice."""
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
    assert same_mesh(mesh, marching_cubes_sparse(corners, values, cells, [1.0] * 3, [0.0] * 3, level, 2))
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


def test_components_are_labelled_in_order():
    x, y, z = grid(40)
    spheres = np.minimum(np.hypot(np.hypot(x - 0.5, y), z) - 0.3, np.hypot(np.hypot(x + 0.6, y), z) - 0.15)
    vertices, faces = marching_cubes(spheres)
    is_small = vertices[faces[:, 0], 0] < 17
    assert is_small[0], "the small sphere comes first along x"
    for order in (slice(None), slice(None, None, -1)):
        labels, sizes = mesh_components(np.ascontiguousarray(faces[order]), len(vertices))
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


def test_empty_meshes_have_no_components_and_wrong_faces_are_rejected():
    labels, sizes = mesh_components(np.zeros((0, 3), dtype=np.int32), 0)
    assert labels.shape == sizes.shape == (0,)
    for bad in ([[0, 1, 3]], [[-1, 0, 1]]):
        with pytest.raises(ValueError, match="does not exist"):
            mesh_components(np.array(bad, np.int32), 3)
