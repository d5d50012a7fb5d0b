# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Interpolation in NumPy and float64: the reference for the errors of the kernels.

Only the position in units of cells is rounded as in the kernel. On the border of two cells, this rounding decides in
which of them a point is. Both are correct, but their gradients by the position differ.
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
    """Morton keys (…,) uint64 of lattice coordinates (…, 3): their interleaved bits."""
    key = np.zeros(coordinates.shape[:-1], np.uint64)
    for bit, axis in itertools.product(range(21), range(3)):
        value = (coordinates[..., axis].astype(np.int64) >> bit) & 1
        key |= value.astype(np.uint64) << np.uint64(3 * bit + axis)
    return key


@dataclass(frozen=True)
class Level:
    """Sorted Morton keys of the cells of one level; sorted keys of the vertices and first row of each group of axes."""

    cell_keys: Array
    vertex_keys: list[Array]
    first_rows: list[int]


class Reference:
    """The sums of the interpolation kernels of csrc/ on a set of leaf cells (C, 3).

    Each method returns the sum and its scale: the sum of the absolute values of its terms, with 1 instead of each
    linear basis function f and 1 - f. Rounding errors are proportional to this scale, not to the sum: terms may cancel,
    and near a vertex the rounding error of f is that of 1.
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
        """Vertices (N, 2^axes, 3) of cells (N, 3), with zeros along the axes that are not in the group."""
        steps = np.zeros((2 ** len(group), 3), np.int64)
        for i, axis in enumerate(group):
            steps[:, axis] = np.arange(len(steps)) >> i & 1
        used = np.isin(np.arange(3), group)
        corners: Array = cells[:, None, :] * used + steps
        return corners

    def _located(self, points: Array, level: int) -> tuple[Array, Array, Array]:
        """Mask of the points in occupied cells (N,), their biased cells (N, 3), and positions in the cells (N, 3)."""
        inverse = points.dtype.type(1.0 / self.leaf_size_m)
        leaf = np.floor(points * inverse).astype(np.int64) + _BIAS
        cell = leaf >> level
        keys = self.levels[level].cell_keys
        found = np.searchsorted(keys, morton(cell))
        inside = keys[np.minimum(found, len(keys) - 1)] == morton(cell)
        # The rounding of the position in cells is 2^-24 of it in float32 (0.03 mm at 500 m), as that of the coordinates
        # themselves. It is not part of the error.
        u = (points * inverse).astype(np.float64) / 2**level
        return inside, cell, u - (cell - (_BIAS >> level))

    def _terms(self, points: Array, directions: Array | None) -> Any:
        """For each level and group: level, mask of points, rows (N, K), W (N, K, 2) and dW/dx (N, K, 3, 2).

        The last axis holds the value and its scale.
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
                v = np.stack([along, np.abs(along)], -1)  # (3, N, 2): factors of a value and of its scale
            corners = 2 ** len(group)
            weights = np.zeros((len(f), corners, 2))
            gradients = np.zeros((len(f), corners, 3, 2))
            for c in range(corners):
                upper = np.array([c >> group.index(axis) & 1 if axis in group else 0 for axis in range(3)])
                factors = np.where(upper, f, 1 - f)
                slopes = np.where(upper, 1, -1) * inverse / 2**level

                def basis(*derived: int, parts: tuple[Array, Array] = (factors, slopes)) -> Array:
                    """Product of the basis functions, with derivatives along some axes, and its scale: (N, 2)."""
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
        """Features y = W F, (N, 8 · levels)."""
        out = np.zeros((len(points), len(self.levels), 8, 2))
        F = features.astype(np.float64)
        for level, inside, rows, weights, _ in self._terms(points, directions):
            for c in range(rows.shape[1]):
                out[inside, level, :, 0] += weights[:, c, 0, None] * F[rows[:, c]]
                out[inside, level, :, 1] += weights[:, c, 1, None] * np.abs(F[rows[:, c]])
        flat = out.reshape(len(points), 8 * len(self.levels), 2)
        return flat[..., 0], flat[..., 1]

    def scatter(self, out_grad: Array, points: Array, directions: Array | None) -> tuple[Array, Array]:
        """Gradient Wᵀ g of the features, (num_rows, 8)."""
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
        """Gradient d(W F · g)/dx of the positions, (N, 3)."""
        total = np.zeros((len(points), 3, 2))
        F, g = features.astype(np.float64), self._by_level(out_grad)
        for level, inside, rows, _, gradients in self._terms(points, directions):
            for c in range(rows.shape[1]):
                product = F[rows[:, c]] * g[inside, level]
                sums = np.stack([product.sum(1), np.abs(product).sum(1)], -1)
                total[inside] += gradients[:, c] * sums[:, None, :]
        return total[..., 0], total[..., 1]
