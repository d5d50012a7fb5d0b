# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A grid as an octree in OctoMap's binary format, which its tools and planners read.

The file is a header of text and, from the root on, two bytes for each inner node: two bits for each of its eight
children, in the order of x, y, z with x first. 1: free, 2: occupied, 3: an inner node, which follows after those
before it; 0: unknown. The tree has 16 levels, of which the middle is at the origin of the world.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from radarsdf.grids.grid import Grid

_LEVELS = 16
_HALF = 1 << (_LEVELS - 1)  # voxels from the middle of the tree to its border
_MOST_OFF = 0.01  # voxels: rounding of the origin
_FREE, _OCCUPIED, _INNER = 1, 2, 3


def octree_bytes(grid: Grid) -> bytes:
    """The file.

    Raises
    ------
    ValueError
        If the grid's origin is not a multiple of its voxels, as that of :meth:`Map.grid` is, or if the grid reaches farther
        from the world's origin than the octree: 32,768 voxels.
    """
    start = np.round(grid.origin / grid.voxel_size)
    if np.abs(grid.origin / grid.voxel_size - start).max() > _MOST_OFF:
        msg = (
            f"the grid's origin, {grid.origin}, must be a multiple of its voxels of {grid.voxel_size:g} m, as OctoMap's are: "
            f"the nearest is {start * grid.voxel_size}"
        )
        raise ValueError(msg)
    known = np.argwhere(~grid.unknown)
    states = np.where(grid.state[~grid.unknown] == 1, _OCCUPIED, _FREE)
    keys = known + start.astype(np.int64) + _HALF
    if len(keys) and not ((keys >= 0).all() and (keys < 2 * _HALF).all()):
        msg = f"the grid is more than {_HALF} voxels from the world's origin, where OctoMap's octree ends"
        raise ValueError(msg)
    levels = _levels(keys, states)
    size = 1 + sum(len(codes) for _, codes in levels)  # nodes, the root and leaves included
    body = _depth_first(levels)
    header = (
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id OcTree\nsize {size if levels else 0}\nres {grid.voxel_size:.9g}\ndata\n"
    )
    return header.encode() + body


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
