# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One mesh from the pieces of tiles: welded by the edges of their lattice, small components left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from radarsdf.map.marching_cubes import mesh_components
from radarsdf.map.mesh import renumbered, with_all
from radarsdf.map.threshold import TALLY_NUMBERS, Tally
from radarsdf.tiles.pieces import Piece, tally_sums


class WeldedPart(NamedTuple):
    """What one piece adds to the mesh."""

    vertices: NDArray[np.float64]
    """(V, 3) world, m: those that no earlier piece has."""
    confidence: NDArray[np.float32]
    """(V,)"""
    uncertainty_m: NDArray[np.float32]
    """(V,)"""
    faces: NDArray[np.int64]
    """(F, 3) rows of the vertices of all parts."""


def tally_of(paths: Sequence[Path]) -> Tally:
    """Of all surface of pieces in these files."""
    return Tally.of_sums(sum((tally_sums(path) for path in paths), np.zeros(TALLY_NUMBERS)))


class WeldedMesh:
    """The mesh of pieces in files. Only what touches borders is held in memory.

    Parameters
    ----------
    paths : sequence of Path
        The pieces, in the order of their tiles.
    min_confidence : float or None
        Triangles with a vertex of less confidence are left out. None: that of the highest expected F-score of all pieces.
    min_component_triangles : int
        Components of fewer triangles are then left out, counted over all pieces.
    """

    def __init__(
        self, paths: Sequence[Path], min_confidence: float | None, min_component_triangles: int
    ) -> None:
        self._paths = paths
        self.threshold = tally_of(paths).threshold(min_confidence)
        self._kept = self._large(min_component_triangles)
        self.num_vertices = self.num_faces = 0
        self.cells = np.zeros(2, np.int64)
        edges = []
        own = []  # vertices of each piece that are used
        for i in range(len(paths)):
            piece, used, faces = self._used(i)
            rows = piece.border_rows[used[piece.border_rows]]
            edges.append(piece.border_edges[used[piece.border_rows]])
            own.append((int(used.sum()), (np.cumsum(used) - 1)[rows]))
            self.num_faces += len(faces)
            self.cells += piece.cells
        together = np.concatenate(edges) if edges else np.zeros((0, 4), np.int64)
        _, first, group = np.unique(together, axis=0, return_index=True, return_inverse=True)
        ends = np.cumsum([0, *[len(part) for part in edges]])
        number = np.zeros(len(together), np.int64)  # of each border vertex in the whole mesh
        self._borders: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], int]] = []
        for i, (count, rows) in enumerate(own):
            part = slice(ends[i], ends[i + 1])
            owner = first[group.ravel()[part]]
            is_new = owner == np.arange(part.start, part.stop)
            new = np.ones(count, bool)
            new[rows[~is_new]] = False
            numbers = np.cumsum(new) - 1 + self.num_vertices
            number[part] = np.where(is_new, numbers[rows], number[owner])
            self._borders.append((rows, number[part], new, self.num_vertices))
            self.num_vertices += int(new.sum())

    def parts(self) -> Iterator[WeldedPart]:
        """What each piece adds, one after another."""
        for i, (rows, numbers, new, before) in enumerate(self._borders):
            piece, used, faces = self._used(i)
            of_all = np.cumsum(new) - 1 + before
            of_all[rows] = numbers
            kept = np.flatnonzero(used)[new]
            yield WeldedPart(
                piece.vertices[kept], piece.confidence[kept], piece.uncertainty_m[kept], of_all[faces]
            )

    def pieces(self) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int32]]]:
        """Vertices (V, 3), world, m, and faces (F, 3) of each piece alone, with all vertices on its borders."""
        for i in range(len(self._paths)):
            piece, used, faces = self._used(i)
            yield piece.vertices[used], faces

    def _used(self, i: int) -> tuple[Piece, NDArray[np.bool_], NDArray[np.int32]]:
        """A piece, which of its vertices are used, and the faces as rows of these."""
        piece, faces, labels, _ = self._components(i)
        return piece, *renumbered(len(piece.vertices), faces[self._kept[i][labels]])

    def _components(self, i: int) -> tuple[Piece, NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """A piece, its triangles that are probable enough, to which component each belongs, and the sizes of those."""
        piece = Piece.load(self._paths[i])
        good = piece.confidence >= self.threshold.min_confidence
        faces = piece.faces[with_all(good, piece.faces)]
        return piece, faces, *mesh_components(faces, len(piece.vertices))

    def _large(self, min_triangles: int) -> list[NDArray[np.bool_]]:
        """Which of the components of each piece are kept. Those that meet at a border are one."""
        sizes, edges, of_vertex = [], [], []
        before = 0
        for i in range(len(self._paths)):
            piece, faces, labels, counts = self._components(i)
            label = np.full(len(piece.vertices), -1, np.int64)
            label[faces] = labels[:, None]
            used = label[piece.border_rows] >= 0
            sizes.append(counts)
            edges.append(piece.border_edges[used])
            of_vertex.append(label[piece.border_rows[used]] + before)
            before += len(counts)
        if before == 0:
            return [np.zeros(0, bool) for _ in sizes]
        _, first, group = np.unique(np.concatenate(edges), axis=0, return_index=True, return_inverse=True)
        component = np.concatenate(of_vertex)
        pairs = (component, component[first[group.ravel()]])
        links = coo_array((np.ones(len(component), bool), pairs), shape=(before, before))
        _, joined = connected_components(links, directed=False)
        totals = np.bincount(joined, np.concatenate(sizes))
        large = totals[joined] >= min_triangles
        return np.split(large, np.cumsum([len(counts) for counts in sizes])[:-1])
