# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""3D Tiles of a map in tiles, read as a viewer reads them."""

import json

import numpy as np
import pytest
import trimesh

Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # what a viewer does to glTF: y up becomes z up


def leaves_of(node, transform=None):
    """Leaves below a node with their transforms; each box must hold those below it."""
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


def test_a_viewer_finds_the_mesh_where_it_is(city, tmp_path):
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


def test_small_components_go_unless_they_reach_a_border(city, tmp_path):
    whole, most, none = (
        city.export(tmp_path / "city.json", 0.2, min_component_triangles=least, progress=False)[1]
        for least in (0, 40, 10**9)
    )
    mesh = city.mesh(0.2, min_component_triangles=40, progress=False)
    assert 0 < none <= len(mesh.faces) <= most < whole
    tileset = json.loads((tmp_path / "city.json").read_bytes())  # what is left is all at borders
    for leaf, transform in leaves_of(tileset["root"]):
        part = trimesh.load_mesh(tmp_path / leaf["content"]["uri"], process=False)
        world = (part.vertices @ Z_UP.T + transform[:3, 3])[:, :2] - city.plan.grid.corner_m
        away_m = np.abs(world - city.plan.tile_m * np.round(world / city.plan.tile_m)).min(axis=1)
        for component in trimesh.graph.connected_components(part.edges, nodes=np.arange(len(world))):
            assert away_m[component].min() < 1e-3


def test_a_file_in_the_way_is_refused_before_the_work(city, tmp_path):
    (tmp_path / "city").write_text("not a folder")
    with pytest.raises(FileExistsError):
        city.export(tmp_path / "city.json", 0.2, progress=False)
