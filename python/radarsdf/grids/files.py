# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of grids: NPZ, PLY, and the binary tree of OctoMap."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.checks import path_of
from radarsdf.grids.octree import octree_bytes
from radarsdf.io.files import write_whole
from radarsdf.io.npz import write_arrays

if TYPE_CHECKING:
    from radarsdf.grids.costmap import Costmap
    from radarsdf.grids.distances import DistanceField
    from radarsdf.grids.grid import Grid


def check_grid_path(path: Path) -> None:
    """Raises a ValueError for a suffix that :meth:`Grid.save` does not know."""
    if path.suffix not in _WRITERS:
        msg = f"{path} must end in {', '.join(_WRITERS)}"
        raise ValueError(msg)


def save_grid(grid: Grid, path: str | PathLike[str]) -> None:
    """See :meth:`Grid.save`."""
    target = path_of(path, "path")
    check_grid_path(target)
    write_whole(target, _WRITERS[target.suffix](grid))


def check_arrays_path(path: Path | None) -> None:
    """Raises a ValueError for a path that :func:`save_arrays` does not take. None: there is none."""
    if path is not None and path.suffix != ".npz":
        msg = f"{path} must end in .npz"
        raise ValueError(msg)


def save_arrays(path: str | PathLike[str], grid: Grid, found: Costmap | DistanceField) -> None:
    """Writes what was found of a grid to an ``.npz``, by name, with the grid's `origin` and `voxel_size`."""
    target = path_of(path, "path")
    check_arrays_path(target)
    arrays: dict[str, ArrayLike] = {"origin": grid.origin, "voxel_size": grid.voxel_size}
    arrays |= {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
    write_arrays(target, arrays, compressed=True)


def _npz(grid: Grid) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        origin=grid.origin,
        voxel_size=grid.voxel_size,
        state=grid.state,
        probability=grid.probability,
        distance_m=grid.distance_m,
        position_error_m=grid.position_error_m,
    )
    return buffer.getvalue()


def _ply(grid: Grid) -> bytes:
    known = ~grid.unknown
    row = np.dtype(
        [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("probability", "<f4"), ("state", "i1")]
        + [(color, "u1") for color in ("red", "green", "blue")]
    )
    rows = np.zeros(int(known.sum()), row)
    rows["x"], rows["y"], rows["z"] = grid.centres(known).T
    rows["probability"], rows["state"] = grid.probability[known], grid.state[known]
    free = grid.state[known] == 0
    rows["red"], rows["green"], rows["blue"] = np.where(free, [[70], [150], [220]], [[220], [90], [40]])
    types = {"<f8": "double", "<f4": "float", "|i1": "char", "|u1": "uchar"}
    names = row.names or ()
    fields = "".join(f"property {types[row[name].str]} {name}\n" for name in names)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment centres of voxels of {grid.voxel_size:.9g} m; state 0: free, 1: occupied\n"
        f"element vertex {len(rows)}\n{fields}end_header\n"
    )
    return header.encode() + rows.tobytes()


_WRITERS: dict[str, Callable[[Grid], bytes]] = {".npz": _npz, ".ply": _ply, ".bt": octree_bytes}
