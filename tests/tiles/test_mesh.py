"""The mesh of a map in tiles, against one extracted from all cells at once."""

import json

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf._core import marching_cubes_sparse, mesh_components
from radarsdf.map.marching_cubes import sparse_lattice
from radarsdf.map.mesh import Surface
from radarsdf.map.threshold import Threshold
from scipy.spatial import cKDTree


def in_one_go(city, steps, min_triangles):
    """Vertices and faces of the blended field in all cells of all tiles."""
    plan = city.plan
    voxel_m = city.config.leaf_size_m / steps
    parts = []
    for tile in city.tiles:
        cells = city.contents_of(tile).field.table.leaf_cells() + tile.origin_cells
        weights = plan.grid.weights(tile.tile, city.config.lattice.position(cells + 0.5))
        parts.append(cells[weights > 0])
    owned = {tile.tile for tile in city.tiles}
    cells = np.concatenate(parts)
    cells = cells[[tuple(tile) in owned for tile in (cells[:, :2] // plan.tile_cells).tolist()]]
    inside = np.stack(np.meshgrid(*[np.arange(steps)] * 3, indexing="ij"), -1).reshape(1, -1, 3)
    _, corners, voxels = sparse_lattice((cells[:, None] * steps + inside).reshape(-1, 3))
    values = city.distances_at(corners.astype(np.int64), voxel_m)
    origin = city.config.lattice.position([0, 0, 0])
    vertices, faces = marching_cubes_sparse(corners, values, voxels, [voxel_m] * 3, origin, 0.0)
    evidence = city.evidence_at(vertices)
    surface = Surface.from_triangles(city.contents_of_any, vertices, faces, evidence, 0)
    good = surface.confidence >= surface.tally.threshold().min_confidence
    faces = faces[good[faces].all(axis=1)]
    labels, sizes = mesh_components(faces, len(vertices))
    return vertices, faces[sizes[labels] >= min_triangles]


def triangles(vertices, faces):
    """The set of triangles, with corners in an order independent of the numbering."""
    corners = np.ascontiguousarray(vertices[faces])
    return {tuple(sorted(map(tuple, corner))) for corner in corners.tolist()}


@pytest.mark.parametrize(("steps", "min_triangles"), [(1, 30), (1, 1500), (2, 0)])
def test_the_mesh_equals_that_of_all_cells_at_once(city, steps, min_triangles):
    mesh = city.mesh(0.2 / steps, min_component_triangles=min_triangles, progress=False)
    found, expected = triangles(mesh.vertices, mesh.faces), triangles(*in_one_go(city, steps, min_triangles))
    assert len(expected) > 5000
    assert found == expected
    assert len(found) == len(mesh.faces)  # no doubled triangle
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)  # welded


def test_export_writes_the_same_mesh(city, tmp_path):
    mesh = city.mesh(0.2, progress=False)
    path = tmp_path / "city.ply"
    assert city.export(path, 0.2, progress=False) == (len(mesh.vertices), len(mesh.faces))
    read = trimesh.load_mesh(path, process=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    raw = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["uncertainty_m"].ravel(), mesh.vertex_attributes["uncertainty_m"])
    with pytest.raises(ValueError, match=r"city\.txt"):
        city.export(tmp_path / "city.txt", 0.2)
    with pytest.raises(ValueError, match="no surface"):
        city.export(tmp_path / "empty.ply", 0.2, min_component_triangles=10**9, progress=False)
    assert not (tmp_path / "empty.ply").exists()


def test_the_index_for_searches_has_the_surface_of_the_mesh(city):
    mesh, index = city.mesh(city.config.leaf_size_m, progress=False), radarsdf.SurfaceIndex.of(city)
    distances_m, rows = cKDTree(index.surface.points + index.origin).query(mesh.vertices)
    assert distances_m.max() < 1e-9
    assert np.median(np.einsum("ni,ni->n", index.surface.normals[rows], mesh.vertex_normals)) > 0.999
    assert len(index.surface.points) < 1.1 * len(mesh.vertices)  # those on borders are in both tiles


def test_the_threshold_is_that_of_the_whole_map(city):
    """Tiles have none of their own: their sums determine it, independent of later limits."""
    for given in (None, 0.3):
        mesh = city.mesh(0.2, min_confidence=given, progress=False)
        threshold = city.threshold(0.2, min_confidence=given, progress=False)
        assert threshold == Threshold.of_mesh(mesh.metadata)
        assert mesh.vertex_attributes["confidence"].min() >= threshold.min_confidence
    whole = city.mesh(
        0.2, min_confidence=0, max_uncertainty=np.inf, min_component_triangles=0, progress=False
    )
    thirds = np.repeat(whole.area_faces / 3, 3)
    confidence = whole.vertex_attributes["confidence"][whole.faces].ravel()
    assert threshold.whole_precision == pytest.approx(np.average(confidence, weights=thirds), abs=1e-4)


def test_a_box_and_a_viewpoint(city):
    box = [[-3, -2, -1], [3, 8, 4]]
    mesh = city.mesh(0.2, box=box, viewpoint=[0, 0, 1], progress=False)
    assert 0 < len(mesh.faces) < len(city.mesh(0.2, progress=False).faces)
    assert (mesh.bounds[0] >= np.array(box[0]) - 0.11).all()
    assert (mesh.bounds[1] <= np.array(box[1]) + 0.11).all()
    values = mesh.vertex_attributes["intensity"]
    np.testing.assert_allclose(values, city.intensity(np.array(mesh.vertices), [0, 0, 1]), rtol=1e-5)


def test_voxels_that_do_not_divide_cells_are_rejected(city):
    for size in (0.3, 0.15, 0.07):
        with pytest.raises(ValueError, match="do not divide leaf cells"):
            city.mesh(size)
    with pytest.raises(ValueError, match="min_confidence must be in"):
        city.mesh(0.2, min_confidence=2)
    with pytest.raises(TypeError, match="boxes"):
        city.mesh(0.2, boxes=None)


def test_a_mesh_beyond_the_memory_is_rejected(city, tmp_path, monkeypatch):
    monkeypatch.setattr("radarsdf.memory.available_bytes", lambda: 10**6)
    with pytest.raises(MemoryError, match="radarsdf tiles mesh"):
        city.mesh(0.2, progress=False)
    assert city.export(tmp_path / "mesh.json", 0.2, progress=False)[1] > 10**6 / 320


Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # viewers convert glTF from y up to z up


def leaves_of(node, transform=None):
    """Leaves below a node with their transforms; each box must contain its descendants."""
    transform = np.eye(4) if transform is None else transform
    if "transform" in node:
        transform = transform @ np.reshape(node["transform"], (4, 4)).T
    if "children" not in node:
        yield node, transform
        return
    for child in node["children"]:
        assert child["geometricError"] < node["geometricError"]
        yield from leaves_of(child, transform)


def bounds(node, transform):
    numbers = np.array(node["boundingVolume"]["box"])
    centre, half = numbers[:3] + transform[:3, 3], numbers[3:].reshape(3, 3).sum(axis=0)
    return centre - half, centre + half


def test_a_viewer_loads_the_mesh_at_its_position(city, tmp_path):
    path = tmp_path / "city.json"
    counts = city.export(path, 0.2, min_component_triangles=0, progress=False)
    tileset = json.loads(path.read_bytes())
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["geometricError"] == tileset["root"]["geometricError"] > 0
    lower, upper = bounds(tileset["root"], np.eye(4))
    corners, vertices = [], 0
    for leaf, transform in leaves_of(tileset["root"]):
        mesh = trimesh.load_mesh(tmp_path / leaf["content"]["uri"], process=False)
        world = mesh.vertices @ Z_UP.T + transform[:3, 3]
        vertices += len(world)
        corners.append(world[mesh.faces])
        for inner, outer in ((world, bounds(leaf, transform)), (world, (lower, upper))):
            assert (inner >= outer[0] - 1e-4).all()
            assert (inner <= outer[1] + 1e-4).all()
    found = np.concatenate(corners)
    assert counts == (vertices, len(found))
    mesh = city.mesh(0.2, min_component_triangles=0, progress=False)
    expected = np.asarray(mesh.vertices)[mesh.faces]
    assert len(found) == len(expected)
    order, expected_order = (np.lexsort(c.mean(axis=1).round(3).T) for c in (found, expected))
    gaps = np.abs(found[order].mean(axis=1) - expected[expected_order].mean(axis=1))
    assert np.quantile(gaps, 0.99) < 1e-4
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]).sum(axis=0) for c in (found, expected)]
    np.testing.assert_allclose(*normals, atol=0.01)  # turned, not mirrored


def test_small_components_are_removed_unless_they_reach_a_border(city, tmp_path):
    whole, most, none = (
        city.export(tmp_path / "city.json", 0.2, min_component_triangles=least, progress=False)[1]
        for least in (0, 40, 10**9)
    )
    mesh = city.mesh(0.2, min_component_triangles=40, progress=False)
    assert 0 < none <= len(mesh.faces) <= most < whole
    tileset = json.loads((tmp_path / "city.json").read_bytes())  # all remaining ones are at borders
    for leaf, transform in leaves_of(tileset["root"]):
        part = trimesh.load_mesh(tmp_path / leaf["content"]["uri"], process=False)
        world = (part.vertices @ Z_UP.T + transform[:3, 3])[:, :2] - city.plan.grid.corner_m
        away_m = np.abs(world - city.plan.tile_m * np.round(world / city.plan.tile_m)).min(axis=1)
        for component in trimesh.graph.connected_components(part.edges, nodes=np.arange(len(world))):
            assert away_m[component].min() < 1e-3


def test_an_existing_file_is_rejected_before_the_work(city, tmp_path):
    (tmp_path / "city").write_text("not a folder")
    with pytest.raises(FileExistsError):
        city.export(tmp_path / "city.json", 0.2, progress=False)
