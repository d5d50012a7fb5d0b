"""Interface of fields: signed distance, its gradient, and intensity, at points of the local frame."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from radarsdf._core import VertexTable
from radarsdf.arrays import Floats32
from radarsdf.field import kernels
from radarsdf.returns.reflectance import Reflectance


class Field(nn.Module, ABC):
    """Signed distance field on leaf cells. :class:`GridField` and :class:`NeuralField` implement it.

    Attributes
    ----------
    table : VertexTable
        The leaf cells, and the rows of the values stored at their corners.
    reflectance : Reflectance or None
        Closed-form intensities, or the residuals of a network.
    """

    table: VertexTable

    def __init__(self) -> None:
        super().__init__()
        self.reflectance: Reflectance | None = None

    @abstractmethod
    def sdf(self, points: Tensor) -> Tensor:
        """Return differentiable signed distances (N,), m, positive in free space, at points (N, 3), local frame, m."""

    def plane(self, points: Tensor) -> Tensor:
        """Return :meth:`sdf` and its gradient, pointing to free space, (N, 4), without a graph."""
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            sdf = self.sdf(points)
            (gradient,) = torch.autograd.grad(sdf.sum(), points)
        return torch.cat([sdf.detach()[:, None], gradient], 1)

    def intensity(self, points: Tensor, directions: Tensor, ranges_m: Tensor) -> Tensor:
        """Return intensities (N,), scaled to about [0, 1], of returns from points (N, 3), local frame, m.

        `directions` (N, 3): unit vectors from the sensor; `ranges_m` (N,): distances from it.
        """
        # The closed form is unbounded; intensities beyond the range of the returns were never measured.
        return self._closed_form(points, directions, ranges_m).clamp(0, 1)

    def occupied(self, points: Tensor) -> Tensor:
        """Return a mask (N,) of the points (N, 3), local frame, m, in occupied leaf cells."""
        return kernels.locate(points, self.table)[:, 0] >= 0

    def corner_distances_m(self) -> Floats32 | None:
        """Return the distances of which :meth:`sdf` is the trilinear interpolation, by row of the table; None if it is not."""
        return None

    @property
    def smooth_in_cells(self) -> bool:
        """Whether the signs at the corners of a leaf cell reveal any zero crossing inside."""
        return True

    def _closed_form(self, points: Tensor, directions: Tensor, ranges_m: Tensor) -> Tensor:
        """Return the contribution (N,) of :attr:`reflectance` to the intensity."""
        if self.reflectance is None:
            return torch.zeros_like(ranges_m)
        return torch.from_numpy(self.reflectance.at(points.numpy(), directions.numpy(), ranges_m.numpy(), 1))
