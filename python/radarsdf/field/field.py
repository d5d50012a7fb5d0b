# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a map asks a field: signed distance, its gradient, and intensity, at points of the local frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from radarsdf._core import VertexTable
from radarsdf.field import kernels
from radarsdf.returns.reflectance import Reflectance


class LeafCorners(NamedTuple):
    """Signed distances at the corners of all leaf cells."""

    corners: NDArray[np.int32]  # (V, 3) lattice coordinates: so many leaf cells from the origin
    of_cells: NDArray[np.int32]  # (C, 8) rows of `corners` for each leaf cell, in C order
    distances_m: NDArray[np.float32]  # (V,)


class Field(nn.Module, ABC):
    """A signed distance field on leaf cells. :class:`GridField` and :class:`NeuralField` are the two kinds.

    Attributes
    ----------
    table : VertexTable
        The leaf cells, and the rows of what is stored at their corners.
    reflectance : Reflectance or None
        Intensities in closed form, or what a network leaves of them.
    """

    table: VertexTable

    def __init__(self) -> None:
        super().__init__()
        self.reflectance: Reflectance | None = None

    @abstractmethod
    def sdf(self, points: Tensor) -> Tensor:
        """Signed distance (N,), m, positive in free space, at points (N, 3), local frame, m. Autograd differentiates it."""

    def gradient(self, points: Tensor) -> Tensor:
        """(N, 3) gradient of :meth:`sdf`, towards free space."""
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            return torch.autograd.grad(self.sdf(points).sum(), points)[0]

    @abstractmethod
    def intensity(self, points: Tensor, directions: Tensor, ranges_m: Tensor) -> Tensor:
        """Intensity (N,), scaled to about [0, 1], of the returns from points (N, 3), local frame, m.

        `directions` (N, 3): unit vectors from the sensor; `ranges_m` (N,): distances from it.
        """

    def occupied(self, points: Tensor) -> Tensor:
        """(N,) bool, whether each point (N, 3), local frame, m, lies in an occupied leaf cell."""
        return kernels.locate(points, self.table)[:, 0] >= 0

    def leaf_corners(self) -> LeafCorners | None:
        """Distances at the corners of all leaf cells. None: they are not stored, and :meth:`sdf` must be asked."""
        return None

    @property
    def smooth_in_cells(self) -> bool:
        """Whether a change of sign inside a leaf cell shows at its corners."""
        return True

    def _closed_form(self, points: Tensor, directions: Tensor, ranges_m: Tensor) -> Tensor:
        """What :attr:`reflectance` adds (N,) to the intensity."""
        if self.reflectance is None:
            return torch.zeros_like(ranges_m)
        found = self.reflectance.at(points.numpy(), directions.numpy(), ranges_m.numpy(), 1)
        return torch.from_numpy(found)
