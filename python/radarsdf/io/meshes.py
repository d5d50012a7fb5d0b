# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Meshes to files, in double precision where the format has it."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.files import write_whole

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb")
_FLOAT32_SUFFIXES = (".stl", ".glb")
_MAX_FLOAT32_M = 1000.0  # further from the origin, float32 resolves less than 0.06 mm
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def check_mesh_path(path: str | PathLike[str]) -> None:
    """Raises a ValueError unless `path` ends like a format that :func:`write_mesh` writes."""
    if Path(path).suffix.lower() not in MESH_SUFFIXES:
        msg = f"{path}: a mesh can be written as {', '.join(MESH_SUFFIXES)}"
        raise ValueError(msg)


def write_mesh(path: str | PathLike[str], mesh: trimesh.Trimesh) -> NDArray[np.float64] | None:
    """Writes a mesh whole or not at all.

    PLY, OBJ and OFF keep float64 coordinates. STL and GLB hold float32, which at UTM coordinates is a grid of half a
    metre. A mesh further than 1000 m from the world's origin is written to them in a local frame: the world axes, with
    an origin subtracted that is written beside the mesh, as ``NAME.origin.json``.

    Parameters
    ----------
    path : path-like
        One of `MESH_SUFFIXES`.
    mesh : trimesh.Trimesh
        World frame, m. PLY keeps its vertex attributes of one number a vertex, such as confidence, and its colours.

    Returns
    -------
    ndarray or None
        (3,) the origin that was subtracted, world, m; None where coordinates are the world's.

    Raises
    ------
    ValueError
        For another suffix, or if `path` is no regular file.
    OSError
        If it cannot be written.
    """
    check_mesh_path(path)
    suffix = Path(path).suffix.lower()
    vertices = np.asarray(mesh.vertices, np.float64)
    origin = None
    if suffix in _FLOAT32_SUFFIXES and np.abs(vertices).max(initial=0.0) > _MAX_FLOAT32_M:
        origin = np.round(vertices.mean(axis=0))
        mesh = mesh.copy()
        mesh.vertices = vertices - origin
    exported: Any = _ply(mesh) if suffix == ".ply" else mesh.export(file_type=suffix[1:])
    data: bytes = exported.encode() if isinstance(exported, str) else exported
    if origin is not None:
        described = {"origin": origin.tolist(), "unit": "m", "frame": "world = local + origin"}
        write_whole(origin_path(path), json.dumps(described).encode())
    write_whole(path, data)
    return origin


def origin_path(path: str | PathLike[str]) -> Path:
    """Where :func:`write_mesh` writes the origin of a local frame."""
    return Path(path).with_name(Path(path).name + ".origin.json")


def _ply(mesh: trimesh.Trimesh) -> bytes:
    """Binary, little-endian, vertices in double precision."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", np.asarray(mesh.vertices, np.float64).T, strict=True))
    for name, values in mesh.vertex_attributes.items():
        if np.shape(values) == (len(mesh.vertices),):
            columns[name] = np.asarray(values, np.float32)
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors, np.uint8)
        columns |= dict(zip(("red", "green", "blue", "alpha"), colors.T, strict=True))
    vertices = _records(columns, len(mesh.vertices))
    faces = np.zeros(len(mesh.faces), np.dtype([("count", "u1"), ("rows", "<i4", (3,))]))
    faces["count"], faces["rows"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", "comment radarsdf: world frame, m"]
    header += [f"element vertex {len(vertices)}"]
    header += [f"property {_PLY_TYPES[array.dtype.str[1:]]} {name}" for name, array in columns.items()]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    return ("\n".join(header) + "\n").encode("ascii") + vertices.tobytes() + faces.tobytes()


def _records(columns: dict[str, NDArray[Any]], count: int) -> NDArray[Any]:
    """One record a vertex."""
    records = np.zeros(
        count, np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in columns.items()])
    )
    for name, array in columns.items():
        records[name] = array
    return records
