# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Meshes in files, in double precision where the format has it, and ground truth from files of any kind."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import path_of, positions
from radarsdf.interrupts import whole_import
from radarsdf.io.cloud_writing import face_records, ply_header, records
from radarsdf.io.clouds import CLOUD_SUFFIXES, has_faces, ply_bytes, read_points
from radarsdf.io.files import check_regular_file, origin_for, origin_of, write_origin, write_whole
from radarsdf.io.npz import arrays_of
from radarsdf.io.scans import Columns

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb")
_FLOAT32_SUFFIXES = (".stl", ".glb")
_T_GLTF_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # z up becomes y up
_TRUTH_ARRAYS = ("lidar_points", "points", "xyz", "arr_0")  # of which the first that a file has counts
_SAMPLES = 1_000_000  # on a surface: a triangle of a building may be 20 m long


def holds_mesh(path: str | PathLike[str]) -> bool:
    """Whether a file is a mesh, by its ending; of PLY, which may be a cloud too, by its header."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix == ".ply":
        return file.is_file() and has_faces(file)
    return suffix in MESH_SUFFIXES and not file.is_dir()


def check_mesh_path(path: str | PathLike[str]) -> None:
    """Raises a ValueError unless `path` ends like a format that :func:`write_mesh` writes."""
    if path_of(path, "path").suffix.lower() not in MESH_SUFFIXES:
        msg = f"{path}: a mesh can be written as {', '.join(MESH_SUFFIXES)}"
        raise ValueError(msg)


def write_mesh(path: str | PathLike[str], mesh: trimesh.Trimesh) -> NDArray[np.float64] | None:
    """Writes a mesh whole or not at all.

    PLY, OBJ and OFF keep float64 coordinates. STL and GLB hold float32, which at UTM coordinates is a grid of half a
    metre. A mesh further than 1000 m from the world's origin is written to them in a local frame: the world axes, with
    an origin subtracted that is written beside the mesh, as ``NAME.origin.json``. GLB has its y axis up, as glTF demands,
    by a rotation of its root.

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
    origin = origin_for(vertices) if suffix in _FLOAT32_SUFFIXES else None
    with whole_import():
        import trimesh  # noqa: PLC0415 - takes long
    if origin is not None:
        mesh = mesh.copy()
        mesh.vertices = vertices - origin
    if suffix == ".glb":
        scene: Any = trimesh.Scene()
        scene.add_geometry(mesh, transform=_T_GLTF_WORLD)
        exported: Any = scene.export(file_type="glb")
    else:
        exported = _ply(mesh) if suffix == ".ply" else mesh.export(file_type=suffix[1:])
    data: bytes = exported.encode() if isinstance(exported, str) else exported
    if suffix in _FLOAT32_SUFFIXES:
        write_origin(path, origin)
    write_whole(path, data)
    return origin


def read_mesh(path: str | PathLike[str]) -> trimesh.Trimesh:
    """Reads a triangle mesh.

    Parameters
    ----------
    path : path-like
        One of `MESH_SUFFIXES`. If :func:`write_mesh` wrote an origin beside it, that is added. GLB, whose y axis is up, is
        turned to z up.

    Returns
    -------
    trimesh.Trimesh
        The mesh with all its vertices: none are merged. A scene of several parts is one mesh.

    Raises
    ------
    ValueError
        If the file is damaged, or holds no mesh.
    OSError
        If it cannot be opened.
    """
    file = path_of(path, "path")
    check_regular_file(file)
    if file.suffix.lower() not in MESH_SUFFIXES:
        msg = f"{path} is no mesh that can be read: those end in {', '.join(MESH_SUFFIXES)}"
        raise ValueError(msg)
    with whole_import():
        import trimesh  # noqa: PLC0415 - takes long
    ply = file.suffix.lower() == ".ply"
    try:
        source: Any = ply_bytes(file) if ply else file
        mesh: Any = trimesh.load_mesh(source, file_type="ply" if ply else None, process=False)
    except OSError:
        raise
    except Exception as error:  # damaged files raise exceptions of many kinds
        msg = f"{path} cannot be read as a mesh: {error}"
        raise ValueError(msg) from error
    faces: Any = mesh.faces if isinstance(mesh, trimesh.Trimesh) else None
    if np.ndim(faces) != 2 or (len(faces) and not 0 <= faces.min() <= faces.max() < len(mesh.vertices)):
        msg = f"{path} is not one mesh, or a triangle has a corner that is none of its vertices"
        raise ValueError(msg)
    if file.suffix.lower() == ".glb":
        mesh.apply_transform(_T_GLTF_WORLD.T)
    if (origin := origin_of(file)) is not None:
        mesh.vertices = np.asarray(mesh.vertices, np.float64) + origin
    read: trimesh.Trimesh = mesh
    return read


def read_ground_truth(path: str | PathLike[str]) -> NDArray[np.float64]:
    """Reads points of a lidar, or draws points evenly on the triangles of a surface.

    Parameters
    ----------
    path : path-like
        A file for :func:`read_points`; ``.npz`` with an array (M, 3) of one of the names lidar_points, points, xyz and
        arr_0; or a mesh, in PLY, OBJ, OFF, STL or GLB.

    Returns
    -------
    ndarray
        (M, 3) float64, world frame, m. The same file gives the same points.

    Raises
    ------
    ValueError
        If the file is damaged, of another kind, or holds no points.
    OSError
        If it cannot be read.
    ImportError
        If it takes a library that is not installed; the message says which.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if holds_mesh(file):
        mesh = read_mesh(file)
        if not mesh.area > 0:  # NaN too
            msg = f"{path} has no surface"
            raise ValueError(msg)
        # By area, in the order of the triangles: a triangle has points wherever it is large.
        samples: Any = mesh.sample(_SAMPLES, return_index=True, seed=0)
        return np.asarray(samples[0], np.float64)
    if suffix == ".npz":
        arrays = arrays_of(file, _TRUTH_ARRAYS)
        if not arrays:
            msg = f"{path} has no ground truth: it lacks an array {' or '.join(_TRUTH_ARRAYS)}"
            raise ValueError(msg)
        name, points = next(iter(arrays.items()))
        return positions(points, f"{path}: {name}")
    if suffix not in CLOUD_SUFFIXES:
        kinds = dict.fromkeys((*CLOUD_SUFFIXES, ".npz", *MESH_SUFFIXES))
        msg = f"{path} is no ground truth: that is a file that ends in {', '.join(kinds)}"
        raise ValueError(msg)
    return read_points(file)


def _ply(mesh: trimesh.Trimesh) -> bytes:
    """Binary, little-endian, vertices in double precision."""
    columns: Columns = dict(zip("xyz", np.asarray(mesh.vertices, np.float64).T, strict=True))
    for name, values in mesh.vertex_attributes.items():
        if np.shape(values) == (len(mesh.vertices),):
            columns[name] = np.asarray(values, np.float32)
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors, np.uint8)
        columns |= dict(zip(("red", "green", "blue", "alpha"), colors.T, strict=True))
    vertices = records(columns)
    header = ply_header(vertices.dtype, len(vertices), len(mesh.faces))
    return header + vertices.tobytes() + face_records(mesh.faces).tobytes()
