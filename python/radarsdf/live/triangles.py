# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The triangles of a map that grows, cut region by region: those of regions that did not change are kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from radarsdf.config.fit_config import FitConfig
from radarsdf.live.regions import REGION_CELLS, Keys, RegionTable, regions_near
from radarsdf.map import queries
from radarsdf.map.contents import WholeMap
from radarsdf.map.marching_cubes import extract_cells, sparse_lattice
from radarsdf.map.mesh import Surface, local, one_for_equal
from radarsdf.returns.evidence import BLOCK_BITS, Evidence, Looks
from radarsdf.returns.sums import lattice_of

_ON_BORDER = 1e-4  # leaf cells: vertices are at least 1e-3 from the corners of their edges


@dataclass(frozen=True)
class _Part:
    vertices: NDArray[np.float64]  # (V, 3) local, m
    faces: NDArray[np.int32]  # (F, 3)
    evidence: torch.Tensor  # (V, 3) as of queries.EvidenceAt

    @property
    def num_bytes(self) -> int:
        return self.vertices.nbytes + self.faces.nbytes + self.evidence.nbytes


class GrowingTriangles:
    """Parts by their regions. `origin` (3,): of the local frame, world, m."""

    def __init__(self, config: FitConfig, origin: NDArray[np.float64]) -> None:
        self._config, self._origin = config, origin
        self._parts: dict[int, _Part] = {}
        self.num_bytes = 0  # of the parts

    def cut(self, regions: Keys, surface: RegionTable, visibility: RegionTable, num_threads: int) -> None:
        """Cuts `regions` (R,), ascending, again, from the tables of distances and of visibility counts."""
        if len(regions) == 0:
            return
        found = {}
        for region in regions:
            if int(region) in self._parts:
                self.num_bytes -= self._parts.pop(int(region)).num_bytes
            vertices, faces = self._cut(surface, region, num_threads)
            if len(faces):
                found[int(region)] = vertices, faces
        if not found:
            return
        around = regions_near(np.array(list(found), np.uint64), 1)
        cells, blocks = surface.gather(around), visibility.gather(around)
        of_cells = Looks(blocks["keys"] >> BLOCK_BITS, blocks["scans"]).at(cells["keys"])
        evidence = Evidence(cells["information"], cells["detections"], of_cells)
        scene = WholeMap(self._origin, self._config, 0.0, 0.0)
        # By way of the world's coordinates, as those who query the mesh's own vertices do.
        world = np.concatenate([vertices for vertices, _ in found.values()]) + self._origin
        at = queries.interpolated(evidence, cells["keys"], self._config.leaf_size_m, local(scene, world))
        split = torch.split(torch.stack(list(at), 1), [len(vertices) for vertices, _ in found.values()])
        for (region, (vertices, faces)), own in zip(found.items(), split, strict=True):
            part = self._parts[region] = _Part(vertices, faces, own.clone())
            self.num_bytes += part.num_bytes

    def joined(
        self, clutter_ratio: float, returns_per_cell: float, leaf_cells: int
    ) -> tuple[WholeMap, Surface]:
        """All triangles, those of neighbours with common vertices. The first two numbers: see :class:`WholeMap`."""
        scene = WholeMap(self._origin, self._config, clutter_ratio, returns_per_cell)
        parts = [self._parts[region] for region in sorted(self._parts)]
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        vertices = np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)])
        faces = [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)]
        # What two regions make of an edge of the lattice has the same bits.
        places = vertices / (REGION_CELLS * self._config.leaf_size_m)
        on_border = np.abs(places - np.round(places)).min(axis=1, initial=1.0) < _ON_BORDER / REGION_CELLS
        one = one_for_equal(vertices, np.flatnonzero(on_border))
        evidence = torch.cat([torch.zeros((0, 3)), *(part.evidence for part in parts)])
        return scene, Surface.told_by(
            scene,
            vertices,
            one[np.concatenate([np.zeros((0, 3), np.int32), *faces])],
            queries.EvidenceAt(*evidence.unbind(1)),
            leaf_cells,
        )

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
