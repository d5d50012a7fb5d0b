# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface of a map as rays meet it: where the mesh stops them, and how often each patch of the field answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from radarsdf._core import SurfaceTracer
from radarsdf.map import queries
from radarsdf.map.contents import MapContents
from radarsdf.map.meshing import Limits, Surface
from radarsdf.map.threshold import across_triangles
from radarsdf.memory import check_views
from radarsdf.threads import resolve_num_threads

# Scans that looked at a place where none had a return count for so many: with few looks, a rate is uncertain.
_LOOKS_BEFORE = 2.0
_DETECTIONS_BEFORE = 0.5


class Hits(NamedTuple):
    """Where N rays first meet the mesh."""

    ranges_m: NDArray[np.float32]
    """(N,) infinite where a ray meets nothing."""
    faces: NDArray[np.int32]
    """(N,) row of the triangle, -1 where a ray meets nothing."""


@dataclass(frozen=True, eq=False)
class TracedSurface:
    """What views of a map are made of. It is made once for a map."""

    tracer: SurfaceTracer
    """Of the triangles that the mesh keeps by default, local frame."""
    centres: NDArray[np.float64]
    """(P, 3) patches: middles of all triangles where the field crosses zero, local frame, m."""
    normals: NDArray[np.float64]
    """(P, 3) unit vectors towards free space."""
    areas_m2: NDArray[np.float64]
    """(P,) of the patches."""
    rates: NDArray[np.float64]
    """(P,) share of the scans that looked at a patch and have a return there."""

    @classmethod
    def of(cls, contents: MapContents) -> TracedSurface:
        """The surface in voxels of a leaf cell's size, which is finer than the noise of a radar."""
        voxel_m = contents.config.leaf_size_m
        check_views(contents.config.max_memory_bytes, cells=len(contents.evidence.looks))
        return cls.of_surface(
            Surface.of(contents, voxel_m),
            Limits.of(voxel_m),
            lambda points: queries.evidence(contents, torch.from_numpy(points.astype(np.float32))),
        )

    @classmethod
    def of_surface(
        cls,
        surface: Surface,
        limits: Limits,
        evidence_at: Callable[[NDArray[np.float64]], queries.EvidenceAt],
    ) -> TracedSurface:
        """All triangles of a surface, of which rays meet those that `limits` leave. `evidence_at`: of points (N, 3), local frame, m."""
        across, twice_m2 = across_triangles(surface.vertices, surface.faces)
        centres = surface.vertices[surface.faces].mean(axis=1)
        evidence = evidence_at(centres)
        rates = (evidence.detections.numpy() + _DETECTIONS_BEFORE) / (evidence.looks.numpy() + _LOOKS_BEFORE)
        faces = np.ascontiguousarray(surface.faces[surface.kept(limits)])
        return cls(
            SurfaceTracer(surface.vertices, faces, resolve_num_threads(0)),
            centres,
            across / np.maximum(twice_m2, 1e-12)[:, None],
            twice_m2 / 2,
            rates.astype(np.float64),
        )

    def first_hits(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64], max_range_m: float
    ) -> Hits:
        """Where rays from `origin` (3,) in unit `directions` (N, 3), local frame, first meet what the mesh keeps."""
        rows = np.ascontiguousarray(directions, np.float32)
        return Hits(
            *self.tracer.first_hits(origin.tolist(), rows, max_range_m, False, resolve_num_threads(0))
        )
