# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Named columns as the binary records of files, little-endian."""

from __future__ import annotations

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


def ply_header(dtype: np.dtype[Any], count: int) -> list[str]:
    """The first lines of a binary PLY file of `count` such records: up to the properties of its vertices."""
    lines = ["ply", "format binary_little_endian 1.0", "comment radarsdf: world frame, m"]
    lines += [f"element vertex {count}"]
    return lines + [f"property {_PLY_TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
