"""Columns of cells, partitioned into regions of 64³ leaf cells for local access near changes."""

import itertools
import math

import numpy as np

from radarsdf._core import cell_keys
from radarsdf.arrays import Array, Bools, Ints, Keys
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN, lattice_of

Rows = dict[str, Array]

REGION_CELLS = 64  # leaf cells along the edge of a region
REGION_BITS = np.uint64(18)  # bits of a leaf cell's Morton key below those of its region
NO_KEYS = np.zeros(0, np.uint64)


def steps_near(reach: int) -> Ints:
    """Return all offsets ((2 reach + 1)³, 3) of at most `reach` along each axis."""
    return np.array(list(itertools.product(range(-reach, reach + 1), repeat=3)), np.int64)


def shifted(keys: Keys, steps: Ints) -> Keys:
    """Return the unique ascending keys of cells at offsets `steps` (S, 3) from `keys` (N,)."""
    return np.unique(_keys_at((lattice_of(keys)[:, None] + steps).reshape(-1, 3)))


def cubes_near(leaf_keys: Keys, edge: int, reach: int) -> Keys:
    """Return keys of the first leaf cells of cubes of `edge` (power of two) cells within `reach` cells of those of `leaf_keys`."""
    bits = np.uint64(3 * (edge.bit_length() - 1))
    corners = np.unique(leaf_keys >> bits) << bits
    return shifted(corners, edge * steps_near(math.ceil(reach / edge)))


def regions_of(leaf_keys: Keys) -> Keys:
    """Return the unique ascending keys of the regions of leaf cells."""
    return np.unique(leaf_keys >> REGION_BITS)


def within(leaf_keys: Keys, regions: Keys) -> Bools:
    """Return a mask (N,) of the leaf cells in `regions`."""
    return np.isin(leaf_keys >> REGION_BITS, regions)


def regions_near(regions: Keys, reach: int) -> Keys:
    """Return the ascending keys of these regions, and of those at most `reach` away along each axis."""
    near = shifted(regions << REGION_BITS, REGION_CELLS * steps_near(reach))
    return np.unique(near >> REGION_BITS)


def region_places(regions: Keys) -> Ints:
    """Return the lattice positions (R, 3) of regions: i spans [i, i + 1) times their edge."""
    return lattice_of(regions << REGION_BITS) // REGION_CELLS


def _keys_at(cells: Ints) -> Keys:
    # The centre of a cell of 1 m is exact in float64.
    return cell_keys(np.clip(cells, -MAX_CELLS_FROM_ORIGIN, MAX_CELLS_FROM_ORIGIN - 1) + 0.5, 1.0, 1)


class RegionTable:
    """Table by ascending Morton keys of cells, with an edge of 1 or 2 leaf cells, partitioned into regions."""

    def __init__(self, leaves_per_cell: int = 1, **columns: Array) -> None:
        """Create an empty table. `columns`: default row of each column."""
        self._leaves_per_cell = leaves_per_cell
        self._new: Rows = {"keys": np.zeros(1, np.uint64), **columns}
        self._parts: dict[int, Rows] = {}
        self.num_bytes = 0

    def gather(self, regions: Keys | None = None) -> Rows:
        """Return the rows of ascending `regions` (R,), in the order of their keys. None: all."""
        wanted = sorted(self._parts) if regions is None else regions.tolist()
        empty = {name: new[:0] for name, new in self._new.items()}
        parts = [empty, *(self._parts[region] for region in wanted if region in self._parts)]
        return {name: np.concatenate([part[name] for part in parts]) for name in empty}

    def carried(self, regions: Keys, keys: Keys) -> Rows:
        """Return rows for `keys`, all in `regions`: the existing ones, else defaults."""
        before = self.gather(regions)
        rows = {name: np.repeat(new, len(keys), axis=0) for name, new in self._new.items()}
        _, after, old = np.intersect1d(keys, before["keys"], assume_unique=True, return_indices=True)
        for name, column in rows.items():
            column[after] = before[name][old]
        return rows | {"keys": keys}

    def put(self, regions: Keys, rows: Rows) -> None:
        """Replace all rows of ascending `regions` (R,) by those of `rows` in them."""
        of_rows = self.regions_of(rows["keys"])
        ends = np.searchsorted(of_rows, regions, side="right").tolist()
        starts = np.searchsorted(of_rows, regions).tolist()
        for region, start, end in zip(regions.tolist(), starts, ends, strict=True):
            self.num_bytes -= sum(column.nbytes for column in self._parts.pop(region, {}).values())
            if start < end:
                part = self._parts[region] = {name: rows[name][start:end].copy() for name in self._new}
                self.num_bytes += sum(column.nbytes for column in part.values())

    def regions_of(self, keys: Keys) -> Keys:
        """Return the regions (N,) of this table's cells with `keys` (N,)."""
        return _keys_at(self._leaves_per_cell * lattice_of(keys)) >> REGION_BITS
