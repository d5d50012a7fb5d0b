# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Named columns and triangles as the binary records of files, little-endian."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[Any]]
"""(N,) each, by name."""

_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def records(columns: Columns) -> NDArray[Any]:
    """(N,) one record for each row of the columns, which are not none."""
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
    lines += [f"property {_PLY_TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    if num_faces is not None:
        lines += [f"element face {num_faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def without_ply_comments(data: bytes) -> bytes:
    """A PLY file without the comments of its header, which may be in any encoding."""
    head, end, body = data.partition(b"end_header")
    return re.sub(rb"(?<=[\r\n])(comment|obj_info)\b[^\r\n]*[\r\n]+", b"", head) + end + body
