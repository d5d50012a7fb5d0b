"""Sums over the scans of a live map, one table for each radar: its noise, which weights them, changes with the scans."""

from collections.abc import Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

from radarsdf.arrays import Array, Keys
from radarsdf.core import GrowingSums, SumsChange
from radarsdf.returns.evidence import VisibilityCounts
from radarsdf.returns.noise import RigNoise, SensorNoise
from radarsdf.returns.sums import WEIGHT_UNIT, ScanSums

_MOST_RETURNS = 2**16  # in a cell, of a radar of a rig


class RadarSums:
    """Sums in cells, in parts of 1 / `WEIGHT_UNIT`, and visibility counts, of K radars. Changes are calls for :func:`at_once`, K each."""

    def __init__(self, num_radars: int) -> None:
        self._tables = [GrowingSums() for _ in range(num_radars)]

    def __len__(self) -> int:
        return len(self._tables)

    @property
    def num_cells(self) -> int:
        return sum(table.num_cells for table in self._tables)

    @property
    def num_bytes(self) -> int:
        return sum(table.num_bytes for table in self._tables)

    def apply(self, changes: Sequence[SumsChange]) -> list[partial[Any]]:
        return [partial(table.apply, change) for table, change in zip(self._tables, changes, strict=True)]

    def insert(self, columns: Sequence[Sequence[Array]]) -> list[partial[Any]]:
        """Insert blocks as :meth:`columns` returns them."""
        return [partial(table.insert, *own) for table, own in zip(self._tables, columns, strict=True)]

    def erase(self, blocks: Keys) -> list[partial[Any]]:
        return [partial(table.erase, blocks) for table in self._tables]

    def block_keys(self) -> Keys:
        """Return the ascending keys of all blocks."""
        return reduce(np.union1d, [table.block_keys() for table in self._tables])

    def columns(self, blocks: Keys) -> list[tuple[Array, ...]]:
        """Return the contents of blocks with ascending keys (B,), of each radar."""
        return [(*table.sums_of(blocks), *table.visibility_of(blocks)) for table in self._tables]

    def weighted(self, leaf_size_m: float, noise: SensorNoise, blocks: Keys | None = None) -> ScanSums:
        """Sum over the radars, weighted by the noise of each, if known, in blocks with ascending keys (B,); None: in all."""
        blocks = self.block_keys() if blocks is None else blocks
        keys, sums, scans = zip(*(table.sums_of(blocks) for table in self._tables), strict=True)
        total_scans = _total(keys, scans)[1]
        if not isinstance(noise, RigNoise):
            return ScanSums(leaf_size_m, *_total(keys, sums), total_scans, WEIGHT_UNIT)
        # Of more returns, a cell keeps mean and scatter: products would overflow once a robot is parked for half an hour.
        bounded = (own // (1 + own[:, :1] // (WEIGHT_UNIT * _MOST_RETURNS)) for own in sums)
        weighted = [part * own for part, own in zip(noise.parts, bounded, strict=True)]
        return ScanSums(leaf_size_m, *_total(keys, weighted), total_scans, WEIGHT_UNIT**2)

    def visibility(self) -> VisibilityCounts:
        blocks = self.block_keys()
        each = [table.visibility_of(blocks) for table in self._tables]
        return VisibilityCounts(*_total(*zip(*each, strict=True)))


def _total(keys: Sequence[Keys], values: Sequence[Array]) -> tuple[Keys, Array]:
    """Add the `values` of each table in rows of its ascending `keys`."""
    if len(keys) == 1:
        return keys[0], values[0]
    all_keys = reduce(np.union1d, keys)
    total = np.zeros((len(all_keys), *values[0].shape[1:]), values[0].dtype)
    for own, added in zip(keys, values, strict=True):
        total[np.searchsorted(all_keys, own)] += added
    return all_keys, total
