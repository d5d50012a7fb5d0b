"""Meshes of the plane z = 0 and the wall x = 20: position, orientation and extent."""

import dataclasses
import functools

import numpy as np
import pytest
import radarsdf
from radarsdf._core import mesh_components
from radarsdf.map.colors import Scale
from radarsdf.map.mesh import _corner_distances, crossed
from radarsdf.map.radar_map import RadarMap
from scipy.spatial import KDTree

from ..conftest import ground_and_wall
from ..mesh_checks import has_single_cycle_links, single_edges

UTM = np.array([5e5, 5.4e6, 300.0])
SENSOR = np.array([3.0, 0.0, 1.5])
LEAF_M = 0.2


def moved(radar_map, origin):
    return RadarMap(dataclasses.replace(radar_map._contents, origin=radar_map.origin + np.asarray(origin)))


@pytest.fixture(scope="module")
def mesh(sharp_map):
    return sharp_map.mesh()


@pytest.fixture(scope="module")
def mesh_of(sharp_map):
    """A function from voxel size to mesh, cached for all tests."""
    return functools.cache(sharp_map.mesh)


def surface_distance(vertices):
    return np.minimum(np.abs(vertices[:, 2]), np.abs(vertices[:, 0] - 20))


def inside(mesh):
    """Triangles well inside the observed space, away from the corner of plane and wall."""
    x, y, z = mesh.triangles_center.T
    seen = (np.abs(y) < 5) & (x > 9) & (x < 21) & (z < 3.5)
    return seen & ~((x > 19.2) & (z < 0.8))


def test_vertices_lie_on_the_surface(mesh):
    centres = mesh.triangles_center[inside(mesh)]
    assert len(centres) > 10_000
    # Noise of 2 cm on the returns.
    assert np.median(surface_distance(centres)) < 0.02
    assert np.quantile(surface_distance(centres), 0.9) < 0.1


def test_triangles_face_free_space(mesh):
    x, _, z = mesh.triangles_center.T
    ground, wall = inside(mesh) & (x < 19), inside(mesh) & (z > 1)
    area = mesh.area_faces
    # Towards the sensor: up from the ground, back from the wall.
    assert np.average(mesh.face_normals[ground, 2] > 0.7, weights=area[ground]) > 0.95
    assert np.average(mesh.face_normals[wall, 0] < -0.7, weights=area[wall]) > 0.95
    np.testing.assert_allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("voxel_size", [0.05, 0.15, 0.2])
def test_any_voxel_size_gives_the_same_surface(sharp_map, mesh_of, voxel_size):
    mesh = mesh_of(voxel_size)
    centres = mesh.triangles_center[inside(mesh)]
    assert np.median(surface_distance(centres)) < 0.03
    ground = (np.abs(mesh.triangles_center[:, 1]) < 5) & inside(mesh) & (mesh.triangles_center[:, 0] < 19)
    projected = (mesh.area_faces * np.abs(mesh.face_normals[:, 2]))[ground].sum()
    # x from 9 to 19 and y from -5 to 5: nothing is missing, and little is duplicated.
    assert 95 < projected < 125
    # At most a voxel outside the observed space.
    cells = sharp_map.field.table.leaf_cells()
    ends = np.stack([cells.min(axis=0), cells.max(axis=0) + 1])
    lower, upper = ends * LEAF_M + sharp_map.origin
    nearest = np.clip(mesh.vertices, lower, upper)
    assert np.abs(mesh.vertices - nearest).max() <= voxel_size + 1e-6


@pytest.mark.parametrize("voxel_size", [0.1, 0.15, 0.3])
def test_meshes_are_manifold(sharp_map, voxel_size):
    mesh = sharp_map.mesh(voxel_size, min_component_triangles=0)
    border = single_edges(mesh.faces)  # fails where an edge has more than two triangles or two that disagree
    assert mesh.area_faces.min() > 0
    fans = has_single_cycle_links(mesh.faces, len(mesh.vertices))
    fans[border] = True  # two open fans may touch where the cells end
    assert fans.all()


def test_a_utm_origin_gives_the_same_mesh_moved(sharp_map, mesh):
    far = moved(sharp_map, UTM).mesh()
    np.testing.assert_array_equal(far.faces, mesh.faces)
    np.testing.assert_allclose(far.vertices - UTM, mesh.vertices, atol=2e-9)  # resolution of float64 at 5.4e6


@pytest.mark.parametrize("offset", [np.zeros(3), UTM])
def test_a_box_in_the_world_frame(sharp_map, offset):
    far = moved(sharp_map, offset)
    box = np.array([[10.0, -2, -1], [15, 2, 1]]) + offset
    cropped = far.mesh(box=box, min_component_triangles=0)
    # Voxels whose centres lie inside reach out by half a voxel.
    assert (cropped.vertices >= box[0] - 0.05 - 1e-6).all()
    assert (cropped.vertices <= box[1] + 0.05 + 1e-6).all()
    whole = far.mesh(min_component_triangles=0)
    inner = ((whole.triangles >= box[0] + 0.06) & (whole.triangles <= box[1] - 0.06)).all(axis=(1, 2))
    kept = ((cropped.triangles >= box[0] + 0.06) & (cropped.triangles <= box[1] - 0.06)).all(axis=(1, 2))
    assert inner.sum() == kept.sum() > 1000
    np.testing.assert_allclose(np.sort(whole.area_faces[inner]), np.sort(cropped.area_faces[kept]), atol=1e-4)


def test_small_components_are_dropped():
    few = ground_and_wall(scans=2, returns_per_scan=160)
    config = radarsdf.FitConfig(training={"sdf_iterations": 60, "batch_size": 1024})
    patches = radarsdf.fit(few.points, few.poses, config=config, progress=False)
    whole = patches.mesh(min_component_triangles=0)
    labels, sizes = mesh_components(whole.faces.astype(np.int32), len(whole.vertices))
    assert sizes.min() < 50 < sizes.max()
    cut = patches.mesh(min_component_triangles=50)
    kept = mesh_components(cut.faces.astype(np.int32), len(cut.vertices))[1]
    assert kept.tolist() == sizes[sizes >= 50].tolist()
    # No vertex is unused, and none is renumbered to another position.
    np.testing.assert_array_equal(np.unique(cut.faces), np.arange(len(cut.vertices)))
    np.testing.assert_array_equal(cut.triangles, whole.triangles[sizes[labels] >= 50])


def test_a_viewpoint_gives_intensities_and_colours(sharp_map, mesh):
    seen = sharp_map.mesh(viewpoint=SENSOR)
    np.testing.assert_array_equal(seen.vertices, mesh.vertices)
    intensity = seen.vertex_attributes["intensity"]
    np.testing.assert_allclose(intensity, sharp_map.intensity(np.asarray(seen.vertices), SENSOR), atol=1e-4)
    scale = sharp_map.intensity_scale
    expected = Scale(scale.low, scale.high)(intensity)
    opaque = np.pad(expected, ((0, 0), (0, 1)), constant_values=255)
    np.testing.assert_array_equal(seen.visual.vertex_colors, opaque)
    x, _, z = seen.vertices.T
    on_wall = (np.abs(x - 20) < 0.1) & (z > 1) & (z < 3)
    expected = 100 - 40 * np.log10(np.linalg.norm(seen.vertices[on_wall] - SENSOR, axis=1))
    assert np.median(np.abs(intensity[on_wall] - expected)) < 1.5
    assert "intensity" not in mesh.vertex_attributes


@pytest.mark.parametrize("viewpoint", [None, SENSOR])
def test_a_box_without_surface_has_an_empty_mesh(sharp_map, viewpoint):
    empty = sharp_map.mesh(box=[[500, 500, 500], [501, 501, 501]], viewpoint=viewpoint)
    assert len(empty.vertices) == len(empty.faces) == 0
    none = sharp_map.mesh(0.2, viewpoint=viewpoint, min_component_triangles=10**9)
    assert len(none.vertices) == len(none.faces) == 0


# Voxels that do not divide the cells have other offsets at the border: a few vertices differ there.
@pytest.mark.parametrize("voxel_size", [0.1, 0.13])
def test_skipping_cells_away_from_the_surface_loses_nothing(sharp_map, mesh_of, voxel_size, monkeypatch):
    cells = sharp_map.field.table.leaf_cells()
    searched = crossed(cells, LEAF_M, functools.partial(_corner_distances, sharp_map._contents, LEAF_M))
    assert len(searched) < 0.8 * len(cells)
    mesh = mesh_of(voxel_size)
    assert mesh.metadata["leaf_cells_searched"] == len(searched)
    assert mesh.metadata["leaf_cells"] == len(cells)
    monkeypatch.setattr("radarsdf.map.mesh.crossed", lambda cells, *_: cells)
    whole = sharp_map.mesh(voxel_size)
    even = voxel_size == 0.1
    assert len(mesh.faces) == pytest.approx(len(whole.faces), rel=1e-4 if even else 1e-3)
    distance_m, _ = KDTree(mesh.vertices).query(whole.vertices)
    assert np.quantile(distance_m, 0.9999 if even else 0.998) < 1e-4  # other batches, other rounding


def test_vertices_carry_the_confidence_of_their_place(sharp_map, mesh, tmp_path):
    confidence = mesh.vertex_attributes["confidence"]
    assert confidence.dtype == np.float32
    np.testing.assert_allclose(confidence, sharp_map.confidence(np.asarray(mesh.vertices)), atol=1e-6)
    assert confidence.min() > 0
    assert confidence.min() >= mesh.metadata["min_confidence"] > 0
    mesh.export(tmp_path / "mesh.ply")
    assert b"property float confidence" in (tmp_path / "mesh.ply").read_bytes()[:1000]


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        *(("voxel_size", size) for size in (0, np.nan, 1e13)),
        *(("box", box) for box in ([[0, 0, 0]], [[1, 0, 0], [0, 1, 1]], [[0, 0, 0], [1e13] * 3])),
        *(("viewpoint", place) for place in ([1, 2], [np.nan, 0, 0], [1e13, 0, 0])),
        *(("min_confidence", limit) for limit in (-0.001, 1.001, np.nan)),
        *(("max_uncertainty", limit) for limit in (-0.001, np.nan)),
        ("min_component_triangles", -1),
    ],
)
def test_wrong_arguments_are_named(sharp_map, name, wrong):
    with pytest.raises(ValueError, match=name):
        sharp_map.mesh(**{name: wrong})


def test_without_intensities_there_is_no_viewpoint(scene):
    bare = radarsdf.fit(scene.points, scene.poses, config=radarsdf.FitConfig.quick(), progress=False)
    assert not bare.has_intensity
    with pytest.raises(ValueError, match="without"):
        bare.mesh(viewpoint=SENSOR)
    with pytest.raises(ValueError, match="without intensities"):
        bare.intensity(SENSOR[None], SENSOR)
