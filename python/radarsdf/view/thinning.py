# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Fewer points and triangles to look at, spread as evenly as all of them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from radarsdf.map.mesh import renumbered

if TYPE_CHECKING:
    import trimesh

_Floats = NDArray[np.float64]
_COARSER = 1.1  # a step towards fewer points


class Spread(NamedTuple):
    """Some of N points: one of each cube of a grid."""

    rows: NDArray[np.int64]
    """(M,) which they are: the nearest to the mean of the points of their cube."""
    of_point: NDArray[np.int64]
    """(N,) which of the M stands for each point."""
    edge_m: float
    """Of the cubes, m."""


def spread_evenly(points: _Floats, count: int, edge_m: float) -> Spread:
    """At most `count` of N points (N, 3), m. All of them, if there are no more.

    `edge_m`: distance of neighbouring points, where the search for the cubes begins.
    """
    everything = np.arange(len(points))
    if len(points) <= count:
        return Spread(everything, everything, edge_m)
    edge_m *= math.sqrt(len(points) / count)
    while True:
        cells = np.floor((points - points.min(axis=0)) / edge_m).astype(np.int64)
        shape = cells.max(axis=0) + 1
        keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
        _, of_point, counts = np.unique(keys, return_inverse=True, return_counts=True)
        if len(counts) <= count:
            break
        edge_m *= _COARSER
    means = np.stack([np.bincount(of_point, points[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    order = np.lexsort((np.linalg.norm(points - means[of_point], axis=1), of_point))
    return Spread(order[np.cumsum(counts) - counts], of_point, edge_m)


def thinned(mesh: trimesh.Trimesh, most_vertices: int, edge_m: float) -> tuple[trimesh.Trimesh, float]:
    """A mesh with at most so many vertices, and how far apart they are, m: `edge_m` if there are no more.

    Of the vertices in each cube of a grid one is kept, with its attributes. Triangles that become a line go.
    """
    import trimesh  # noqa: PLC0415 - slow

    vertices: Any = mesh.vertices
    spread = spread_evenly(np.asarray(vertices, np.float64), most_vertices, edge_m)
    if len(spread.rows) == len(vertices):
        return mesh, edge_m
    corners = spread.of_point[mesh.faces].astype(np.int32)
    a, b, c = corners.T
    used, faces = renumbered(len(spread.rows), corners[(a != b) & (b != c) & (c != a)])
    rows = spread.rows[used]
    thin = trimesh.Trimesh(vertices[rows], faces, process=False)
    thin.update_faces(thin.unique_faces())
    thin.metadata |= mesh.metadata
    for name, values in mesh.vertex_attributes.items():
        thin.vertex_attributes[name] = np.asarray(values)[rows]
    return thin, spread.edge_m
