# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mesh of a map in tiles as 3D Tiles 1.1, which viewers stream: a GLB file for each tile, and one JSON that says where.

Source: the Open Geospatial Consortium's "3D Tiles Specification", 22-025r4.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from radarsdf.interrupts import whole_import
from radarsdf.io.files import check_outputs, write_whole
from radarsdf.products import turned
from radarsdf.tiles.blend import TileBlend
from radarsdf.tiles.plan import Tile

with whole_import():
    import trimesh

# Viewers open a node when its error is larger than about 16 pixels: here, from nearer than about three of its edges.
_ERROR_OF_EDGE = 1 / 16
# glTF has y up and 3D Tiles z: a viewer turns each file by 90 degrees about x. This is the way back.
_GLTF_TILE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class _Node(NamedTuple):
    described: dict[str, Any]
    lower: NDArray[np.float64]
    """(3,) world, m."""
    upper: NDArray[np.float64]
    """(3,) world, m."""


def content_folder(path: Path) -> Path:
    """The folder of the GLB files of a ``NAME.json``. Raises an OSError if one of the two cannot be written."""
    check_outputs([path])
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    check_outputs([folder / "0_0.glb"])
    return folder


def write_tileset(
    city: TileBlend, path: Path, meshes: Iterable[tuple[NDArray[np.float64], NDArray[np.int32]]]
) -> tuple[int, int]:
    """Writes ``NAME.json`` and, in its :func:`content_folder`, a GLB file for each tile with triangles.

    `meshes`: vertices (V, 3), world, m, and faces (F, 3) of each tile. Coordinates in GLB files are float32 from the origin
    of the tile, and the JSON has that origin in float64: tiles far from the world's origin are as precise as others. Returns
    the numbers of vertices and triangles; vertices on borders are in both tiles.
    """
    folder = content_folder(path)
    leaves: dict[Tile, _Node] = {}
    num_vertices = num_faces = 0
    for planned, (vertices, faces) in zip(city.tiles, meshes, strict=True):
        if len(faces):
            name, origin = f"{planned.name}.glb", city.config.lattice.position(planned.origin_cells)
            write_whole(folder / name, _glb(vertices - origin, faces))
            leaves[planned.tile] = _leaf(vertices, origin, f"{folder.name}/{name}")
            num_vertices, num_faces = num_vertices + len(vertices), num_faces + len(faces)
    if not leaves:
        msg = "no tile has a triangle, so there is nothing to write"
        raise ValueError(msg)
    root = _root(leaves, city.plan.tile_m)
    # The JSON comes last: once it is there, all that it names is.
    described = {"asset": {"version": "1.1"}, "geometricError": root["geometricError"], "root": root}
    write_whole(path, json.dumps(described, allow_nan=False).encode())
    return num_vertices, num_faces


def _glb(local: NDArray[np.float64], faces: NDArray[np.int32]) -> bytes:
    of_trimesh: Any = trimesh.visual  # partly without types
    material = of_trimesh.material.PBRMaterial(
        baseColorFactor=[200, 200, 200, 255], metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    visual = of_trimesh.TextureVisuals(material=material)
    mesh = trimesh.Trimesh(turned(local, _GLTF_TILE), faces, visual=visual, process=False)
    data: Any = mesh.export(file_type="glb", include_normals=True)
    return bytes(data)


def _leaf(vertices: NDArray[np.float64], origin: NDArray[np.float64], uri: str) -> _Node:
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    T_world_tile = np.eye(4)
    T_world_tile[:3, 3] = origin
    described = {
        "boundingVolume": _box(lower - origin, upper - origin),
        "geometricError": 0.0,
        "content": {"uri": uri},
        "transform": T_world_tile.T.ravel().tolist(),  # column by column
    }
    return _Node(described, lower, upper)


def _root(leaves: dict[Tile, _Node], edge_m: float) -> dict[str, Any]:
    """The root of a tree in which each node has up to four below it, so that viewers need not look at all tiles."""
    first = np.min(list(leaves), axis=0)  # halved, numbers below zero would never meet those above
    nodes = {(i - int(first[0]), j - int(first[1])): leaf for (i, j), leaf in leaves.items()}
    while True:
        edge_m *= 2
        groups: dict[Tile, list[_Node]] = {}
        for (i, j), node in nodes.items():
            groups.setdefault((i // 2, j // 2), []).append(node)
        nodes = {number: _above(children, edge_m) for number, children in groups.items()}
        if len(nodes) == 1:
            return next(iter(nodes.values())).described


def _above(children: list[_Node], edge_m: float) -> _Node:
    lower = np.min([child.lower for child in children], axis=0)
    upper = np.max([child.upper for child in children], axis=0)
    described = {
        "boundingVolume": _box(lower, upper),
        "geometricError": edge_m * _ERROR_OF_EDGE,
        "refine": "ADD",
        "children": [child.described for child in children],
    }
    return _Node(described, lower, upper)


def _box(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> dict[str, Any]:
    half = np.maximum((upper - lower) / 2, 1e-3)  # a flat box has no inside
    return {"box": [*((lower + upper) / 2).tolist(), *np.diag(half).ravel().tolist()]}
