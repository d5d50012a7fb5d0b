# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The triangles of a map that grows, cut region by region: those of regions that did not change are kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from radarsdf.config.fit_config import FitConfig
from radarsdf.live.regions import REGION_CELLS, RegionTable, regions_round
from radarsdf.live.rows import Keys
from radarsdf.map import queries
from radarsdf.map.contents import WholeMap
from radarsdf.map.marching_cubes import extract_cells, sparse_lattice
from radarsdf.map.mesh import Surface, local
from radarsdf.map.threshold import areas_round
from radarsdf.returns.evidence import BLOCK_BITS, Evidence, Looks
from radarsdf.returns.sums import lattice_of

_ON_BORDER = 1e-4  # leaf cells: vertices are at least 1e-3 from the corners of their edges


@dataclass(frozen=True)
class Triangles:
    """All triangles of the surface with what decides which of them are kept."""

    scene: WholeMap
    surface: Surface
    leaf_cells: int
    """Number of leaf cells near the surface."""

    @property
    def told(self) -> tuple[float, float]:
        """The numbers that all returns give."""
        return self.scene.rough_share, self.scene.returns_per_cell


@dataclass(frozen=True)
class _Piece:
    vertices: NDArray[np.float64]  # (V, 3) local, m
    faces: NDArray[np.int32]  # (F, 3)
    evidence: torch.Tensor  # (V, 3) as of queries.EvidenceAt
    areas_m2: NDArray[np.float64]  # (V,) of the triangles here round each vertex
    border: NDArray[np.int64]  # (B,) rows of vertices that another region may have, too

    @property
    def num_bytes(self) -> int:
        held = (self.vertices, self.faces, self.evidence, self.areas_m2, self.border)
        return sum(array.nbytes for array in held)


class GrowingTriangles:
    """Pieces by their regions. `origin` (3,): of the local frame, world, m."""

    def __init__(self, config: FitConfig, origin: NDArray[np.float64]) -> None:
        self._config, self._origin = config, origin
        self._pieces: dict[int, _Piece] = {}
        self._joined: Triangles | None = None
        self.num_bytes = 0
        """Memory of the pieces, bytes."""

    def cut(self, regions: Keys, surface: RegionTable, looks: RegionTable, num_threads: int) -> None:
        """Makes the pieces of `regions` (R,), ascending, anew.

        `surface` and `looks`: the tables of :class:`radarsdf.live.surface.GrowingSurface`.
        """
        if len(regions) == 0:
            return
        self._joined = None
        cut = {int(region): self._cut(surface, region, num_threads) for region in regions}
        for region in cut:
            if region in self._pieces:
                self.num_bytes -= self._pieces.pop(region).num_bytes
        found = {region: piece for region, piece in cut.items() if len(piece[1])}
        if not found:
            return
        around = regions_round(np.array(list(found), np.uint64), 1)
        cells, blocks = surface.gather(around), looks.gather(around)
        of_cells = Looks(blocks["keys"] >> BLOCK_BITS, blocks["scans"]).at(cells["keys"])
        evidence = Evidence(cells["information"], cells["detections"], of_cells)
        scene = WholeMap(self._origin, self._config, 0.0, 0.0)
        # By way of the world's coordinates, as those who query the mesh's own vertices do.
        world = np.concatenate([vertices for vertices, _ in found.values()]) + self._origin
        at = queries.interpolated(evidence, cells["keys"], self._config.leaf_size_m, local(scene, world))
        parts = torch.split(torch.stack(list(at), 1), [len(vertices) for vertices, _ in found.values()])
        for (region, (vertices, faces)), part in zip(found.items(), parts, strict=True):
            areas_m2, border = areas_round(vertices, faces), self._border(vertices)
            piece = self._pieces[region] = _Piece(vertices, faces, part.clone(), areas_m2, border)
            self.num_bytes += piece.num_bytes

    def joined(self, rough_share: float, returns_per_cell: float, leaf_cells: int) -> Triangles:
        """All triangles, those of neighbours with common vertices. The first two numbers: see :class:`WholeMap`."""
        told = rough_share, returns_per_cell
        if self._joined is not None and self._joined.told == told:
            return self._joined
        pieces = [self._pieces[region] for region in sorted(self._pieces)]
        starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
        vertices = np.concatenate([np.zeros((0, 3)), *(piece.vertices for piece in pieces)])
        faces = [piece.faces + np.int32(start) for piece, start in zip(pieces, starts, strict=False)]
        border = [piece.border + start for piece, start in zip(pieces, starts, strict=False)]
        rows = np.concatenate([np.zeros(0, np.int64), *border])
        # What two regions make of an edge of the lattice has the same bits.
        bits = np.ascontiguousarray(vertices[rows]).view([("", np.uint64)] * 3)[:, 0]
        _, first, which = np.unique(bits, return_index=True, return_inverse=True)
        one = np.arange(len(vertices), dtype=np.int32)
        one[rows] = rows[first][which]
        areas_m2 = np.concatenate([np.zeros(0), *(piece.areas_m2 for piece in pieces)])
        evidence = torch.cat([torch.zeros((0, 3)), *(piece.evidence for piece in pieces)])
        scene = WholeMap(self._origin, self._config, *told)
        surface = Surface.told_by(
            scene,
            vertices,
            one[np.concatenate([np.zeros((0, 3), np.int32), *faces])],
            queries.EvidenceAt(*evidence.unbind(1)),
            leaf_cells,
            np.bincount(one, areas_m2, len(vertices)).astype(np.float64),
        )
        self._joined = Triangles(scene, surface, leaf_cells)
        return self._joined

    def _cut(
        self, surface: RegionTable, region: np.uint64, num_threads: int
    ) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Vertices and faces in one region."""
        rows = surface.gather(np.array([region]))
        crossed = rows["crossed"]
        cells = lattice_of(rows["keys"][crossed]).astype(np.int32)
        order = np.lexsort(cells.T[::-1])  # as of a sparse lattice
        _, corners, of_cells = sparse_lattice(cells, num_threads=num_threads)
        values = np.zeros(len(corners), np.float32)
        values[of_cells] = rows["values"][crossed][order]
        vertices, faces = extract_cells(
            corners, values, of_cells, spacing=[self._config.leaf_size_m] * 3, num_threads=num_threads
        )
        return vertices + 0.0, faces  # -0.0 has other bits than 0.0

    def _border(self, vertices: NDArray[np.float64]) -> NDArray[np.int64]:
        places = vertices / (REGION_CELLS * self._config.leaf_size_m)
        away = np.abs(places - np.round(places)).min(axis=1)
        return np.flatnonzero(away < _ON_BORDER / REGION_CELLS)
