"""Read and write meshes, in double precision if the format has it; read ground truth of any kind; GLB, the binary form of glTF 2.0."""

import json
import re
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from radarsdf.arrays import Array, Bytes, Floats, Mesh
from radarsdf.checks import AnyPath, check, path_of, positions, restating
from radarsdf.io.clouds import ply_bytes, ply_header, read_points, records
from radarsdf.io.files import check_fits_float32, check_regular_file, checked_suffix, write_whole
from radarsdf.io.npz import TRUTH_ARRAYS, arrays_of
from radarsdf.scans import Columns

MESH_SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb")
_FLOAT32_SUFFIXES = (".stl", ".glb")
_PLY_HEADER_BYTES = 1 << 16
_SAMPLES = 1_000_000  # enough points for triangles of a building, which may be 20 m long

_SRGB = np.arange(256) / 255
SRGB_TO_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
"""(256,) linear light of each 8-bit sRGB value."""

_ROUGH = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
MATT: dict[str, Any] = {"pbrMetallicRoughness": _ROUGH, "doubleSided": True}
"""Material that shows the colours of the vertices."""

T_GLTF_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""(4, 4) rotation that turns z up into y up, as glTF demands."""

_FLOAT, _UNSIGNED_INT = 5126, 5125


def holds_mesh(path: AnyPath) -> bool:
    """Whether a file is a mesh, by its suffix; for PLY, which may be a cloud too, by its header."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix != ".ply" or not file.is_file():
        return suffix in set(MESH_SUFFIXES) - {".ply"} and not file.is_dir()
    with file.open("rb") as opened:
        header = opened.read(_PLY_HEADER_BYTES).partition(b"end_header")[0]
    return re.search(rb"element\s+face\s+0*[1-9]", header) is not None


def write_mesh(path: AnyPath, mesh: Mesh) -> None:
    """Write a mesh atomically.

    PLY, OBJ and OFF keep float64 coordinates; STL and GLB hold float32. The root of a GLB turns y up, as glTF demands. Raises
    a ValueError for another suffix, if `path` is no regular file, or if float32 is too coarse: beyond 16 km from the origin;
    an OSError if the file cannot be written.

    Parameters
    ----------
    path : path-like
        A file that ends in .ply, .obj, .off, .stl or .glb.
    mesh : trimesh.Trimesh
        World frame, m. PLY keeps scalar vertex attributes, such as confidence, and colours.
    """
    suffix = checked_suffix(path, MESH_SUFFIXES, "meshes")
    if suffix in _FLOAT32_SUFFIXES:
        check_fits_float32(path, np.asarray(mesh.vertices, np.float64))
    own: dict[str, Callable[[Mesh], bytes]] = {".ply": _ply, ".glb": _glb}
    exported: Any = own[suffix](mesh) if suffix in own else mesh.export(file_type=suffix[1:])
    write_whole(path, exported.encode() if isinstance(exported, str) else exported)


def read_mesh(path: AnyPath) -> Mesh:
    """Read a triangle mesh, with all its vertices, unmerged, from a file that ends in .ply, .obj, .off, .stl or .glb.

    A scene of several parts becomes one mesh. GLB, whose y axis is up, is rotated to z up. Raises a ValueError if the file is
    damaged or holds no mesh, an OSError if it cannot be opened.
    """
    file = path_of(path, "path")
    check_regular_file(file)
    suffix = checked_suffix(file, MESH_SUFFIXES, "meshes")
    import trimesh  # noqa: PLC0415 - takes long

    ply = suffix == ".ply"
    # Damaged files raise exceptions of many kinds.
    with restating(f"{path} cannot be read as a mesh", Exception, unless=OSError):
        source: Any = ply_bytes(file) if ply else file
        mesh: Any = trimesh.load_mesh(source, file_type="ply" if ply else None, process=False)
        faces = mesh.faces
        whole = faces.ndim == 2 and (not len(faces) or 0 <= faces.min() <= faces.max() < len(mesh.vertices))
    check(whole, f"{path}: a triangle refers to a vertex that does not exist")
    if suffix == ".glb":
        mesh.apply_transform(T_GLTF_WORLD.T)
    return cast(Mesh, mesh)


def read_ground_truth(path: AnyPath) -> Floats:
    """Read points (M, 3), world, m, of a cloud or ``.npz`` file, or sample a mesh: the same file gives the same points."""
    file = Path(path)
    if holds_mesh(file):
        mesh = read_mesh(file)
        check(mesh.area > 0, f"{path} has no surface")
        # By area, in the order of the triangles, so that each large triangle gets points.
        samples: Any = mesh.sample(_SAMPLES, return_index=True, seed=0)
        return np.asarray(samples[0], np.float64)
    if file.suffix.lower() == ".npz":
        names = (*TRUTH_ARRAYS, "points")
        arrays = arrays_of(file, names)
        check(arrays, f"{path} has no ground truth: it lacks an array {' or '.join(names)}")
        name, points = next(iter(arrays.items()))
        return positions(points, f"{path}: {name}")
    return read_points(file)


def _scalars_and_colors(mesh: Mesh) -> tuple[Columns, Bytes | None]:
    """Scalar attributes (V,) float32 by name, and sRGB colours (V, 4), if there are any, of the vertices."""
    attributes, visual = mesh.vertex_attributes.items(), cast(Any, mesh.visual)
    scalars = {n: np.asarray(v, np.float32) for n, v in attributes if np.shape(v) == (len(mesh.vertices),)}
    has_colors = visual.kind == "vertex" and len(mesh.vertices)  # of none, trimesh returns (0, 5)
    return scalars, np.asarray(visual.vertex_colors, np.uint8) if has_colors else None


def _glb(mesh: Mesh) -> bytes:
    """Encode as GLB, without what its JSON cannot hold: attributes and metadata that are not finite."""
    scalars, colors = _scalars_and_colors(mesh)
    attributes = {f"_{name}": values for name, values in scalars.items() if np.isfinite(values).all()}
    if colors is not None:
        attributes["COLOR_0"] = SRGB_TO_LINEAR[colors[:, :3]]
    numbers = {n: v for n, v in mesh.metadata.items() if isinstance(v, (int, float)) and np.isfinite(v)}
    check(len(mesh.faces), "the mesh has no triangle: .glb cannot hold it")
    return encode_glb(mesh.vertices, mesh.faces, attributes, matrix=T_GLTF_WORLD, extras=numbers)


def _ply(mesh: Mesh) -> bytes:
    scalars, colors = _scalars_and_colors(mesh)
    columns = dict(zip("xyz", np.asarray(mesh.vertices, np.float64).T, strict=True)) | scalars
    if colors is not None:
        columns |= dict(zip(("red", "green", "blue", "alpha"), colors.T, strict=True))
    vertices = records(columns)
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("rows", "<i4", 3)])
    faces["count"], faces["rows"] = 3, mesh.faces
    header = ply_header(vertices.dtype, len(vertices), len(faces))
    return header + vertices.tobytes() + faces.tobytes()


def encode_glb(
    vertices: Array,
    faces: Array,
    attributes: Mapping[str, Array],
    *,
    material: Mapping[str, Any] = MATT,
    matrix: Floats | None = None,
    extras: Mapping[str, float] | None = None,
) -> bytes:
    """Encode a mesh of vertices (V, 3) and faces (F, 3). `attributes`: finite (V,) or (V, 3), linear colours as COLOR_0.

    `matrix`: (4, 4) transform of the mesh. `extras`: numbers kept with it. Vertices and attributes become float32.
    """
    of_vertices = {"POSITION": vertices, **attributes}
    parts = [np.ravel(faces).astype(np.uint32)]
    parts += [np.ascontiguousarray(values, np.float32) for values in of_vertices.values()]
    sizes = [part.nbytes for part in parts]
    accessors = [
        {
            "bufferView": number,
            "componentType": _FLOAT if number else _UNSIGNED_INT,
            "count": len(part),
            "type": "SCALAR" if part.ndim == 1 else "VEC3",
            "min": np.atleast_1d(part.min(axis=0)).tolist(),
            "max": np.atleast_1d(part.max(axis=0)).tolist(),
        }
        for number, part in enumerate(parts)
    ]
    views = [{"buffer": 0, "byteOffset": sum(sizes[:i]), "byteLength": n} for i, n in enumerate(sizes)]
    numbers = dict(zip(of_vertices, range(1, len(parts)), strict=True))
    primitive = {"attributes": numbers, "indices": 0, "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": np.ravel(np.eye(4) if matrix is None else matrix, "F").tolist()}],
        "meshes": [{"primitives": [primitive], "extras": extras or {}}],
        "materials": [material],
        "buffers": [{"byteLength": sum(sizes)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    if "extensions" in material:
        tree["extensionsUsed"] = list(material["extensions"])
    text = json.dumps(tree, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + sum(sizes))
    chunks = [struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", sum(sizes), b"BIN\0")]
    return b"".join([header, *chunks, *(part.tobytes() for part in parts)])
