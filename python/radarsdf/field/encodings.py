# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Encodings of positions and directions as modules: what the networks see instead of coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from radarsdf._core import Encoding, VertexTable
from radarsdf.field import kernels


class VertexFeatures(nn.Module):
    """Learnable vectors of 8 floats at the vertices of the occupied cells.

    Parameters
    ----------
    leaf_keys : ndarray
        (C,) uint64, Morton keys of the occupied leaf cells, ascending (``CellSet.sorted_keys``).
    leaf_size_m : float
        Edge of a cell of the finest level, m.
    num_levels : int
        Each level's cells are twice as large as those of the level before.
    num_threads : int
        For building the table; 0: as many as OpenMP uses.
    """

    encoding: Encoding

    def __init__(
        self, leaf_keys: NDArray[np.uint64], leaf_size_m: float, num_levels: int, num_threads: int = 0
    ) -> None:
        super().__init__()
        self.table = VertexTable(leaf_keys, leaf_size_m, num_levels, self.encoding, num_threads)
        self.features = nn.Parameter(kernels.large_zeros(self.table.num_rows, kernels.FEATURE_DIM))

    @property
    def interpolated_dim(self) -> int:
        """Numbers that are interpolated for a point."""
        return kernels.FEATURE_DIM * self.table.num_levels

    def initialise(self, std: float) -> None:
        """Draws the features from N(0, std²)."""
        nn.init.normal_(self.features, std=std)

    def interpolated(self, points: Tensor) -> Tensor:
        """(N, `interpolated_dim`)."""
        return kernels.interpolate(self.features, points, self.table)

    def occupied(self, points: Tensor) -> Tensor:
        """Whether each point (N, 3), local frame, m, lies in an occupied leaf cell: (N,) bool."""
        return kernels.locate(points, self.table)[:, 0] >= 0


class TriQuadtree(VertexFeatures):
    """Quadtrees on the planes xy, xz, yz: planes summed, levels concatenated (3QFP, ICRA 2024).

    ``forward`` takes points (N, 3), local frame, m, and returns (N, 8 · num_levels).
    """

    encoding = Encoding.TRI_QUADTREE

    @property
    def dim(self) -> int:
        return self.interpolated_dim

    def forward(self, points: Tensor) -> Tensor:
        return self.interpolated(points)


class Octree(VertexFeatures):
    """Features at the eight corners of the cells in space, trilinear, levels summed (SHINE-Mapping, ICRA 2023).

    ``forward`` takes points (N, 3), local frame, m, and returns (N, 8).
    """

    encoding = Encoding.OCTREE
    dim = kernels.FEATURE_DIM

    def forward(self, points: Tensor) -> Tensor:
        levels = self.interpolated(points)
        return levels.view(-1, self.table.num_levels, kernels.FEATURE_DIM).sum(1)


class Fourier(nn.Module):
    """Sine and cosine of 2^k·π·x / half_width for a range of k (3QFP's positional encoding).

    ``forward`` takes points (N, 3), local frame, m, and returns (N, 6 · num_frequencies).
    """

    def __init__(self, half_width_m: float, first_frequency: int, num_frequencies: int) -> None:
        super().__init__()
        self.half_width_m = half_width_m
        self.first_frequency = first_frequency
        self.num_frequencies = num_frequencies

    @property
    def dim(self) -> int:
        return 6 * self.num_frequencies

    def forward(self, points: Tensor) -> Tensor:
        return kernels.fourier(points, self.half_width_m, self.first_frequency, self.num_frequencies)


class SphericalHarmonics(nn.Module):
    """Real spherical harmonics of degree 0 to 3 ("degree 4" of the paper): unit vectors (N, 3) to (N, 16)."""

    dim = kernels.NUM_SPHERICAL_HARMONICS

    def forward(self, directions: Tensor) -> Tensor:
        return kernels.spherical_harmonics(directions)
