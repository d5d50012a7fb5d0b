# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""PLY files, and named columns and triangles as little-endian binary records."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.interrupts import whole_import

Columns = dict[str, NDArray[Any]]
"""(N,) each, by name."""

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
_FACES = re.compile(rb"element\s+face\s+0*[1-9]")
_HEADER_BYTES = 1 << 16


def records(columns: Columns) -> NDArray[Any]:
    """(N,) one record for each row of the columns, of which there is at least one."""
    dtype = np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in columns.items()])
    rows = np.zeros(len(next(iter(columns.values()))), dtype)
    for name, array in columns.items():
        rows[name] = array
    return rows


def face_records(faces: NDArray[np.integer[Any]]) -> NDArray[Any]:
    """(T,) one record for each triangle (T, 3), as in a binary PLY file."""
    rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("rows", "<i4", (3,))]))
    rows["count"], rows["rows"] = 3, faces
    return rows


def ply_header(
    dtype: np.dtype[Any], count: int, num_faces: int | None = None, comment: str | None = None
) -> bytes:
    """The header of a binary PLY file of `count` such records, and of triangles if it is a mesh."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [] if comment is None else [f"comment {comment}"]
    lines += ["comment radarsdf: world frame, m", f"element vertex {count}"]
    lines += [f"property {_TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    if num_faces is not None:
        lines += [f"element face {num_faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def ply_bytes(path: Path) -> io.BytesIO:
    """A PLY file for trimesh, without the comments of its header, which may be in any encoding."""
    head, end, body = path.read_bytes().partition(b"end_header")
    return io.BytesIO(re.sub(rb"(?<=[\r\n])(comment|obj_info)\b[^\r\n]*[\r\n]+", b"", head) + end + body)


def has_faces(path: Path) -> bool:
    """Whether a PLY file is a mesh, by its header."""
    with path.open("rb") as file:
        return _FACES.search(file.read(_HEADER_BYTES).partition(b"end_header")[0]) is not None


def read_ply(path: Path) -> Columns:
    """The columns of the vertices of a PLY file."""
    with whole_import():
        import trimesh  # noqa: PLC0415 - takes long, and few files need it

    # Without materials: a PLY file may name an image, which is then not looked for.
    loaded: Any = trimesh.load(ply_bytes(path), file_type="ply", process=False, skip_materials=True)
    vertex = loaded.metadata.get("_ply_raw", {}).get("vertex")
    if vertex is None or not vertex["length"]:
        return {axis: np.zeros(0) for axis in "xyz"}
    data = vertex["data"]
    names = data.keys() if isinstance(data, dict) else data.dtype.names
    columns = {str(name): np.asarray(data[name]).reshape(-1) for name in names}
    if any(len(column) != vertex["length"] for column in columns.values()):
        msg = f"its header says {vertex['length']} points, which it does not hold"
        raise ValueError(msg)
    return columns
