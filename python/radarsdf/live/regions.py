# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Columns whose rows belong to cells, kept region by region: what is near a change is found without asking the rest."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import cell_keys
from radarsdf.live.rows import Keys, steps_round
from radarsdf.returns.sums import lattice_of

Rows = dict[str, NDArray[Any]]

REGION_CELLS = 64
"""Leaf cells along the edge of a region."""

REGION_BITS = np.uint64(18)
"""Bits by which the key of a leaf cell is longer than that of its region."""

_FARTHEST = 15_600  # region along each axis: keys reach a million cells


def regions_of(leaf_keys: Keys) -> Keys:
    """Keys of the regions of these leaf cells, ascending, each once."""
    return np.unique(leaf_keys >> REGION_BITS)


def regions_round(regions: Keys, reach: int) -> Keys:
    """Keys of these regions, and of those at most so many away along each axis."""
    cubes = (cubes_of(regions)[:, None] + steps_round(reach)).reshape(-1, 3)
    return np.unique(_regions_at(np.unique(np.clip(cubes, -_FARTHEST, _FARTHEST - 1), axis=0)))


def cubes_of(regions: Keys) -> NDArray[np.int64]:
    """(R, 3) positions of regions: that of i spans [i, i + 1) times their edge."""
    return lattice_of(regions << REGION_BITS) // REGION_CELLS


def _regions_at(cubes: NDArray[np.int64]) -> Keys:
    """(R,) keys of the regions at these positions (R, 3)."""
    places = (REGION_CELLS * cubes).astype(np.float64) + 0.5
    return cell_keys(np.ascontiguousarray(places), 1.0, 1) >> REGION_BITS


class RegionTable:
    """Rows by the Morton keys of their cells, ascending, in regions.

    Parameters
    ----------
    leaves_per_cell : int
        Edge of a cell, leaf cells: 1, or 2.
    columns : ndarray
        Without rows: what types and shapes they have.
    """

    def __init__(self, leaves_per_cell: int = 1, **columns: NDArray[Any]) -> None:
        self._merged = leaves_per_cell.bit_length() - 1
        self._empty: Rows = {"keys": np.zeros(0, np.uint64), **columns}
        self._parts: dict[int, Rows] = {}
        self.num_bytes = 0
        """Memory of the rows, bytes."""

    @property
    def regions(self) -> Keys:
        """Keys of the regions that have rows, ascending."""
        return np.array(sorted(self._parts), np.uint64)

    @property
    def num_rows(self) -> int:
        """Number of all rows."""
        return sum(len(part["keys"]) for part in self._parts.values())

    def gather(self, regions: Keys) -> Rows:
        """The rows of `regions` (R,), ascending, in the order of their keys."""
        parts = [self._parts[region] for region in regions.tolist() if region in self._parts]
        return {
            name: np.concatenate([none, *(part[name] for part in parts)])
            for name, none in self._empty.items()
        }

    def put(self, regions: Keys, rows: Rows) -> None:
        """All rows of `regions` (R,), ascending, become those of `rows` that are in them."""
        of_rows = self.regions_of(rows["keys"])
        ends = np.searchsorted(of_rows, regions, side="right").tolist()
        starts = np.searchsorted(of_rows, regions).tolist()
        for region, start, end in zip(regions.tolist(), starts, ends, strict=True):
            self.num_bytes -= sum(column.nbytes for column in self._parts.pop(region, {}).values())
            if start == end:
                continue
            part = self._parts[region] = {name: column[start:end].copy() for name, column in rows.items()}
            self.num_bytes += sum(column.nbytes for column in part.values())

    def regions_of(self, keys: Keys) -> Keys:
        """(N,) keys of the regions of cells with these `keys` (N,), ascending, of this table."""
        if self._merged == 0:
            return keys >> REGION_BITS
        bits = REGION_BITS - np.uint64(3 * self._merged)
        regions, rows = np.unique(keys >> bits, return_inverse=True)
        return _regions_at(lattice_of(regions << bits) // (REGION_CELLS >> self._merged))[rows]
