# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mesh of a map in tiles as 3D Tiles 1.1 (Open Geospatial Consortium, 22-025r4): a GLB file a tile, and a JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from radarsdf.io.files import check_outputs, write_whole
from radarsdf.products import turned
from radarsdf.tiles.blend import TileBlend

# Viewers open a node when its error is larger than about 16 pixels: here, from nearer than about three of its edges.
_ERROR_OF_EDGE = 1 / 16
# glTF has y up and 3D Tiles z: a viewer turns each file by 90 degrees about x. This is the way back.
_GLTF_TILE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


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
    """Writes ``NAME.json`` and a GLB file for each tile with triangles. Returns the numbers of vertices and triangles.

    `meshes`: vertices (V, 3), world, m, and faces (F, 3) of each tile. GLB files have float32 from the origin of the tile,
    which the JSON has in float64: tiles far from the world's origin are as precise as others.
    """
    folder = content_folder(path)
    children, corners, count = [], [], np.zeros(2, np.int64)
    for planned, (vertices, faces) in zip(city.tiles, meshes, strict=True):
        if len(faces) == 0:
            continue
        name, origin = f"{planned.name}.glb", city.config.lattice.position(planned.origin_cells)
        local = vertices - origin
        write_whole(folder / name, _glb(local, faces))
        T_world_tile = np.eye(4)
        T_world_tile[:3, 3] = origin
        children.append(
            {
                "boundingVolume": _box(local),
                "geometricError": 0.0,
                "content": {"uri": f"{folder.name}/{name}"},
                "transform": T_world_tile.T.ravel().tolist(),  # column by column
            }
        )
        corners += [vertices.min(axis=0), vertices.max(axis=0)]
        count += len(vertices), len(faces)
    if not children:
        msg = "no tile has a triangle, so there is nothing to write"
        raise ValueError(msg)
    error_m = float(np.ptp(corners, axis=0).max()) * _ERROR_OF_EDGE
    root = {
        "boundingVolume": _box(np.array(corners)),
        "geometricError": error_m,
        "refine": "ADD",
        "children": children,
    }
    # The JSON comes last: once it is there, all that it names is.
    described = {"asset": {"version": "1.1"}, "geometricError": error_m, "root": root}
    write_whole(path, json.dumps(described, allow_nan=False).encode())
    num_vertices, num_faces = count.tolist()
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


def _box(points: NDArray[np.float64]) -> dict[str, Any]:
    lower, upper = points.min(axis=0), points.max(axis=0)
    half = np.maximum((upper - lower) / 2, 1e-3)  # a flat box has no inside
    return {"box": [*((lower + upper) / 2).tolist(), *np.diag(half).ravel().tolist()]}
