# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Solids with exact ray intersections: boxes, vertical cylinders and trihedral corner reflectors.

World frame: z up, m. Signed distances are positive in free space and negative inside a solid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .materials import Material

__all__ = ["Box", "CornerReflector", "Pole", "Primitive"]

FloatArray = NDArray[np.float64]


class Primitive(Protocol):
    """Interface of a solid in a scene. All arrays are float64, in the world frame, in m."""

    @property
    def material(self) -> Material:
        """Radar properties of the surface."""

    def bounding_sphere(self) -> tuple[FloatArray, float]:
        """Centre (3,) and radius of a sphere that contains the solid."""

    def intersect(
        self, origins: FloatArray, directions: FloatArray, max_range_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """First hits of (N, 3) rays: ranges (N,) and unit normals (N, 3).

        The range is inf where there is no hit within `max_range_m` (N,). Its normal then has no meaning.
        """

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """Distances (N,) of points (N, 3) to the surface, negative inside."""

    def echo_db(self, points: FloatArray, directions: FloatArray, normals: FloatArray) -> FloatArray:
        """Echo (N,), dB, of hits (N, 3) seen along unit directions (N, 3), without the loss by range."""


def cos_incidence(directions: FloatArray, normals: FloatArray) -> FloatArray:
    """Cosine (N,) between the normals (N, 3) and the directions back to the sensor."""
    cos: FloatArray = -np.einsum("ni,ni->n", directions, normals)
    return cos


def _quotient(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Quotient with a tiny denominator instead of zero, so that a ray parallel to a plane hits it very far away."""
    tiny = np.abs(denominator) < 1e-12
    result: FloatArray = numerator / np.where(tiny, np.where(denominator < 0, -1e-12, 1e-12), denominator)
    return result


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box, turned about the vertical axis only."""

    center: FloatArray  # (3,) world, m
    half_extents: FloatArray  # (3,) along its own axes, m
    yaw_rad: float
    material: Material

    def _rotation(self) -> FloatArray:
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def bounding_sphere(self) -> tuple[FloatArray, float]:
        """See `Primitive.bounding_sphere`."""
        return self.center, float(np.linalg.norm(self.half_extents))

    def intersect(
        self, origins: FloatArray, directions: FloatArray, max_range_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See `Primitive.intersect`."""
        R_world_box = self._rotation()
        origin, direction = (origins - self.center) @ R_world_box, directions @ R_world_box
        near = _quotient(-np.copysign(self.half_extents, direction) - origin, direction)
        far = _quotient(np.copysign(self.half_extents, direction) - origin, direction)
        axis = near.argmax(axis=1)
        t = np.take_along_axis(near, axis[:, None], axis=1)[:, 0]
        t = np.where((t <= far.min(axis=1)) & (t > 0) & (t <= max_range_m), t, np.inf)
        local = np.zeros_like(direction)
        rows = np.arange(len(t))
        local[rows, axis] = -np.copysign(1.0, direction[rows, axis])
        return t, local @ R_world_box.T

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """See `Primitive.signed_distance`."""
        q = np.abs((points - self.center) @ self._rotation()) - self.half_extents
        distance: FloatArray = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
        return distance

    def echo_db(self, points: FloatArray, directions: FloatArray, normals: FloatArray) -> FloatArray:
        """See `Primitive.echo_db`."""
        return self.material.echo_db(points, cos_incidence(directions, normals))


@dataclass(frozen=True, eq=False)
class Pole:
    """A solid vertical cylinder."""

    base: FloatArray  # (3,) centre of the lower end, world, m
    radius_m: float
    height_m: float
    material: Material

    def bounding_sphere(self) -> tuple[FloatArray, float]:
        """See `Primitive.bounding_sphere`."""
        center = self.base + np.array([0, 0, self.height_m / 2])
        return center, float(np.hypot(self.radius_m, self.height_m / 2))

    def intersect(
        self, origins: FloatArray, directions: FloatArray, max_range_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See `Primitive.intersect`."""
        o, d = origins - self.base, directions
        a = np.maximum(d[:, 0] ** 2 + d[:, 1] ** 2, 1e-24)
        b = o[:, 0] * d[:, 0] + o[:, 1] * d[:, 1]
        c = o[:, 0] ** 2 + o[:, 1] ** 2 - self.radius_m**2
        discriminant = b * b - a * c
        side = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
        z = o[:, 2] + side * d[:, 2]
        side = np.where((discriminant >= 0) & (side > 0) & (z >= 0) & (z <= self.height_m), side, np.inf)
        level = np.where(d[:, 2] < 0, self.height_m, 0.0)
        cap = _quotient(level - o[:, 2], d[:, 2])
        x, y = o[:, 0] + cap * d[:, 0], o[:, 1] + cap * d[:, 1]
        cap = np.where((cap > 0) & (x * x + y * y <= self.radius_m**2), cap, np.inf)
        t = np.minimum(side, cap)
        t = np.where(t <= max_range_m, t, np.inf)
        hit = np.where(np.isfinite(t), t, 0.0)[:, None]
        normals = (o + hit * d) * [1, 1, 0] / self.radius_m
        normals[cap < side] = 0
        normals[cap < side, 2] = -np.sign(d[cap < side, 2])
        return t, normals

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """See `Primitive.signed_distance`."""
        p = points - self.base
        radial = np.hypot(p[:, 0], p[:, 1]) - self.radius_m
        vertical = np.abs(p[:, 2] - self.height_m / 2) - self.height_m / 2
        outside: FloatArray = np.hypot(np.maximum(radial, 0), np.maximum(vertical, 0))
        return outside + np.minimum(np.maximum(radial, vertical), 0)

    def echo_db(self, points: FloatArray, directions: FloatArray, normals: FloatArray) -> FloatArray:
        """See `Primitive.echo_db`."""
        return self.material.echo_db(points, cos_incidence(directions, normals))


@dataclass(frozen=True, eq=False)
class CornerReflector:
    """A trihedral corner reflector of three right-angled triangular plates, open towards `axis`.

    The plates are infinitely thin, so distances are never negative. The echo is the sum of that of the plates and of a
    lobe that depends only on the angle to the axis: the three plates together send a wave back where it came from.
    """

    apex: FloatArray  # (3,) world, m
    axis: FloatArray  # (3,) unit vector out of the opening, world
    edge_m: float  # length of the three edges that meet in the apex
    material: Material  # of the plates
    retro_db: float = 25.0  # echo on the axis, above `material.reflectivity_db` [dB]
    retro_width_rad: float = 0.28  # standard deviation of the lobe; 0.28 is the usual 3 dB cone of 38 degrees

    def edges(self) -> FloatArray:
        """Unit vectors (3, 3) from the apex along the edges, one per row, at equal angles to the axis."""
        up = np.array([0.0, 0.0, 1.0]) if abs(self.axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        side = np.cross(up, self.axis)
        side /= np.linalg.norm(side)
        turn = np.arange(3)[:, None] * (2 * np.pi / 3) + np.pi / 2
        ring = np.cos(turn) * side + np.sin(turn) * np.cross(self.axis, side)
        edges: FloatArray = self.axis / np.sqrt(3) + ring * np.sqrt(2 / 3)
        return edges

    def bounding_sphere(self) -> tuple[FloatArray, float]:
        """See `Primitive.bounding_sphere`."""
        return self.apex, self.edge_m

    def intersect(
        self, origins: FloatArray, directions: FloatArray, max_range_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See `Primitive.intersect`."""
        edges = self.edges()
        o, d = (origins - self.apex) @ edges.T, directions @ edges.T  # in the frame of the three edges
        best, plate = np.full(len(o), np.inf), np.zeros(len(o), dtype=np.int64)
        for i in range(3):
            t = _quotient(-o[:, i], d[:, i])
            p = o + t[:, None] * d
            p[:, i] = 0.0
            hit = (t > 0) & (t <= max_range_m) & (p.min(axis=1) >= 0) & (p.sum(axis=1) <= self.edge_m)
            nearer = hit & (t < best)
            best[nearer], plate[nearer] = t[nearer], i
        facing = -np.sign(d[np.arange(len(d)), plate])
        return best, facing[:, None] * edges[plate]

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """See `Primitive.signed_distance`."""
        p = (points - self.apex) @ self.edges().T
        best = np.full(len(p), np.inf)
        for i in range(3):
            u, v = p[:, (i + 1) % 3], p[:, (i + 2) % 3]
            x, y = np.maximum(u, 0), np.maximum(v, 0)
            # Nearest point of the triangle x, y >= 0, x + y <= edge. Points beyond the sloping side are moved onto it.
            along = np.clip((u - v + self.edge_m) / 2, 0, self.edge_m)
            beyond = x + y > self.edge_m
            x, y = np.where(beyond, along, x), np.where(beyond, self.edge_m - along, y)
            best = np.minimum(best, np.sqrt((u - x) ** 2 + (v - y) ** 2 + p[:, i] ** 2))
        return best

    def echo_db(self, points: FloatArray, directions: FloatArray, normals: FloatArray) -> FloatArray:
        """See `Primitive.echo_db`."""
        plates = self.material.echo_db(points, cos_incidence(directions, normals))
        angle = np.arccos(np.clip(-directions @ self.axis, -1, 1))
        retro = (
            self.material.reflectivity_db
            + self.retro_db
            - 10 * np.log10(np.e) * 0.5 * (angle / self.retro_width_rad) ** 2
        )
        echo: FloatArray = 10 * np.log10(10 ** (plates / 10) + 10 ** (retro / 10))
        return echo
