# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Random placement of buildings, walls, cars, poles and plants on the ground, without overlap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from . import materials
from .materials import Material
from .primitives import Box, Pole, Primitive
from .terrain import Terrain

__all__ = ["Path", "Site", "vary"]

FloatArray = NDArray[np.float64]
Path = Callable[[FloatArray], FloatArray]
"""Maps values (N,), 0..1 for those that are driven, to positions (N, 2), world frame, m."""

_BURIED_M = 1.0  # solids reach this far into the ground, so that they have no gap to the ground on a slope


def vary(rng: np.random.Generator, material: Material) -> Material:
    """The material with a random change of its reflectivity, since no two objects are the same."""
    return replace(material, reflectivity_db=material.reflectivity_db + rng.normal(0, 1.5))


class Site:
    """Solids on the ground. A new one must not overlap the earlier ones, nor the circles `taken`: x, y, radius [m]."""

    def __init__(
        self, rng: np.random.Generator, terrain: Terrain, taken: list[tuple[float, float, float]]
    ) -> None:
        self.solids: list[Primitive] = []
        self._rng, self._terrain = rng, terrain
        self._taken = list(taken)  # circles: x, y, radius [m]

    def _free(self, circles: list[tuple[float, float, float]]) -> bool:
        old, new = np.array(self._taken).reshape(-1, 3), np.array(circles)
        gap = np.linalg.norm(old[:, None, :2] - new[None, :, :2], axis=2) - old[:, None, 2] - new[None, :, 2]
        if (gap < 0).any():
            return False
        self._taken += circles
        return True

    def _block(self, xy: FloatArray, yaw: float, size: FloatArray, material: Material) -> bool:
        """Put a box of length, width and height on the ground, unless it would overlap."""
        along = np.array([np.cos(yaw), np.sin(yaw)])
        spots = np.linspace(-0.5, 0.5, max(1, round(size[0] / size[1]))) * max(0.0, size[0] - size[1])
        if not self._free([(*(xy + s * along), 0.75 * size[1]) for s in spots]):
            return False
        ground = float(self._terrain.height(xy[None])[0])
        self._add_box(xy, yaw, ground - _BURIED_M, np.array([*size[:2], size[2] + _BURIED_M]), material)
        return True

    def _add_box(
        self, xy: FloatArray, yaw: float, bottom: float, size: FloatArray, material: Material
    ) -> None:
        self.solids.append(Box(np.array([*xy, bottom + size[2] / 2]), size / 2, yaw, material))

    def beside(self, path: Path, u: float, near: float, far: float) -> tuple[FloatArray, float]:
        """A random place `near` to `far` m to one side of where a path is at `u`, (2,), and its direction there, rad."""
        ahead, here = path(np.array([u + 0.01, u]))
        yaw = float(np.arctan2(*(ahead - here)[::-1]))
        side = self._rng.choice([-1.0, 1.0]) * self._rng.uniform(near, far)
        return here + side * np.array([-np.sin(yaw), np.cos(yaw)]), yaw

    def fill(
        self,
        count: int,
        put: Callable[[FloatArray, float], bool],
        where: Callable[[], tuple[FloatArray, float]],
    ) -> None:
        """Put `count` objects at random places. Each has ten tries, and is left out if all fail."""
        for _ in range(count):
            any(put(*where()) for _ in range(10))

    def building(self, xy: FloatArray, yaw: float) -> bool:
        """A building of concrete or brick, 9 to 16 m long."""
        material = vary(self._rng, materials.CONCRETE if self._rng.random() < 0.5 else materials.BRICK)
        size = self._rng.uniform([9, 6, 5], [16, 9, 9])
        return self._block(xy, yaw + self._rng.normal(0, 0.15), size, material)

    def wall(self, xy: FloatArray, yaw: float) -> bool:
        """A free-standing wall, 1.4 to 2.6 m high."""
        size = self._rng.uniform([5, 0.25, 1.4], [12, 0.4, 2.6])
        return self._block(xy, yaw + self._rng.normal(0, 0.15), size, vary(self._rng, materials.CONCRETE))

    def car(self, xy: FloatArray, yaw: float) -> bool:
        """A car of two boxes: the body, and the cabin on top."""
        metal = vary(self._rng, materials.METAL)
        yaw, size = yaw + self._rng.normal(0, 0.05), self._rng.uniform([3.9, 1.7, 0.8], [4.8, 1.9, 1.0])
        if not self._block(xy, yaw, size, metal):
            return False
        roof = float(self._terrain.height(xy[None])[0]) + size[2]
        self._add_box(xy, yaw, roof - 0.05, np.array([0.5 * size[0], 0.9 * size[1], 0.6]), metal)
        return True

    def pole(self, xy: FloatArray, _yaw: float) -> bool:
        """A lamp post of steel or the trunk of a tree."""
        tree = self._rng.random() < 0.4
        radius = self._rng.uniform(0.15, 0.3) if tree else self._rng.uniform(0.06, 0.12)
        height = self._rng.uniform(4, 8)
        material = vary(self._rng, materials.TREE if tree else materials.STEEL_POLE)
        if not self._free([(*xy, radius)]):
            return False
        base = float(self._terrain.height(xy[None])[0]) - _BURIED_M
        self.solids.append(Pole(np.array([*xy, base]), radius, height + _BURIED_M, material))
        return True

    def hedge(self, xy: FloatArray, yaw: float) -> bool:
        """A hedge along a road, 1 to 2 m high."""
        size = self._rng.uniform([4, 0.7, 1.0], [14, 1.2, 2.0])
        return self._block(xy, yaw + self._rng.normal(0, 0.05), size, vary(self._rng, materials.TREE))

    def fence(self, xy: FloatArray, yaw: float) -> bool:
        """A fence along a path: posts 2 m apart, and two rails."""
        steps, height = int(self._rng.integers(3, 7)), self._rng.uniform(1.1, 1.8)
        along = np.array([np.cos(yaw), np.sin(yaw)])
        spots = [xy + 2.0 * (i - steps / 2) * along for i in range(steps + 1)]
        if not self._free([(*spot, 0.5) for spot in spots]):
            return False
        wood = vary(self._rng, materials.TREE)
        ground = self._terrain.height(np.array(spots))
        for spot, base in zip(spots, ground, strict=True):
            self.solids.append(Pole(np.array([*spot, base - _BURIED_M]), 0.05, height + _BURIED_M, wood))
        for share in (0.4, 0.9):
            bottom = float(ground.mean()) + share * height
            self._add_box(xy, yaw, bottom, np.array([2.0 * steps, 0.05, 0.12]), wood)
        return True

    def tree(self, xy: FloatArray, _yaw: float) -> bool:
        """A trunk, and a crown that begins 2 to 3 m above the ground."""
        radius, crown = self._rng.uniform(0.15, 0.35), self._rng.uniform([1.2, 2.0], [2.6, 5.0])
        if not self._free([(*xy, 0.5 * float(crown[0]))]):
            return False
        wood, ground = vary(self._rng, materials.TREE), float(self._terrain.height(xy[None])[0])
        bottom = ground + self._rng.uniform(2.0, 3.0)
        base = np.array([*xy, ground - _BURIED_M])
        self.solids.append(Pole(base, radius, bottom - ground + 2 * _BURIED_M, wood))
        self.solids.append(Pole(np.array([*xy, bottom]), float(crown[0]), float(crown[1]), wood))
        return True

    def basket(self, xy: FloatArray, facing: float) -> None:
        """A basketball hoop: a post, and a board 0.6 m from it towards x · `facing`, where `facing` is 1 or -1."""
        base = float(self._terrain.height(xy[None])[0])
        if self._free([(*xy, 0.3)]):
            self.solids.append(
                Pole(np.array([*xy, base - _BURIED_M]), 0.1, 3.2 + _BURIED_M, materials.STEEL_POLE)
            )
            self._add_box(
                xy + np.array([0.6 * facing, 0.0]),
                0.0,
                base + 2.9,
                np.array([0.06, 1.8, 1.05]),
                materials.METAL,
            )
