"""The field of stage 1: signed distances at the corners of leaf cells."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from radarsdf._core import Encoding, VertexTable
from radarsdf.arrays import Floats32, Keys
from radarsdf.field import kernels
from radarsdf.field.field import Field


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
        values = kernels.view(self.distances_m)
        return torch.from_numpy(self.table.trilinear(values, kernels.view(points), torch.get_num_threads()))

    def corner_distances_m(self) -> Floats32:
        return np.asarray(self.distances_m.detach().numpy())

    @cached_property
    def _corners_of_cells(self) -> Tensor:
        """Rows (C, 8) of `distances_m`, int32, in C order of the corners."""
        return torch.from_numpy(self.table.leaf_vertices()[1])
