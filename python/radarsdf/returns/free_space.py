"""Free-space crossings: the leaf cells that rays crossed before their returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from radarsdf._core import find_free_space
from radarsdf.arrays import Bools, Bytes, Floats32, Ints, Keys
from radarsdf.checks import check
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN, lattice_of

BLOCK_CELLS = 8
"""Edge of a block, leaf cells."""
MOST_SCANS = 7
"""Largest number of crossing scans that is counted for a cell."""

_LEVELS = 3  # octree levels of a block: 2³ cells along an edge
_PLANES, _WORDS = 4, 8
_SIGMAS = 2.0  # standard deviations before a return at which the free space of its ray ends
_INSIDE = np.arange(BLOCK_CELLS**3, dtype=np.uint64)


@dataclass(frozen=True)
class FreeSpace:
    """Free-space crossings of leaf cells, in blocks of 8 × 8 × 8."""

    keys: Keys  # (B,) Morton keys of the blocks' leaf cells without the last 9 bits, ascending
    # (B, 4, 8) bit planes of the 512 leaf cells of a block, in Morton order. Planes 0 to 2: the number of scans with a
    # ray through the cell, at most 7. Plane 3: whether the cell has returns.
    planes: Keys

    @classmethod
    def of(
        cls,
        rays: Rays,
        noise: SensorNoise,
        leaf_size_m: float,
        box_cells: Ints | None = None,
        num_threads: int = 0,
    ) -> FreeSpace:
        """Compute the crossings of `rays` to true returns in the box [lower, upper), (2, 3) leaf cells; None for no limit."""

        # Rays end two standard deviations before the return, and where the angular error exceeds one cell: beyond
        # that, the crossed cell is uncertain.
        def end_m(own: SensorNoise, ranges_m: Floats32) -> Floats32:
            before_m = ranges_m - np.float32(_SIGMAS) * np.sqrt(own.variances_m2(ranges_m))
            return np.minimum(before_m, np.float32(leaf_size_m / own.angle_rad))

        limit = [[-MAX_CELLS_FROM_ORIGIN] * 3, [MAX_CELLS_FROM_ORIGIN] * 3]
        lower, upper = limit if box_cells is None else box_cells.tolist()
        crossed_m, scans = noise.of_returns(rays, end_m), np.ascontiguousarray(rays.scans)
        box = leaf_size_m, lower, upper
        return cls(*find_free_space(*rays.in_c_order(), crossed_m, scans, *box, num_threads))

    @classmethod
    def none(cls) -> FreeSpace:
        return cls(np.zeros(0, np.uint64), np.zeros((0, _PLANES, _WORDS), np.uint64))

    def check(self) -> None:
        shaped = self.keys.ndim == 1 and self.planes.shape == (len(self.keys), _PLANES, _WORDS)
        fits = shaped and (np.diff(self.keys.astype(np.int64), prepend=-1) > 0).all()
        check(fits, "the free-space crossings are not planes of 512 cells for ascending keys")

    def dense(self, lower: ArrayLike, shape: tuple[int, int, int]) -> tuple[Bytes, Bools]:
        """Return dense arrays of crossing scans, at most 7, and of whether there are returns, from leaf cell `lower` (3,) on."""
        first = np.asarray(lower, np.int64)
        last = first + np.asarray(shape)
        begin, end = first // BLOCK_CELLS, -(-last // BLOCK_CELLS)  # blocks that the box touches
        # Block i begins at leaf cell 8 i.
        blocks = lattice_of(self.keys << np.uint64(3 * _LEVELS)) // BLOCK_CELLS
        rows = np.flatnonzero(((blocks >= begin) & (blocks < end)).all(axis=1))
        whole = tuple((end - begin).tolist())
        found = np.zeros((*whole, BLOCK_CELLS, BLOCK_CELLS, BLOCK_CELLS), np.uint8)
        found[tuple((blocks[rows] - begin).T)] = unpacked(self.planes[rows])
        cells = found.transpose(0, 3, 1, 4, 2, 5).reshape([BLOCK_CELLS * n for n in whole])
        offset = first - begin * BLOCK_CELLS
        inside = cells[tuple(slice(o, o + n) for o, n in zip(offset, shape, strict=True))]
        return inside & np.uint8(MOST_SCANS), inside > MOST_SCANS

    def at(self, leaf_keys: Keys) -> Bytes:
        """Return the number (N,) of scans that crossed the leaf cells with Morton keys (N,), at most 7."""
        if len(self.keys) == 0:
            return np.zeros(len(leaf_keys), np.uint8)
        blocks, bit = leaf_keys >> np.uint64(3 * _LEVELS), leaf_keys & _INSIDE[-1]
        rows = np.minimum(np.searchsorted(self.keys, blocks), len(self.keys) - 1)
        words = self.planes[rows, :, bit >> np.uint64(6)] >> (bit & np.uint64(63))[:, None] & np.uint64(1)
        scans = (words[:, 0] + 2 * words[:, 1] + 4 * words[:, 2]).astype(np.uint8)
        return np.where(self.keys[rows] == blocks, scans, np.uint8(0))


def unpacked(planes: Keys) -> Bytes:
    """Unpack bit planes to (B, 8, 8, 8) cells: the number of crossing scans, plus 8 where there are returns."""
    bits = np.unpackbits(planes.astype("<u8").view(np.uint8), axis=-1, bitorder="little")
    weights = np.array([1, 2, 4, 8], np.uint8)[:, None]
    return (bits * weights).sum(axis=1, dtype=np.uint8)[:, _MORTON]


_PLACES = np.ravel_multi_index(tuple((lattice_of(_INSIDE) % BLOCK_CELLS).T), (BLOCK_CELLS,) * 3)
_MORTON = np.argsort(_PLACES).reshape((BLOCK_CELLS,) * 3)  # bit of each cell
