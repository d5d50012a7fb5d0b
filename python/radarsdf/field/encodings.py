# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Encodings of positions and directions, the inputs of the networks, as PyTorch modules."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from radarsdf._core import FEATURE_DIM, Encoding, VertexTable
from radarsdf.field import kernels

_FEATURE_STD = 0.05  # standard deviation of the features at the start (3QFP)


class VertexFeatures(nn.Module):
    """A learnable feature, 8 floats, at each vertex of the occupied cells, interpolated inside the cells.

    `leaf_keys` (C,): Morton keys of the occupied leaf cells, ascending. The cells of each of the levels are twice as large as
    those of the level before.
    """

    encoding: Encoding

    def __init__(
        self, leaf_keys: NDArray[np.uint64], leaf_size_m: float, num_levels: int, num_threads: int = 0
    ) -> None:
        super().__init__()
        self.table = VertexTable(leaf_keys, leaf_size_m, num_levels, self.encoding, num_threads)
        self.features = nn.Parameter(kernels.large_zeros(self.table.num_rows, FEATURE_DIM))

    @property
    def interpolated_dim(self) -> int:
        """Interpolated numbers of a point: 8 for each level."""
        return FEATURE_DIM * self.table.num_levels

    def initialise(self, generator: torch.Generator) -> None:
        """Draws the features from N(0, 0.05²) (3QFP)."""
        nn.init.normal_(self.features, std=_FEATURE_STD, generator=generator)

    def forward(self, points: Tensor) -> Tensor:
        """Encoding (N, width) of points (N, 3), local frame, m."""
        return self.combine(kernels.interpolate(self.features, points, self.table))

    @abstractmethod
    def combine(self, interpolated: Tensor) -> Tensor:
        """The encoding (N, width) from the interpolated features (N, `interpolated_dim`)."""


class TriQuadtree(VertexFeatures):
    """Features on quadtrees in the planes xy, xz and yz (3QFP, ICRA 2024).

    The encoding has the sum over the planes, side by side for all levels: (N, 8 · num_levels).
    """

    encoding = Encoding.TRI_QUADTREE

    def combine(self, interpolated: Tensor) -> Tensor:
        return interpolated


class Octree(VertexFeatures):
    """Features at the corners of an octree's cells, interpolated trilinearly (SHINE-Mapping, ICRA 2023).

    The encoding is the sum over the levels: (N, 8).
    """

    encoding = Encoding.OCTREE

    def combine(self, interpolated: Tensor) -> Tensor:
        return interpolated.view(-1, self.table.num_levels, FEATURE_DIM).sum(1)


class Fourier(nn.Module):
    """Sine and cosine of 2^k·π·x / half_width for k = 0, 1, … (3QFP's positional encoding).

    ``forward`` takes points (N, 3), local frame, m, and returns (N, 6 · num_frequencies).
    """

    def __init__(self, half_width_m: float, num_frequencies: int) -> None:
        super().__init__()
        self.half_width_m = half_width_m
        self.num_frequencies = num_frequencies

    def forward(self, points: Tensor) -> Tensor:
        return kernels.fourier(points, self.half_width_m, 0, self.num_frequencies)
