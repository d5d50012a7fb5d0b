# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The ground: a smooth height field, a sum of plane waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .materials import Material
from .primitives import cos_incidence

__all__ = ["Terrain"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Terrain:
    """Height field z(x, y) = level + Σ amplitude · sin(wave · (x, y) + phase), solid below and without an edge.

    World frame, m, z up.
    """

    waves: FloatArray  # (K, 2) wave vectors [rad/m]
    amplitudes: FloatArray  # (K,) [m]
    phases: FloatArray  # (K,) [rad]
    level_m: float
    material: Material

    @classmethod
    def random(cls, rng: np.random.Generator, roughness_m: float, material: Material) -> Terrain:
        """Rolling ground of five octaves with two waves each, of about 40 m down to 2.5 m.

        Parameters
        ----------
        rng : Generator
            Draws directions, phases and wavelengths.
        roughness_m : float
            Amplitude of the longest waves, m. Each halving of the wavelength divides the amplitude by 2.5.
        material : Material
            Material of the ground.

        Returns
        -------
        Terrain
            Ground with mean height 0.
        """
        octave = np.repeat(np.arange(5), 2)
        length = 40.0 / 2.0**octave * rng.uniform(0.8, 1.25, size=10)
        heading = rng.uniform(0, 2 * np.pi, size=10)
        waves = 2 * np.pi / length[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        amplitudes = np.asarray(roughness_m / 2.5**octave, dtype=np.float64)
        return cls(waves, amplitudes, rng.uniform(0, 2 * np.pi, size=10), 0.0, material)

    def height(self, xy: FloatArray) -> FloatArray:
        """Height (N,), m, of the ground at the positions (N, 2), world, m."""
        height: FloatArray = self.level_m + np.sin(xy @ self.waves.T + self.phases) @ self.amplitudes
        return height

    def slope(self, xy: FloatArray) -> FloatArray:
        """Gradient (N, 2) of the height at the positions (N, 2), world, m."""
        slope: FloatArray = (np.cos(xy @ self.waves.T + self.phases) * self.amplitudes) @ self.waves
        return slope

    def normals(self, xy: FloatArray) -> FloatArray:
        """Upward unit normals (N, 3) at the positions (N, 2), world, m."""
        normals = np.concatenate([-self.slope(xy), np.ones((len(xy), 1))], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return normals

    def intersect(
        self, origins: FloatArray, directions: FloatArray, max_range_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """First hits of (N, 3) rays from above the ground; see `Primitive.intersect`.

        Each ray advances until it is below the ground. The steepest possible slope bounds the length of a safe step,
        but a step is at least 10 cm + 1 % of the range, so a crest of millimetres can be missed. Newton's method then
        finds the crossing within the last step.
        """
        steepest = float(np.abs(self.amplitudes) @ np.linalg.norm(self.waves, axis=1))
        top = self.level_m + float(np.abs(self.amplitudes).sum())
        dz = directions[:, 2]
        closing = np.linalg.norm(directions[:, :2], axis=1) * steepest - dz
        # Rays from above the highest crest start at its height.
        above = origins[:, 2] > top
        start = np.where(above, (origins[:, 2] - top) / np.maximum(-dz, 1e-9), 0.0)
        t, before = start, start.copy()
        hit = np.zeros(len(t), dtype=bool)
        active = np.flatnonzero(start <= max_range_m)
        while len(active):
            p = origins[active] + t[active, None] * directions[active]
            gap = p[:, 2] - self.height(p[:, :2])
            below = gap <= 0
            hit[active[below]] = True
            gone = ~below & ((t[active] > max_range_m[active]) | ((p[:, 2] > top) & (dz[active] >= 0)))
            keep = ~below & ~gone
            active, gap = active[keep], gap[keep]
            step = np.maximum(gap / np.maximum(closing[active], 1e-9), 0.1 + 0.01 * t[active])
            before[active] = t[active]
            t[active] += step
        rows = np.flatnonzero(hit)
        o, d, low, high = origins[rows], directions[rows], before[rows], t[rows]
        x = high.copy()
        for _ in range(6):
            p = o + x[:, None] * d
            gap = p[:, 2] - self.height(p[:, :2])
            low, high = np.where(gap > 0, x, low), np.where(gap > 0, high, x)
            rate = d[:, 2] - np.einsum("ni,ni->n", self.slope(p[:, :2]), d[:, :2])
            newton = x - gap / np.where(np.abs(rate) < 1e-9, -1e-9, rate)
            x = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        result, normals = np.full(len(t), np.inf), np.zeros_like(directions)
        result[rows] = np.where(x <= max_range_m[rows], x, np.inf)
        normals[rows] = self.normals((o + x[:, None] * d)[:, :2])
        return result, normals

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """Distances (N,) of points (N, 3) to the ground, negative below.

        Exact for points that are nearer to the ground than its radius of curvature, some metres. Farther away the
        result is the distance to some point of the ground: it may be too large, never too small.
        """
        foot = points[:, :2].copy()
        vertical = points[:, 2] - self.height(foot)
        best = np.abs(vertical)
        for _ in range(8):
            on = np.concatenate([foot, self.height(foot)[:, None]], axis=1)
            best = np.minimum(best, np.linalg.norm(points - on, axis=1))
            normals = self.normals(foot)
            along = np.einsum("ni,ni->n", points - on, normals)
            foot = points[:, :2] - along[:, None] * normals[:, :2]
        return np.copysign(best, vertical)

    def echo_db(self, points: FloatArray, directions: FloatArray, normals: FloatArray) -> FloatArray:
        """See `Primitive.echo_db`."""
        return self.material.echo_db(points, cos_incidence(directions, normals))
