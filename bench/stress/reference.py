# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Interpolation in float64, in plain NumPy, for a million points: what the kernels are measured against.

Only the position in units of cells is rounded as in the kernel: on a border, a rounding decides which of two cells a
point is in, both are right, and the gradients by the points differ.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from radarsdf import _core

Array = NDArray[Any]
_BIAS = 1 << 20


def morton(coordinates: Array) -> Array:
    """(…, 3) lattice coordinates as interleaved bits, (…,) uint64."""
    key = np.zeros(coordinates.shape[:-1], np.uint64)
    for bit, axis in itertools.product(range(21), range(3)):
        value = (coordinates[..., axis].astype(np.int64) >> bit) & 1
        key |= value.astype(np.uint64) << np.uint64(3 * bit + axis)
    return key


@dataclass(frozen=True)
class Level:
    """One level of cells: biased coordinates, sorted keys, and for each group of axes the keys of its vertices."""

    cell_keys: Array
    vertex_keys: list[Array]
    first_rows: list[int]


class Reference:
    """The sums of csrc/interpolation_kernels.hpp on a set of leaf cells (C, 3).

    Each method returns the sum and its scale: the sum of its terms' absolute values, with 1 in place of each linear
    basis function f and 1 - f. An error divided by the scale is what rounding can be blamed for: terms may cancel, and
    beside a vertex f is known to a rounding of 1, not of itself.
    """

    def __init__(self, leaf_cells: Array, leaf_size_m: float, num_levels: int, encoding: Any) -> None:
        planar = encoding == _core.Encoding.TRI_QUADTREE
        self.groups: list[tuple[int, ...]] = [(0, 1), (0, 2), (1, 2)] if planar else [(0, 1, 2)]
        self.leaf_size_m = leaf_size_m
        self.levels: list[Level] = []
        self.num_rows = 0
        for level in range(num_levels):
            cells = np.unique((leaf_cells.astype(np.int64) + _BIAS) >> level, axis=0)
            keys, first = [], []
            for group in self.groups:
                keys.append(np.unique(morton(self._corners(cells, group))))  # rows are in Morton order
                first.append(self.num_rows)
                self.num_rows += len(keys[-1])
            self.levels.append(Level(np.sort(morton(cells)), keys, first))

    def _by_level(self, out_grad: Array) -> Array:
        return out_grad.astype(np.float64).reshape(len(out_grad), len(self.levels), 8)

    @staticmethod
    def _corners(cells: Array, group: tuple[int, ...]) -> Array:
        """(N, 2^axes, 3) vertices of cells (N, 3), zero along the axes that the group leaves out."""
        steps = np.zeros((2 ** len(group), 3), np.int64)
        for i, axis in enumerate(group):
            steps[:, axis] = np.arange(len(steps)) >> i & 1
        used = np.isin(np.arange(3), group)
        corners: Array = cells[:, None, :] * used + steps
        return corners

    def _located(self, points: Array, level: int) -> tuple[Array, Array, Array]:
        """Whether each point is in a cell, its biased cell, and where in it, in float64."""
        inverse = points.dtype.type(1.0 / self.leaf_size_m)
        leaf = np.floor(points * inverse).astype(np.int64) + _BIAS
        cell = leaf >> level
        keys = self.levels[level].cell_keys
        found = np.searchsorted(keys, morton(cell))
        inside = keys[np.minimum(found, len(keys) - 1)] == morton(cell)
        # The kernels' own rounding of the position in cells, 2^-24 of it in float32 (0.03 mm at 500 m), is that of the
        # coordinates once more. What is measured is all the rest.
        u = (points * inverse).astype(np.float64) / 2**level
        return inside, cell, u - (cell - (_BIAS >> level))

    def _terms(self, points: Array, directions: Array | None) -> Any:
        """For each level and group: level, points inside, rows (N, K), W (N, K, 2) and dW/dx (N, K, 3, 2).

        Of the pair at the end, the second is the scale.
        """
        inverse = np.float64(points.dtype.type(1.0 / self.leaf_size_m))
        for level, group_number in itertools.product(range(len(self.levels)), range(len(self.groups))):
            group = self.groups[group_number]
            inside, cell, fraction = self._located(points, level)
            corner_keys = morton(self._corners(cell[inside], group))
            known = self.levels[level]
            rows = known.first_rows[group_number] + np.searchsorted(
                known.vertex_keys[group_number], corner_keys
            )
            f = fraction[inside]
            v = None
            if directions is not None:
                along = directions[inside].astype(np.float64).T
                v = np.stack([along, np.abs(along)], -1)  # (3, N, 2): v[axis] scales a basis and its scale
            corners = 2 ** len(group)
            weights = np.zeros((len(f), corners, 2))
            gradients = np.zeros((len(f), corners, 3, 2))
            for c in range(corners):
                upper = np.array([c >> group.index(axis) & 1 if axis in group else 0 for axis in range(3)])
                factors = np.where(upper, f, 1 - f)
                slopes = np.where(upper, 1, -1) * inverse / 2**level

                def basis(*derived: int, parts: tuple[Array, Array] = (factors, slopes)) -> Array:
                    """Product of the basis functions, or of the derivatives along some axes, and its scale: (N, 2)."""
                    product = np.ones((len(parts[0]), 2))
                    for axis in group:  # noqa: B023 - called within this iteration
                        if axis in derived:
                            product *= [parts[1][axis], abs(parts[1][axis])]
                        else:
                            product[:, 0] *= parts[0][:, axis]
                    return product

                if v is None:
                    weights[:, c] = basis()
                for axis in group:
                    if v is None:
                        gradients[:, c, axis] = basis(axis)
                        continue
                    weights[:, c] += v[axis] * basis(axis)
                    for other in set(group) - {axis}:
                        gradients[:, c, axis] += v[other] * basis(axis, other)
            yield level, inside, rows, weights, gradients

    def interpolate(self, features: Array, points: Array, directions: Array | None) -> tuple[Array, Array]:
        """(N, 8 · levels) y = W F."""
        out = np.zeros((len(points), len(self.levels), 8, 2))
        F = features.astype(np.float64)
        for level, inside, rows, weights, _ in self._terms(points, directions):
            for c in range(rows.shape[1]):
                out[inside, level, :, 0] += weights[:, c, 0, None] * F[rows[:, c]]
                out[inside, level, :, 1] += weights[:, c, 1, None] * np.abs(F[rows[:, c]])
        flat = out.reshape(len(points), 8 * len(self.levels), 2)
        return flat[..., 0], flat[..., 1]

    def scatter(self, out_grad: Array, points: Array, directions: Array | None) -> tuple[Array, Array]:
        """(num_rows, 8) Wᵀ g."""
        total = np.zeros((self.num_rows, 8, 2))
        g = self._by_level(out_grad)
        for level, inside, rows, weights, _ in self._terms(points, directions):
            for d, c in itertools.product(range(8), range(rows.shape[1])):
                term = weights[:, c] * np.stack([g[inside, level, d], np.abs(g[inside, level, d])], -1)
                for k in range(2):
                    total[:, d, k] += np.bincount(rows[:, c], term[:, k], self.num_rows)
        return total[..., 0], total[..., 1]

    def coordinate_gradient(
        self, features: Array, out_grad: Array, points: Array, directions: Array | None
    ) -> tuple[Array, Array]:
        """(N, 3) d(W F · g)/dx."""
        total = np.zeros((len(points), 3, 2))
        F, g = features.astype(np.float64), self._by_level(out_grad)
        for level, inside, rows, _, gradients in self._terms(points, directions):
            for c in range(rows.shape[1]):
                product = F[rows[:, c]] * g[inside, level]
                sums = np.stack([product.sum(1), np.abs(product).sum(1)], -1)
                total[inside] += gradients[:, c] * sums[:, None, :]
        return total[..., 0], total[..., 1]
