# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of grids: arrays (NPZ), points (PLY), OctoMap's binary octree, and ROS's map_server (YAML and PGM)."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import path_of
from radarsdf.io.cloud_writing import ply_header, records
from radarsdf.io.files import check_outputs, write_whole
from radarsdf.io.npz import write_arrays

_PIXELS = {-1: 205, 0: 254, 1: 0}  # as map_saver writes unknown, free and occupied
_COLORS = np.array([[70, 150, 220], [220, 90, 40]], np.uint8)  # of free and occupied
_LEVELS = 16  # of OctoMap's octree
_HALF = 1 << (_LEVELS - 1)  # voxels from the middle of the tree to its border
_MOST_OFF = 0.01  # voxels: rounding of the origin
_FREE, _OCCUPIED, _INNER = 1, 2, 3


def check_grid_path(path: Path) -> None:
    """Raise a ValueError for a suffix that :meth:`Grid.save` does not write."""
    _check_suffix(path, ".npz", ".ply", ".bt")


def check_arrays_path(path: Path | None) -> None:
    """Raise a ValueError for a path that is not one of arrays. None: there is none."""
    if path is not None:
        _check_suffix(path, ".npz")


def check_flat_path(path: Path) -> None:
    """Raise a ValueError for a path that :meth:`FlatGrid.save` does not take."""
    _check_suffix(path, ".yaml")


def _check_suffix(path: Path, *suffixes: str) -> None:
    if path.suffix not in suffixes:
        msg = f"{path} must end in {', '.join(suffixes)}"
        raise ValueError(msg)


def write_grid(path: str | PathLike[str], arrays: dict[str, Any], points: NDArray[np.float64]) -> None:
    """Write the arrays of a :class:`Grid`, by the suffix. `points` (N, 3): centres of the voxels that are known, world, m."""
    target = path_of(path, "path")
    check_grid_path(target)
    state = arrays["state"]
    if target.suffix == ".npz":
        write_arrays(target, arrays, compressed=True)
    elif target.suffix == ".bt":
        write_whole(target, _octree(state, arrays["origin"], arrays["voxel_size"]))
    else:
        known = state[state >= 0].astype(np.uint8)
        colors = dict(zip(("red", "green", "blue"), _COLORS[known].T, strict=True))
        values = {"probability": arrays["probability"][state >= 0], "state": known}
        rows = records(dict(zip("xyz", points.T, strict=True)) | values | colors)
        comment = f"centres of voxels of {arrays['voxel_size']:.9g} m; state 0: free, 1: occupied"
        write_whole(target, ply_header(rows.dtype, len(rows), comment=comment) + rows.tobytes())


def write_map_server(
    path: str | PathLike[str], state: NDArray[np.int8], origin: NDArray[np.float64], cell_m: float
) -> None:
    """Write states (X, Y) from `origin` (2,), m, as ``NAME.yaml``, which is `path`, and ``NAME.pgm``."""
    target = path_of(path, "path")
    check_flat_path(target)
    image = target.with_suffix(".pgm")
    check_outputs([target, image])
    pixels = np.zeros(state.shape, np.uint8)
    for value, gray in _PIXELS.items():
        pixels[state == value] = gray
    rows = np.ascontiguousarray(pixels.T[::-1])  # the first row of an image is the last of y
    header = f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode()
    write_whole(image, header + rows.tobytes())
    quoted = image.name.replace("'", "''")
    text = (
        f"image: '{quoted}'\nmode: trinary\nresolution: {cell_m:.9g}\n"
        f"origin: [{origin[0]:.9f}, {origin[1]:.9f}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    write_whole(target, text.encode())


# OctoMap's binary format: a header of text and, from the root on, two bytes for each inner node: two bits for each of its
# eight children, in the order of x, y, z with x first. 1: free, 2: occupied, 3: an inner node, which follows after those
# before it; 0: unknown. The middle of the tree is at the origin of the world.


def _octree(state: NDArray[np.int8], origin: NDArray[np.float64], voxel_m: float) -> bytes:
    start = np.round(origin / voxel_m)
    if np.abs(origin / voxel_m - start).max() > _MOST_OFF:
        msg = (
            f"the grid's origin, {origin}, must be a multiple of its voxels of {voxel_m:g} m, as OctoMap's are: "
            f"the nearest is {start * voxel_m}"
        )
        raise ValueError(msg)
    known = state >= 0
    states = np.where(state[known] == 1, _OCCUPIED, _FREE)
    keys = np.argwhere(known) + start.astype(np.int64) + _HALF
    if len(keys) and not ((keys >= 0).all() and (keys < 2 * _HALF).all()):
        msg = f"the grid is more than {_HALF} voxels from the world's origin, where OctoMap's octree ends"
        raise ValueError(msg)
    levels = _levels(keys, states)
    size = 1 + sum(len(codes) for _, codes in levels)  # nodes, the root and leaves included
    header = (
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id OcTree\nsize {size if levels else 0}\nres {voxel_m:.9g}\ndata\n"
    )
    return header.encode() + _depth_first(levels)


def _levels(
    keys: NDArray[np.int64], states: NDArray[np.int64]
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """From the root's children down: Morton numbers of the nodes of each level, ascending, and their codes.

    Eight children that are all occupied, or all free, become a leaf of their parent.
    """
    if len(keys) == 0:
        return []
    codes = np.zeros(len(keys), np.int64)
    for bit in range(_LEVELS):
        for axis in range(3):
            codes |= (keys[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.argsort(codes)
    numbers, values = codes[order], states[order]
    found = []
    for _ in range(_LEVELS):
        parents, starts, counts = np.unique(numbers >> 3, return_index=True, return_counts=True)
        low = np.minimum.reduceat(values, starts)
        same = (counts == 8) & (low == np.maximum.reduceat(values, starts)) & (low != _INNER)
        kept = ~np.repeat(same, counts)
        found.append((numbers[kept], values[kept]))
        numbers, values = parents, np.where(same, low, _INNER)
    return found[::-1]


def _depth_first(levels: list[tuple[NDArray[np.int64], NDArray[np.int64]]]) -> bytes:
    """Two bytes for each inner node, in depth-first order."""
    if not levels:
        return b""
    numbers, words = [], []
    for level, (children, values) in enumerate(levels):
        parents, where = np.unique(children >> 3, return_inverse=True)
        word = np.zeros(len(parents), np.int64)
        np.bitwise_or.at(word, where, values << (2 * (children & 7)))
        # An inner node comes before what is in it: by the number of its first voxel, and the larger one first.
        numbers.append(np.stack([parents << (3 * (_LEVELS - level)), np.full(len(parents), level)], 1))
        words.append(word)
    order = np.lexsort(np.concatenate(numbers).T[::-1])
    return np.concatenate(words)[order].astype("<u2").tobytes()
