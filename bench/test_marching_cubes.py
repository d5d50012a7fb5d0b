"""Speed of marching cubes against other programs on the same float32 samples, on one thread unless the case says more.

Groups: two fields; lattice and extraction of a shell; a real map by its cells. Each case checks the number of triangles or
the area of its mesh, so that a wrong result cannot be the fastest. Each program has its usual outputs: VTK float32 points and
int64 cells, scikit-image also normals and values, PyMCubes float64 and int64. Ours are float64 and int32.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf._core import marching_cubes_sparse
from radarsdf.map.marching_cubes import marching_cubes, sparse_lattice

UNIT = [1.0] * 3, [0.0] * 3, 0.0  # spacing, origin and level


def sphere(size):
    axis = np.linspace(-1, 1, size, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    return np.sqrt(x * x + y * y + z * z) - np.float32(0.8)


def gyroid(size):
    axis = np.linspace(-4 * np.pi, 4 * np.pi, size, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


# Function, and number of triangles by size of the volume, which rounding can change slightly. The smaller is for smoke tests.
FIELDS = {
    "sphere256": (sphere, {256: 392_252, 96: 54_572}),
    "gyroid192": (gyroid, {192: 1_415_084, 96: 350_372}),
}


@pytest.fixture(scope="module", params=FIELDS)
def field(request, smoke):
    """Volume, number of triangles, and their area in cells if it is known."""
    make, num_faces = FIELDS[request.param]
    size = min(num_faces) if smoke else max(num_faces)
    area = 4 * np.pi * (0.8 * (size - 1) / 2) ** 2 if make is sphere else None
    return np.ascontiguousarray(make(size), dtype=np.float32), num_faces[size], area


def check_mesh(vertices, faces, field, rel=1e-4):
    _, num_faces, expected = field
    assert len(faces) == pytest.approx(num_faces, rel=rel)
    if expected is not None:
        a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        assert area == pytest.approx(expected, rel=1e-3)


def field_group(field):
    return f"marching cubes, {field[1]:,} triangles in {field[0].size:,} samples"


@pytest.mark.parametrize("threads", [1, 2])
def test_dense(benchmark, field, threads):
    benchmark.group = field_group(field)
    vertices, faces = benchmark(marching_cubes, field[0], num_threads=threads)
    check_mesh(vertices, faces, field)


class FlyingEdges:
    """Marching cubes of VTK on a volume."""

    def __init__(self, volume, backend, threads):
        vtk = pytest.importorskip("vtk", reason="vtk is not installed")
        from vtk.util.numpy_support import numpy_to_vtk  # noqa: PLC0415

        assert vtk.vtkSMPTools.SetBackend(backend), f"this VTK has no {backend}"
        vtk.vtkSMPTools.Initialize(threads)
        assert vtk.vtkSMPTools.GetEstimatedNumberOfThreads() == threads
        self._new_filter = vtk.vtkFlyingEdges3D
        self._image = vtk.vtkImageData()
        self._image.SetDimensions(volume.shape[::-1])
        self._image.GetPointData().SetScalars(numpy_to_vtk(volume.ravel(), deep=True))

    def run(self):
        filter_ = self._new_filter()
        filter_.SetInputData(self._image)
        filter_.SetValue(0, 0.0)
        filter_.ComputeNormalsOff()
        filter_.ComputeGradientsOff()
        filter_.ComputeScalarsOff()
        filter_.Update()
        return filter_.GetOutput()

    @staticmethod
    def arrays(mesh):
        """Vertices (V, 3) and faces (F, 3). The axes x, y, z are the axes 2, 1, 0 of the volume."""
        from vtk.util.numpy_support import vtk_to_numpy  # noqa: PLC0415

        faces = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)
        return vtk_to_numpy(mesh.GetPoints().GetData()), faces


FLYING_EDGES = pytest.mark.parametrize(("backend", "threads"), [("Sequential", 1), ("STDThread", 2)])


@FLYING_EDGES
def test_vtk_flying_edges(benchmark, field, backend, threads):
    benchmark.group = field_group(field)
    mesh = benchmark(FlyingEdges(field[0], backend, threads).run)
    check_mesh(*FlyingEdges.arrays(mesh), field)


def test_scikit_image(benchmark, field):
    benchmark.group = field_group(field)
    measure = pytest.importorskip("skimage.measure", reason="scikit-image is not installed")
    vertices, faces, *_ = benchmark(measure.marching_cubes, field[0], 0.0)
    check_mesh(vertices, faces, field, rel=0.01)  # ambiguous cells are resolved differently


def test_pymcubes(benchmark, field):
    benchmark.group = field_group(field)
    mcubes = pytest.importorskip("mcubes", reason="PyMCubes is not installed")
    vertices, faces = benchmark(mcubes.marching_cubes, field[0], 0.0)
    check_mesh(vertices, faces, field, rel=0.01)


@pytest.fixture(scope="module")
def shell(smoke):
    """Radius of a sphere, cells of random points within 2 cells of it, repeated and in random order, and their number."""
    rng = np.random.default_rng(0)
    radius, count, num_cells = (40, 400_000, 92_185) if smoke else (200, 6_000_000, 2_116_492)
    points = rng.normal(size=(count, 3))
    points *= (radius + rng.uniform(-2, 2, size=(count, 1))) / np.linalg.norm(points, axis=1, keepdims=True)
    return radius, np.floor(points).astype(np.int32), num_cells


@pytest.mark.parametrize("threads", [1, 2])
def test_sparse_lattice(benchmark, shell, threads):
    benchmark.group = "lattice of a shell"
    _, given, num_cells = shell
    cells, corners, cell_corners = benchmark(sparse_lattice, given, num_threads=threads)
    assert len(cells) == num_cells
    assert np.array_equal(corners[cell_corners[:, 7]], cells + 1)


@pytest.mark.parametrize("threads", [1, 2])
def test_sparse_extraction(benchmark, shell, threads):
    benchmark.group = "extraction from a shell"
    radius, given, _ = shell
    _, corners, cells = sparse_lattice(given)
    values = (np.linalg.norm(corners, axis=1) - radius).astype(np.float32)
    vertices, faces = benchmark(marching_cubes_sparse, corners, values, cells, *UNIT, threads)
    assert np.abs(np.linalg.norm(vertices, axis=1) - radius).max() < 0.01
    assert len(faces) == {40: 59_857, 200: 1_431_246}[radius]


@dataclass(frozen=True, eq=False)
class MapLattice:
    """Voxels of a fitted map and the signed distances at their corners, as for its mesh."""

    cells: np.ndarray  # (M, 3) voxels
    values: np.ndarray  # signed distances at the corners, m, in the order of sparse_lattice
    volume: np.ndarray  # signed distances in the whole box, m; 1 outside the map
    lower: np.ndarray  # (3,) lattice coordinates of the lower corner of the box

    @cache  # noqa: B019 - the fixture creates only one
    def crossed_edges(self, *, of_cells):
        """Number of edges of the map's voxels, or of the box, that the surface crosses. A mesh has a vertex on each."""
        # The voxels inside, with one more on each side of the box.
        in_use = np.full(np.add(self.volume.shape, 1), not of_cells)
        in_use[tuple((self.cells - self.lower + 1).T)] = True
        positive, count = self.volume > 0, 0
        for axis in range(3):
            crossed = np.diff(positive, axis=axis)
            of_edge = np.delete(np.delete(in_use, 0, axis), -1, axis)
            for other in {0, 1, 2} - {axis}:
                of_edge = np.delete(of_edge, 0, other) | np.delete(of_edge, -1, other)
            count += (crossed & of_edge).sum()
        return count


@pytest.fixture(scope="module")
def map_lattice(smoke):
    frames, max_range_m, iterations = (4, 12.0, 30) if smoke else (20, 30.0, 100)
    scans = radarsdf.simulate.hugin(frames=frames)
    returns, training = {"max_range_m": max_range_m}, {"sdf_iterations": iterations}
    config = FitConfig(num_threads=1, returns=returns, training=training)
    radar_map = radarsdf.fit(scans.points, scans.poses, config=config, progress=False)
    part = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(8, 3)
    cells = (2 * radar_map.field.table.leaf_cells()[:, None] + part).reshape(-1, 3).astype(np.int32)
    cells, corners, _ = sparse_lattice(cells)
    points = corners.astype(np.float32) * np.float32(config.leaf_size_m / 2)
    with torch.no_grad():
        values = radar_map.field.sdf(torch.from_numpy(points)).numpy()
    lower = corners.min(0)
    shape = corners.max(0) - lower + 1
    volume = np.ones(shape, np.float32)
    volume[tuple((corners - lower).T)] = values
    return MapLattice(cells, values, volume, lower)


def map_group(lattice):
    return f"real map, {len(lattice.cells):,} cells in a box of {lattice.volume.size:,}"


@pytest.mark.parametrize("threads", [1, 2])
def test_map_by_cells(benchmark, map_lattice, threads):
    """Lattice and extraction. As in all cases, the network's distances at the corners are precomputed."""
    benchmark.group = map_group(map_lattice)

    def run():
        _, corners, cells = sparse_lattice(map_lattice.cells, num_threads=threads)
        return marching_cubes_sparse(corners, map_lattice.values, cells, *UNIT, threads)

    vertices, faces = benchmark(run)
    benchmark.extra_info["distances"] = len(map_lattice.values)
    check_map(vertices, faces, map_lattice.crossed_edges(of_cells=True))


@FLYING_EDGES
def test_map_vtk_flying_edges(benchmark, map_lattice, backend, threads):
    """VTK has no mask, so its mesh also has a surface at the border of the map."""
    benchmark.group = map_group(map_lattice)
    mesh = benchmark(FlyingEdges(map_lattice.volume, backend, threads).run)
    check_map(*FlyingEdges.arrays(mesh), map_lattice.crossed_edges(of_cells=False))


def check_map(vertices, faces, crossed_edges):
    assert len(vertices) == crossed_edges
    assert np.array_equal(np.unique(faces), np.arange(len(vertices)))
    # A closed surface has twice as many triangles as vertices. Borders reduce the number, handles increase it.
    assert 1.2 * len(vertices) < len(faces) < 2.1 * len(vertices)
