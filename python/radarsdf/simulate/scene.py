# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A world of ground and solids: exact ray hits, distances, and the echo of every hit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .primitives import Primitive
from .terrain import Terrain

__all__ = ["Hits", "Scene"]

FloatArray = NDArray[np.float64]
_CHUNK = 32768  # rays or points at a time; they take some tens of MB


class Hits(NamedTuple):
    """First hits of N rays."""

    range_m: FloatArray  # (N,) inf where the ray hits nothing
    normals: (
        FloatArray  # (N, 3) unit vectors, world, towards the origin of the ray; zero where it hits nothing
    )
    primitive: NDArray[np.int64]  # (N,) index into `Scene.parts`, -1 where it hits nothing

    def select(self, rows: NDArray[np.bool_]) -> Hits:
        """Hits of the rays in an (N,) mask."""
        return Hits(self.range_m[rows], self.normals[rows], self.primitive[rows])


@dataclass(frozen=True, eq=False)
class Scene:
    """A static world.

    Parameters
    ----------
    solids : sequence of Primitive
        Boxes, poles and reflectors. They may overlap and reach below the ground.
    terrain : Terrain, optional
        The ground. None: there is no ground.
    """

    solids: Sequence[Primitive]
    terrain: Terrain | None = None

    @property
    def parts(self) -> list[Primitive | Terrain]:
        """All parts in the order of `Hits.primitive`: the solids, then the ground."""
        return [*self.solids, *([self.terrain] if self.terrain is not None else [])]

    def raycast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Hits:
        """First surface along each ray.

        Parameters
        ----------
        origins : (N, 3) or (3,) array_like
            World frame, m.
        directions : (N, 3) array_like
            Unit vectors, world frame.
        max_range_m : float
            Farther hits do not count.

        Returns
        -------
        Hits
            The first hit of each ray, exact to about 1e-9 m.
        """
        d = np.asarray(directions, dtype=np.float64)
        o = np.broadcast_to(np.asarray(origins, dtype=np.float64), d.shape)
        pieces = [
            self._raycast(o[i : i + _CHUNK], d[i : i + _CHUNK], max_range_m)
            for i in range(0, max(len(d), 1), _CHUNK)
        ]
        return Hits(
            np.concatenate([piece.range_m for piece in pieces]),
            np.concatenate([piece.normals for piece in pieces]),
            np.concatenate([piece.primitive for piece in pieces]),
        )

    def _raycast(self, origins: FloatArray, directions: FloatArray, max_range_m: float) -> Hits:
        nearest = np.full(len(directions), max_range_m)
        normals = np.zeros_like(directions)
        primitive = np.full(len(directions), -1, dtype=np.int64)
        for index, part in enumerate(self.parts):
            rows = np.arange(len(directions))
            if not isinstance(part, Terrain):
                center, radius = part.bounding_sphere()
                to_center = center - origins
                along = np.einsum("ni,ni->n", to_center, directions)
                off = np.einsum("ni,ni->n", to_center, to_center) - along**2
                rows = np.flatnonzero((off <= radius**2) & (along > -radius) & (along < nearest + radius))
            t, n = part.intersect(origins[rows], directions[rows], nearest[rows])
            hit = np.isfinite(t)
            rows = rows[hit]
            nearest[rows], normals[rows], primitive[rows] = t[hit], n[hit], index
        return Hits(np.where(primitive >= 0, nearest, np.inf), normals, primitive)

    def signed_distance(self, points: ArrayLike) -> FloatArray:
        """Signed distance to the union of all parts.

        Parameters
        ----------
        points : (N, 3) array_like
            World frame, m.

        Returns
        -------
        (N,) float64
            Distances, m, positive in free space. There they are exact, but see `Terrain.signed_distance` for points
            metres above the ground. Inside, where parts overlap, the absolute value may be too small.
        """
        p = np.asarray(points, dtype=np.float64)
        best = np.full(len(p), np.inf)
        for i in range(0, len(p), _CHUNK):
            piece = p[i : i + _CHUNK]
            for part in self.parts:
                best[i : i + _CHUNK] = np.minimum(best[i : i + _CHUNK], part.signed_distance(piece))
        return best

    def echo_db(self, points: FloatArray, directions: FloatArray, hits: Hits) -> FloatArray:
        """Strength of the echo of each hit, without the loss by range.

        Parameters
        ----------
        points, directions : (N, 3) float64
            Points where the rays hit, and their unit directions, world frame, m.
        hits : Hits
            Hits of these rays.

        Returns
        -------
        (N,) float64
            dB, -inf where there is no hit.
        """
        echo = np.full(len(points), -np.inf)
        for index in np.unique(hits.primitive[hits.primitive >= 0]):
            rows = hits.primitive == index
            echo[rows] = self.parts[index].echo_db(points[rows], directions[rows], hits.normals[rows])
        return echo

    def material_values(self, hits: Hits, field: str, missing: float) -> FloatArray:
        """A numeric field of the material at each hit, (N,) float64; `missing` where there is no hit."""
        table = np.array([*(getattr(part.material, field) for part in self.parts), missing], dtype=np.float64)
        return table[hits.primitive]
