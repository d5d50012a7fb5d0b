"""Mesh of a tiled map as 3D Tiles 1.1 (Open Geospatial Consortium, 22-025r4): a GLB file per tile, and a JSON file."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import trimesh

from radarsdf.arrays import Floats, Ints32
from radarsdf.checks import check
from radarsdf.io.files import check_outputs, write_whole
from radarsdf.io.glb import MATT, T_GLTF_WORLD, encode_glb
from radarsdf.tiles.blend import TileBlend

# Viewers open a node when its error exceeds about 16 pixels: here, at less than about three times its edge.
_ERROR_OF_EDGE = 1 / 16
_GREY = MATT["pbrMetallicRoughness"] | {"baseColorFactor": [0.784, 0.784, 0.784, 1.0]}


def content_folder(path: Path) -> Path:
    """Folder of the GLB files of ``NAME.json``. Raises an OSError if one of the two cannot be written."""
    check_outputs([path])
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    check_outputs([folder / "0_0.glb"])
    return folder


def write_tileset(city: TileBlend, path: Path, meshes: Iterable[tuple[Floats, Ints32]]) -> tuple[int, int]:
    """Write ``NAME.json`` and a GLB file per tile with triangles. Returns the numbers of vertices and triangles.

    `meshes`: vertices (V, 3), world, m, and faces (F, 3) of each tile. GLB files hold float32 relative to the origin of the
    tile, which is float64 in the JSON: precision does not depend on the distance from the world's origin.
    """
    folder = content_folder(path)
    children, corners, count = [], [], np.zeros(2, np.int64)
    for planned, (vertices, faces) in zip(city.tiles, meshes, strict=True):
        if len(faces) == 0:
            continue
        name, origin = f"{planned.name}.glb", city.config.lattice.position(planned.origin_cells)
        local = vertices - origin
        normals = {"NORMAL": trimesh.Trimesh(local, faces, process=False).vertex_normals}
        # Viewers turn y up into z up, which 3D Tiles have.
        material = MATT | {"pbrMetallicRoughness": _GREY}
        data = encode_glb(local, faces, normals, material=material, matrix=T_GLTF_WORLD)
        write_whole(folder / name, data)
        T_world_tile = np.eye(4)
        T_world_tile[:3, 3] = origin
        child = {
            "boundingVolume": _box(local),
            "geometricError": 0.0,
            "content": {"uri": quote(f"{folder.name}/{name}")},
            "transform": T_world_tile.T.ravel().tolist(),  # column-major
        }
        children.append(child)
        corners += [vertices.min(axis=0), vertices.max(axis=0)]
        count += len(vertices), len(faces)
    check(children, "no tile has a triangle, so there is nothing to write")
    error_m = float(np.ptp(corners, axis=0).max()) * _ERROR_OF_EDGE
    root = {"boundingVolume": _box(np.array(corners)), "geometricError": error_m}
    root |= {"refine": "ADD", "children": children}
    # The JSON is last, so that all files it names exist.
    described = {"asset": {"version": "1.1"}, "geometricError": error_m, "root": root}
    write_whole(path, json.dumps(described, allow_nan=False).encode())
    num_vertices, num_faces = count.tolist()
    return num_vertices, num_faces


def _box(points: Floats) -> dict[str, Any]:
    lower, upper = points.min(axis=0), points.max(axis=0)
    half = np.maximum((upper - lower) / 2, 1e-3)  # a flat box would have no volume
    return {"box": [*((lower + upper) / 2).tolist(), *np.diag(half).ravel().tolist()]}
