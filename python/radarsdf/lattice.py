"""The lattice of the world, shared by all maps, so that their cells coincide."""

from typing import NamedTuple

import numpy as np

from radarsdf.arrays import ArrayLike, Floats, Ints

# Walls and floors often have a coordinate of zero or a round number. On a face between cells, noise would scatter the
# returns of one wall to both sides. With this shift, no such plane is a face of cells of any size: a third of a block is a
# third or two thirds of a cell at each level, since 1/3 is 0.0101... in binary. Measured: 0.1 to 0.8 points of F-score more,
# and 0.1 to 0.8 fewer outliers, than with planes on faces.
_FIRST_CORNER = -1 / 3


class WorldLattice(NamedTuple):
    """Leaf cells, and blocks of them, indexed along the axes of the world."""

    cell_m: float  # edge of a leaf cell, m
    block_cells: int  # edge of a block, leaf cells: a multiple of the edge of the coarsest cell

    @property
    def block_m(self) -> float:
        return self.block_cells * self.cell_m

    def position(self, cells: ArrayLike) -> Floats:
        """Positions (..., 3), world, m, of the lower corners of leaf cells with indices (..., 3)."""
        return (np.asarray(cells) + _FIRST_CORNER * self.block_cells) * self.cell_m

    def cells(self, position: ArrayLike) -> Floats:
        """Inverse of :meth:`position`: indices (..., 3) of leaf cells, with fractions."""
        return np.asarray(position, np.float64) / self.cell_m - _FIRST_CORNER * self.block_cells

    def nearest_block(self, position: ArrayLike) -> Ints:
        """Indices (..., 3) of the leaf cells at the block corners nearest to positions (..., 3), world, m."""
        blocks = np.round(self.cells(position) / self.block_cells)
        return self.block_cells * blocks.astype(np.int64)
