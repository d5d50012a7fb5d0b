# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface of a map as the page shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import whole_number
from radarsdf.map.mesh import renumbered, with_all
from radarsdf.map.threshold import Threshold
from radarsdf.view.thinning import thinned

if TYPE_CHECKING:
    from radarsdf.map.map import Map

_Floats = NDArray[np.float64]
_Rows = NDArray[np.int64]

_FEWEST = 1000  # vertices: less is not worth a look
_TO_LIGHT = (-0.35, -0.5, 0.79)
_SHADE = 0.87  # lightness where the light does not come: colours must still be those of the scale


@dataclass(frozen=True)
class ShownSurface:
    """Triangles with what the map knows of their vertices."""

    vertices: _Floats
    """(V, 3) world, m."""
    faces: NDArray[np.int32]
    """(F, 3) rows of vertices. They face free space."""
    uncertainty_m: NDArray[np.float32]
    """(V,) see `Map.uncertainty`."""
    confidence: NDArray[np.float32]
    """(V,) see `Map.confidence`."""
    lightness: NDArray[np.float32]
    """(V,) factor of the lightness of colours, at most 1, so that the shape is seen."""
    threshold: Threshold
    """From which confidence on the mesh was kept."""
    spacing_m: float
    """How far apart vertices are: the edge of the voxels, or more if the mesh was thinned."""

    @classmethod
    def of(
        cls,
        radar_map: Map,
        voxel_size: float,
        *,
        max_vertices: int,
        box: ArrayLike | None = None,
        progress: bool | None = None,
        **limits: Any,
    ) -> ShownSurface:
        """Mesh a map, and thin the mesh if it has more than `max_vertices`. `limits`: as `Map.mesh`.

        Raises
        ------
        ValueError
            If there is no surface, or as `Map.mesh`.
        """
        whole_number(max_vertices, "max_vertices", _FEWEST)
        mesh: Any = radar_map.mesh(voxel_size, box=box, progress=progress, **limits)
        threshold = Threshold.of_mesh(mesh.metadata)
        mesh, edge_m = thinned(mesh, max_vertices, voxel_size)
        if len(mesh.vertices) == 0:
            msg = "the map has no surface here"
            raise ValueError(msg)
        attributes = mesh.vertex_attributes
        return cls(
            np.asarray(mesh.vertices, np.float64),
            np.asarray(mesh.faces, np.int32),
            np.asarray(attributes["uncertainty_m"], np.float32),
            np.asarray(attributes["confidence"], np.float32),
            lightness_of(np.asarray(mesh.vertex_normals, np.float64)),
            threshold,
            edge_m,
        )

    def kept(self, max_uncertainty_m: float, min_confidence: float) -> NDArray[np.bool_]:
        """(V,) whether a vertex is to be seen."""
        return (self.uncertainty_m <= max_uncertainty_m) & (self.confidence >= min_confidence)

    def part(self, kept: NDArray[np.bool_]) -> tuple[_Rows, NDArray[np.int32]]:
        """The triangles of which all vertices are kept: rows of their vertices (N,), and faces (M, 3) as rows of those."""
        used, faces = renumbered(len(kept), self.faces[with_all(kept, self.faces)])
        return np.flatnonzero(used), faces


def lightness_of(normals: _Floats) -> NDArray[np.float32]:
    """(V,) factor of the lightness of colours for normals (V, 3), so that the shape is seen."""
    light: NDArray[np.float64] = np.clip(normals @ np.array(_TO_LIGHT), 0.0, 1.0)
    return (_SHADE + (1 - _SHADE) * light).astype(np.float32)
