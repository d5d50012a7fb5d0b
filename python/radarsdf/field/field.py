"""Fields: signed distance, its gradient, and intensity, at points of the local frame; and the averaged field."""

from abc import ABC, abstractmethod
from functools import cached_property

import torch
from torch import Tensor, nn

from radarsdf._core import Encoding, VertexTable
from radarsdf.arrays import Floats32, Keys
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


class GridField(Field):
    """Signed distances `distances_m` (V,) at the corners of leaf cells, interpolated trilinearly. 0 outside the cells.

    `leaf_keys` (C,): Morton keys of the occupied leaf cells, ascending. The distances are not initialised.
    """

    def __init__(self, leaf_keys: Keys, leaf_size_m: float, num_threads: int = 0) -> None:
        super().__init__()
        self.table = VertexTable(leaf_keys, leaf_size_m, 1, Encoding.OCTREE, num_threads)
        self.distances_m = nn.Parameter(torch.empty(self.table.num_rows, dtype=torch.float32, device="cpu"))

    def sdf(self, points: Tensor) -> Tensor:
        if not torch.is_grad_enabled():
            return self.plane(points)[:, 0].contiguous()
        cells = kernels.locate(points, self.table)[:, 0]
        inside = cells >= 0
        corners = self._corners_of_cells.index_select(0, cells.clamp(min=0)).view(-1)
        values = self.distances_m.index_select(0, corners).view(-1, 2, 2, 2)
        # The core's rounding, or a point could be in another cell.
        place = points * (1 / self.table.leaf_size_m)
        x, y, z = (place - place.detach().floor()).unbind(1)
        values = torch.lerp(values[:, 0], values[:, 1], x[:, None, None])
        values = torch.lerp(values[:, 0], values[:, 1], y[:, None])
        return torch.where(inside, torch.lerp(values[:, 0], values[:, 1], z), 0.0)

    def plane(self, points: Tensor) -> Tensor:
        values, x = kernels.view(self.distances_m), kernels.view(points)
        return torch.from_numpy(self.table.trilinear(values, x, torch.get_num_threads()))

    def corner_distances_m(self) -> Floats32:
        return kernels.view(self.distances_m)

    @cached_property
    def _corners_of_cells(self) -> Tensor:
        """Rows (C, 8) of `distances_m`, int32, in C order of the corners."""
        return torch.from_numpy(self.table.leaf_vertices()[1])
