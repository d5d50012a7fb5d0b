# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Extracts the mesh of a map, with confidence, uncertainty and intensity at its vertices."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import MAX_POSITION_M, check_box, number, positive, real_array, whole_number
from radarsdf.interrupts import whole_import
from radarsdf.map import queries
from radarsdf.map.colors import intensity_colors
from radarsdf.map.contents import MapContents, WholeMap
from radarsdf.map.isosurface import extract_cells, mesh_components
from radarsdf.map.threshold import Tally, Threshold, areas_round
from radarsdf.map.voxels import sample_lattice
from radarsdf.returns.intensities import IntensityScale

with whole_import():
    import trimesh

if TYPE_CHECKING:
    from radarsdf.map.map import Map


class TriangleLimits(NamedTuple):
    """What a mesh leaves out triangle by triangle, whatever the rest of the surface is: a tile asks this alone."""

    max_uncertainty: float = math.inf
    """Of each vertex, m."""


class Limits(NamedTuple):
    """What a mesh leaves out; see :meth:`Map.mesh`."""

    min_confidence: float | None
    """None: that of the highest expected F-score."""
    of_triangles: TriangleLimits
    min_component_triangles: int

    @classmethod
    def of(
        cls,
        voxel_m: float,
        min_confidence: float | None = None,
        max_uncertainty: float | None = None,
        min_component_triangles: int | None = None,
    ) -> Limits:
        """The arguments of :meth:`Map.mesh` as numbers. Raises a ValueError if they are out of range."""
        if min_confidence is not None:
            min_confidence = number(min_confidence, "min_confidence")
            if not 0 <= min_confidence <= 1:
                msg = f"min_confidence must be in [0, 1], not {min_confidence}"
                raise ValueError(msg)
        max_uncertainty = number(math.inf if max_uncertainty is None else max_uncertainty, "max_uncertainty")
        if max_uncertainty < 0:
            msg = f"max_uncertainty must be at least 0, not {max_uncertainty}"
            raise ValueError(msg)
        if min_component_triangles is None:
            min_component_triangles = queries.piece_triangles(voxel_m)
        whole_number(min_component_triangles, "min_component_triangles", 0)
        return cls(min_confidence, TriangleLimits(max_uncertainty), min_component_triangles)


@dataclass(frozen=True)
class Surface:
    """All triangles where the field crosses zero, and what the returns tell of their vertices."""

    vertices: NDArray[np.float64]
    """(V, 3) local frame, m."""
    faces: NDArray[np.int32]
    """(F, 3) rows of the vertices, counter-clockwise seen from free space."""
    evidence: queries.EvidenceAt
    """Of each vertex."""
    confidence: NDArray[np.float32]
    """(V,) see :meth:`Map.confidence`."""
    uncertainty_m: NDArray[np.float32]
    """(V,) see :meth:`Map.uncertainty`."""
    tally: Tally
    """All of it by its confidence."""
    cells_searched: int
    """Number of leaf cells in which the surface can be."""

    @classmethod
    def of(
        cls,
        contents: MapContents,
        voxel_size: float,
        box: NDArray[np.float64] | None = None,
        progress: bool | None = False,
    ) -> Surface:
        """The surface in voxels of this edge, m, in the whole map or in a `box` (2, 3), local frame, m."""
        lattice = sample_lattice(contents, voxel_size, box, progress)
        vertices, faces = extract_cells(
            lattice.corners,
            lattice.distances_m,
            lattice.voxel_corners,
            spacing=[voxel_size] * 3,
            num_threads=torch.get_num_threads(),
        )
        # By way of the world's coordinates, as those who query the mesh's own vertices do.
        evidence = queries.evidence(contents, local(contents, vertices + contents.origin))
        return cls.told_by(contents, vertices, faces, evidence, lattice.cells_searched)

    @classmethod
    def told_by(
        cls,
        scene: WholeMap,
        vertices: NDArray[np.float64],
        faces: NDArray[np.int32],
        evidence: queries.EvidenceAt,
        cells_searched: int,
        areas_m2: NDArray[np.float64] | None = None,
    ) -> Surface:
        """Triangles with the evidence of their vertices; all as of the fields. `areas_m2` (V,): those round the vertices, if known."""
        found = queries.probabilities(scene, evidence)
        confidence = found.confidence.float()
        return cls(
            vertices,
            faces,
            evidence,
            confidence.numpy(),
            queries.uncertainty(scene, evidence).numpy(),
            Tally.of(
                areas_round(vertices, faces) if areas_m2 is None else areas_m2,
                confidence.double().numpy(),
                found.covering.numpy(),
                found.reach.numpy(),
                evidence.detections.double().numpy(),
            ),
            cells_searched,
        )

    def allowed(self, limits: TriangleLimits) -> NDArray[np.bool_]:
        """Which of the faces nothing speaks against but the rest of the surface, (F,)."""
        known = np.nan_to_num(self.uncertainty_m, nan=np.inf) <= limits.max_uncertainty
        return with_all(known, self.faces)

    def kept(self, limits: Limits) -> NDArray[np.bool_]:
        """Which of the faces a mesh keeps, (F,)."""
        kept = self.allowed(limits.of_triangles)
        kept &= with_all(self.confidence >= self.threshold(limits).min_confidence, self.faces)
        rows = np.flatnonzero(kept)
        if len(rows):
            labels, sizes = mesh_components(self.faces[rows], len(self.vertices))
            kept[rows] = sizes[labels] >= limits.min_component_triangles
        return kept

    def threshold(self, limits: Limits) -> Threshold:
        """From which confidence on a mesh keeps it."""
        return self.tally.threshold(limits.min_confidence)

    def mesh(self, origin: NDArray[np.float64], limits: Limits, leaf_cells: int) -> trimesh.Trimesh:
        """What the limits leave, in the world; `leaf_cells` of the whole map."""
        return self.part(
            origin,
            self.kept(limits),
            leaf_cells=leaf_cells,
            leaf_cells_searched=self.cells_searched,
            **self.threshold(limits).metadata,
        )

    def part(
        self, origin: NDArray[np.float64], kept: NDArray[np.bool_], **metadata: float
    ) -> trimesh.Trimesh:
        """The faces that are `kept` (F,), in the world."""
        used, faces = renumbered(len(self.vertices), self.faces[kept])
        return described_mesh(
            self.vertices[used] + origin, faces, self.confidence[used], self.uncertainty_m[used], **metadata
        )


def described_mesh(
    vertices: NDArray[np.float64],
    faces: NDArray[np.integer[Any]],
    confidence: NDArray[np.float32],
    uncertainty_m: NDArray[np.float32],
    **metadata: float,
) -> trimesh.Trimesh:
    """The mesh of vertices (V, 3), world, m, with what is known of them and of all."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.vertex_attributes["confidence"] = confidence
    mesh.vertex_attributes["uncertainty_m"] = uncertainty_m
    mesh.metadata |= metadata
    return mesh


def mesh_seen_from(
    radar_map: Map, viewpoint: ArrayLike | None, make: Callable[[], trimesh.Trimesh]
) -> trimesh.Trimesh:
    """The mesh of a map that `make` makes, with the intensities that are predicted for a viewpoint, if there is one."""
    scale = radar_map.intensity_scale
    sensor_position = None if viewpoint is None else check_viewpoint(scale, viewpoint)
    mesh = make()
    if sensor_position is not None and scale is not None:
        vertices: Any = mesh.vertices
        intensity = radar_map.intensity(
            np.array(vertices, np.float64), sensor_position, extrapolate=True
        ).astype(np.float32)
        mesh.vertex_attributes["intensity"] = intensity
        colors = intensity_colors(intensity, scale.low, scale.high)
        mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    return mesh


def extract_mesh(
    contents: MapContents,
    voxel_size: float,
    *,
    box: ArrayLike | None,
    progress: bool | None,
    **wanted: Any,
) -> trimesh.Trimesh:
    """The mesh of one map. See :meth:`Map.mesh`, of which `wanted` are the limits."""
    voxel_size = positive(voxel_size, "voxel_size")
    if voxel_size > MAX_POSITION_M:
        msg = f"voxel_size must be at most {MAX_POSITION_M:g} m, not {voxel_size}"
        raise ValueError(msg)
    limits = Limits.of(voxel_size, **wanted)
    local_box = None if box is None else check_box(box) - contents.origin
    surface = Surface.of(contents, voxel_size, local_box, progress)
    return surface.mesh(contents.origin, limits, len(contents.evidence.looks))


def local(contents: WholeMap, world: NDArray[np.float64]) -> torch.Tensor:
    """Positions (N, 3) in the world, m, in the local frame, float32."""
    return queries.to_local(contents, torch.from_numpy(world))


def check_viewpoint(scale: IntensityScale | None, viewpoint: ArrayLike) -> NDArray[np.float64]:
    """A sensor position (3,), world, m. Raises a ValueError if it is none, or there are no intensities."""
    if scale is None:
        msg = "a viewpoint needs a map with intensities; this one was fitted without"
        raise ValueError(msg)
    sensor_position = real_array(viewpoint, "viewpoint")
    if sensor_position.shape != (3,) or not (np.abs(sensor_position) <= MAX_POSITION_M).all():
        msg = f"viewpoint must be one position (3,), finite and within {MAX_POSITION_M:g} m"
        raise ValueError(msg)
    return sensor_position


def with_all(good: NDArray[np.bool_], faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(F,) which of the faces (F, 3) have three vertices that are `good` (V,)."""
    first, second, third = faces.T
    found: NDArray[np.bool_] = good[first] & good[second] & good[third]
    return found


def renumbered(num_vertices: int, faces: NDArray[np.int32]) -> tuple[NDArray[np.bool_], NDArray[np.int32]]:
    """Which vertices faces use, (V,) bool, and the faces (F, 3) as rows of these."""
    used = np.zeros(num_vertices, bool)
    used[faces] = True
    renumbered = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return used, renumbered[faces]
