"""A world of ground and solids: exact ray hits, signed distances, and the echoes of hits.

World frame: z up, m. Signed distances are positive in free space and negative inside a solid.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np

from radarsdf.arrays import ArrayLike, Floats, Ints

from .materials import Material

_First = tuple[Floats, Floats]


class Primitive(ABC):
    """A part of a scene. All arrays are float64, in the world frame, in m."""

    material: Material

    @abstractmethod
    def bounding_sphere(self) -> tuple[Floats, float]:
        """Centre (3,) and radius of a sphere that contains the part."""

    @abstractmethod
    def intersect(self, origins: Floats, directions: Floats, max_range_m: Floats) -> _First:
        """First hits of (N, 3) rays: ranges (N,), inf beyond `max_range_m` (N,), and unit normals (N, 3)."""

    @abstractmethod
    def signed_distance(self, points: Floats) -> Floats:
        """Distances (N,) of points (N, 3) to the surface, negative inside."""

    def echo_db(self, points: Floats, directions: Floats, normals: Floats) -> Floats:
        """Echo (N,), dB, of hits (N, 3) seen along unit directions (N, 3), without the loss by range."""
        return self.material.echo_db(points, -np.einsum("ni,ni->n", directions, normals))


def _quotient(numerator: Floats, denominator: Floats) -> Floats:
    """Divide with a tiny denominator instead of zero, so that a ray parallel to a plane hits it very far away."""
    tiny = np.abs(denominator) < 1e-12
    return numerator / np.where(tiny, np.where(denominator < 0, -1e-12, 1e-12), denominator)


@dataclass(frozen=True, eq=False)
class Box(Primitive):
    """A solid box, rotated about the vertical axis only."""

    center: Floats  # (3,) world, m
    half_extents: Floats  # (3,) along its own axes, m
    yaw_rad: float
    material: Material

    def _rotation(self) -> Floats:
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def bounding_sphere(self) -> tuple[Floats, float]:
        return self.center, float(np.linalg.norm(self.half_extents))

    def intersect(self, origins: Floats, directions: Floats, max_range_m: Floats) -> _First:
        R_world_box = self._rotation()
        origin, direction = (origins - self.center) @ R_world_box, directions @ R_world_box
        corner = np.copysign(self.half_extents, direction)
        near, far = _quotient(-corner - origin, direction), _quotient(corner - origin, direction)
        rows, axis = np.arange(len(near)), near.argmax(axis=1)
        t = near[rows, axis]
        t = np.where((t <= far.min(axis=1)) & (t > 0) & (t <= max_range_m), t, np.inf)
        local = np.zeros_like(direction)
        local[rows, axis] = -np.copysign(1.0, direction[rows, axis])
        return t, local @ R_world_box.T

    def signed_distance(self, points: Floats) -> Floats:
        q = np.abs((points - self.center) @ self._rotation()) - self.half_extents
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


@dataclass(frozen=True, eq=False)
class Pole(Primitive):
    """A solid vertical cylinder."""

    base: Floats  # (3,) centre of the lower end, world, m
    radius_m: float
    height_m: float
    material: Material

    def bounding_sphere(self) -> tuple[Floats, float]:
        center = self.base + np.array([0, 0, self.height_m / 2])
        return center, float(np.hypot(self.radius_m, self.height_m / 2))

    def intersect(self, origins: Floats, directions: Floats, max_range_m: Floats) -> _First:
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

    def signed_distance(self, points: Floats) -> Floats:
        p = points - self.base
        radial = np.hypot(p[:, 0], p[:, 1]) - self.radius_m
        vertical = np.abs(p[:, 2] - self.height_m / 2) - self.height_m / 2
        outside: Floats = np.hypot(np.maximum(radial, 0), np.maximum(vertical, 0))
        return outside + np.minimum(np.maximum(radial, vertical), 0)


@dataclass(frozen=True, eq=False)
class CornerReflector(Primitive):
    """A trihedral corner reflector of three right-angled triangular plates, open towards `axis`.

    The plates are infinitely thin, so distances are never negative. The echo is the sum of those of the plates and of a
    lobe that depends only on the angle to the axis: the three plates together reflect a wave back to its source.
    """

    apex: Floats  # (3,) world, m
    axis: Floats  # (3,) unit vector out of the opening, world
    edge_m: float  # length of the three edges that meet in the apex
    material: Material  # material of the plates
    retro_db: float = 25.0  # echo on the axis relative to `material.reflectivity_db` [dB]
    retro_width_rad: float = 0.28  # standard deviation of the lobe; 0.28 is the usual 3 dB cone of 38 degrees

    def _edges(self) -> Floats:
        """Unit vectors (3, 3) from the apex along the edges, one per row, at equal angles to the axis."""
        up = np.array([0.0, 0.0, 1.0]) if abs(self.axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        side = np.cross(up, self.axis)
        side /= np.linalg.norm(side)
        turn = np.arange(3)[:, None] * (2 * np.pi / 3) + np.pi / 2
        ring = np.cos(turn) * side + np.sin(turn) * np.cross(self.axis, side)
        return self.axis / np.sqrt(3) + ring * np.sqrt(2 / 3)

    def bounding_sphere(self) -> tuple[Floats, float]:
        return self.apex, self.edge_m

    def intersect(self, origins: Floats, directions: Floats, max_range_m: Floats) -> _First:
        edges = self._edges()
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

    def signed_distance(self, points: Floats) -> Floats:
        p = (points - self.apex) @ self._edges().T
        best = np.full(len(p), np.inf)
        for i in range(3):
            u, v = p[:, (i + 1) % 3], p[:, (i + 2) % 3]
            x, y = np.maximum(u, 0), np.maximum(v, 0)
            # Nearest point of the triangle x, y >= 0, x + y <= edge. Points beyond the sloping side are projected onto it.
            along = np.clip((u - v + self.edge_m) / 2, 0, self.edge_m)
            beyond = x + y > self.edge_m
            x, y = np.where(beyond, along, x), np.where(beyond, self.edge_m - along, y)
            best = np.minimum(best, np.sqrt((u - x) ** 2 + (v - y) ** 2 + p[:, i] ** 2))
        return best

    def echo_db(self, points: Floats, directions: Floats, normals: Floats) -> Floats:
        plates = super().echo_db(points, directions, normals)
        angle = np.arccos(np.clip(-directions @ self.axis, -1, 1))
        lobe_db = 10 * np.log10(np.e) * 0.5 * (angle / self.retro_width_rad) ** 2
        retro = self.material.reflectivity_db + self.retro_db - lobe_db
        return 10 * np.log10(10 ** (plates / 10) + 10 ** (retro / 10))


@dataclass(frozen=True, eq=False)
class Terrain(Primitive):
    """Height field z(x, y) = level + Σ amplitude · sin(wave · (x, y) + phase), solid below and without an edge."""

    waves: Floats  # (K, 2) wave vectors [rad/m]
    amplitudes: Floats  # (K,) [m]
    phases: Floats  # (K,) [rad]
    level_m: float
    material: Material

    @classmethod
    def random(cls, rng: np.random.Generator, roughness_m: float, material: Material) -> "Terrain":
        """Draw rolling ground of mean height 0: five octaves with two waves each, from about 40 m down to 2.5 m long.

        `roughness_m` is the amplitude of the longest waves, m. Each halving of the wavelength divides the amplitude by 2.5.
        """
        octave = np.repeat(np.arange(5), 2)
        length = 40.0 / 2.0**octave * rng.uniform(0.8, 1.25, size=10)
        heading = rng.uniform(0, 2 * np.pi, size=10)
        waves = 2 * np.pi / length[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        amplitudes = np.asarray(roughness_m / 2.5**octave, dtype=np.float64)
        return cls(waves, amplitudes, rng.uniform(0, 2 * np.pi, size=10), 0.0, material)

    def height(self, xy: Floats) -> Floats:
        """Height (N,), m, of the ground at positions (N, 2), world, m."""
        return self.level_m + np.sin(xy @ self.waves.T + self.phases) @ self.amplitudes

    def _slope(self, xy: Floats) -> Floats:
        return (np.cos(xy @ self.waves.T + self.phases) * self.amplitudes) @ self.waves

    def _normals(self, xy: Floats) -> Floats:
        normals = np.concatenate([-self._slope(xy), np.ones((len(xy), 1))], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return normals

    def bounding_sphere(self) -> tuple[Floats, float]:
        return np.zeros(3), np.inf

    def intersect(self, origins: Floats, directions: Floats, max_range_m: Floats) -> _First:
        # Rays from above advance until they are below the ground. The steepest possible slope bounds the length of a
        # safe step, but a step is at least 10 cm + 1 % of the range, so a crest of millimetres can be missed.
        steepest = float(np.abs(self.amplitudes) @ np.linalg.norm(self.waves, axis=1))
        top = self.level_m + float(np.abs(self.amplitudes).sum())
        dz = directions[:, 2]
        closing = np.linalg.norm(directions[:, :2], axis=1) * steepest - dz
        # Rays from above the highest crest start at its height.
        start = np.where(origins[:, 2] > top, (origins[:, 2] - top) / np.maximum(-dz, 1e-9), 0.0)
        t, before = start, start.copy()
        hit = np.zeros(len(t), dtype=bool)
        active = np.flatnonzero(start <= max_range_m)
        while len(active):
            p = origins[active] + t[active, None] * directions[active]
            gap = p[:, 2] - self.height(p[:, :2])
            below = gap <= 0
            hit[active[below]] = True
            gone = (t[active] > max_range_m[active]) | ((p[:, 2] > top) & (dz[active] >= 0))
            keep = ~below & ~gone
            active, gap = active[keep], gap[keep]
            step = np.maximum(gap / np.maximum(closing[active], 1e-9), 0.1 + 0.01 * t[active])
            before[active] = t[active]
            t[active] += step
        # Newton's method finds the crossing within the last step.
        rows = np.flatnonzero(hit)
        o, d, low, high = origins[rows], directions[rows], before[rows], t[rows]
        x = high.copy()
        for _ in range(6):
            p = o + x[:, None] * d
            gap = p[:, 2] - self.height(p[:, :2])
            low, high = np.where(gap > 0, x, low), np.where(gap > 0, high, x)
            rate = d[:, 2] - np.einsum("ni,ni->n", self._slope(p[:, :2]), d[:, :2])
            newton = x - gap / np.where(np.abs(rate) < 1e-9, -1e-9, rate)
            x = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        result, normals = np.full(len(t), np.inf), np.zeros_like(directions)
        result[rows] = np.where(x <= max_range_m[rows], x, np.inf)
        normals[rows] = self._normals((o + x[:, None] * d)[:, :2])
        return result, normals

    def signed_distance(self, points: Floats) -> Floats:
        # Exact for points nearer to the ground than its radius of curvature, some metres. Farther away, the
        # result is the distance to some point of the ground: possibly too large, never too small.
        foot = points[:, :2].copy()
        vertical = points[:, 2] - self.height(foot)
        best = np.abs(vertical)
        for _ in range(8):
            on = np.concatenate([foot, self.height(foot)[:, None]], axis=1)
            best = np.minimum(best, np.linalg.norm(points - on, axis=1))
            normals = self._normals(foot)
            along = np.einsum("ni,ni->n", points - on, normals)
            foot = points[:, :2] - along[:, None] * normals[:, :2]
        return np.copysign(best, vertical)


class Hits(NamedTuple):
    """First hits of N rays."""

    range_m: Floats  # (N,) inf without a hit
    normals: Floats  # (N, 3) unit vectors, world, towards the ray's origin; zero without a hit
    primitive: Ints  # (N,) index into `Scene.parts`, -1 without a hit


@dataclass(frozen=True, eq=False)
class Scene:
    """A static world."""

    solids: Sequence[Primitive]
    """Boxes, poles and reflectors. They may overlap and extend below the ground."""
    terrain: Terrain | None = None
    """The ground. None: there is no ground."""

    @property
    def parts(self) -> list[Primitive]:
        """All parts in the order of `Hits.primitive`: the solids, then the ground."""
        return [*self.solids, *([self.terrain] if self.terrain is not None else [])]

    def raycast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Hits:
        """Find the first hit of each ray within `max_range_m`, exact to about 1e-9 m.

        `origins`: (N, 3), or one, (3,), world, m. `directions`: (N, 3) unit vectors, world.
        """
        directions = np.asarray(directions, dtype=np.float64)
        origins = np.broadcast_to(np.asarray(origins, dtype=np.float64), directions.shape)
        nearest = np.full(len(directions), max_range_m)
        normals = np.zeros_like(directions)
        primitive = np.full(len(directions), -1, dtype=np.int64)
        for index, part in enumerate(self.parts):
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

    def signed_distance(self, points: ArrayLike) -> Floats:
        """Compute signed distances (N,) float64, m, of points (N, 3), world, m, to the union of all parts.

        Positive in free space. They may be too large metres above rough ground, and too near 0 inside overlapping solids.
        """
        p = np.asarray(points, dtype=np.float64)
        return reduce(np.minimum, (part.signed_distance(p) for part in self.parts), np.full(len(p), np.inf))

    def echo_db(self, points: Floats, directions: Floats, hits: Hits) -> Floats:
        """Echo (N,), dB, without the loss by range, of the hits of rays at points (N, 3); -inf without a hit."""
        echo = np.full(len(points), -np.inf)
        for index in np.unique(hits.primitive[hits.primitive >= 0]):
            rows = hits.primitive == index
            echo[rows] = self.parts[index].echo_db(points[rows], directions[rows], hits.normals[rows])
        return echo

    def material_values(self, hits: Hits, field: str, missing: float) -> Floats:
        """A numeric field of the material at each hit, (N,) float64; `missing` without a hit."""
        table = np.array([*(getattr(part.material, field) for part in self.parts), missing], dtype=np.float64)
        return table[hits.primitive]
