# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Marching cubes against its peers on the same float32 samples, one thread unless the case says otherwise.

Each case checks the number of triangles or the area of its mesh, so that a wrong answer cannot win. The peers keep
their usual outputs: VTK float32 points and int64 cells, scikit-image also normals and values, PyMCubes float64 and
int64; ours are float64 and int32.
"""

import numpy as np
import pytest
from radarsdf.isosurface import extract_cells, marching_cubes, mesh_components, sparse_lattice


def sphere_256():
    axis = np.linspace(-1, 1, 256, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    return np.sqrt(x * x + y * y + z * z) - np.float32(0.8)


def gyroid_192():
    axis = np.linspace(-4 * np.pi, 4 * np.pi, 192, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


# The volume, its triangles (a few of the gyroid's samples are rounded to either side of 0) and their area in cells.
FIELDS = {
    "sphere256": (sphere_256, 392_252, 4 * np.pi * (0.8 * 255 / 2) ** 2),
    "gyroid192": (gyroid_192, 1_415_084, None),
}


@pytest.fixture(scope="module", params=FIELDS)
def field(request):
    make, num_faces, area = FIELDS[request.param]
    return np.ascontiguousarray(make(), dtype=np.float32), num_faces, area


def check_mesh(vertices, faces, field, rel=1e-4):
    _, num_faces, expected = field
    assert len(faces) == pytest.approx(num_faces, rel=rel)
    if expected is not None:
        a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        assert area == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("threads", [1, 2])
def test_dense(benchmark, field, threads):
    vertices, faces = benchmark(marching_cubes, field[0], num_threads=threads)
    check_mesh(vertices, faces, field)


def test_dense_masked(benchmark, field):
    mask = np.ones(field[0].shape, dtype=bool)
    vertices, faces = benchmark(marching_cubes, field[0], mask=mask, num_threads=1)
    check_mesh(vertices, faces, field)


def test_vtk_flying_edges(benchmark, field):
    vtk = pytest.importorskip("vtk", reason="vtk is not installed")
    from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy  # noqa: PLC0415

    vtk.vtkSMPTools.Initialize(1)
    image = vtk.vtkImageData()
    image.SetDimensions(field[0].shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(field[0].ravel(), deep=True))

    def run():
        filter_ = vtk.vtkFlyingEdges3D()
        filter_.SetInputData(image)
        filter_.SetValue(0, 0.0)
        filter_.ComputeNormalsOff()
        filter_.ComputeGradientsOff()
        filter_.ComputeScalarsOff()
        filter_.Update()
        return filter_.GetOutput()

    mesh = benchmark(run)
    faces = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    check_mesh(vtk_to_numpy(mesh.GetPoints().GetData()), faces, field)


def test_scikit_image(benchmark, field):
    measure = pytest.importorskip("skimage.measure", reason="scikit-image is not installed")
    vertices, faces, *_ = benchmark(measure.marching_cubes, field[0], 0.0)
    check_mesh(vertices, faces, field, rel=0.01)  # it solves ambiguous cells in another way


def test_pymcubes(benchmark, field):
    mcubes = pytest.importorskip("mcubes", reason="PyMCubes is not installed")
    vertices, faces = benchmark(mcubes.marching_cubes, field[0], 0.0)
    check_mesh(vertices, faces, field, rel=0.01)


@pytest.fixture(scope="module")
def shell():
    """Cells within about two of a sphere's surface, each several times and in no order, as points fall into them."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6_000_000, 3))
    points *= (200 + rng.uniform(-2, 2, size=(len(points), 1))) / np.linalg.norm(
        points, axis=1, keepdims=True
    )
    return np.floor(points).astype(np.int32)


@pytest.mark.parametrize("threads", [1, 2])
def test_sparse_lattice(benchmark, shell, threads):
    cells, corners, cell_corners = benchmark(sparse_lattice, shell, num_threads=threads)
    assert len(cells) == 2_116_492
    assert np.array_equal(corners[cell_corners[:, 7]], cells + 1)


@pytest.mark.parametrize("threads", [1, 2])
def test_sparse_extraction(benchmark, shell, threads):
    _, corners, cells = sparse_lattice(shell)
    values = (np.linalg.norm(corners, axis=1) - 200.0).astype(np.float32)
    vertices, faces = benchmark(extract_cells, corners, values, cells, num_threads=threads)
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(200, abs=0.01)
    assert len(faces) == 1_431_246


def test_components(benchmark):
    vertices, faces = marching_cubes(gyroid_192())
    _, sizes = benchmark(mesh_components, faces, len(vertices))
    assert sizes.sum() == len(faces)
    assert sizes.max() == len(faces) - 2  # and two corners of the volume
