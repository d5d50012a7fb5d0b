# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Columns whose rows belong to cells, of which some blocks of cells get others."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import cell_keys
from radarsdf.returns.evidence import BLOCK_BITS
from radarsdf.returns.sums import lattice_of

Keys = NDArray[np.uint64]
_Column = TypeVar("_Column", bound=NDArray[Any])


def steps_round(reach: int) -> NDArray[np.int64]:
    """((2 reach + 1)³, 3) steps of at most so many along each axis."""
    return np.array(list(itertools.product(range(-reach, reach + 1), repeat=3)), np.int64)


ROUND = steps_round(1)
"""(27, 3) steps from a cell to itself and to those round it."""


@dataclass(frozen=True)
class Replacement:
    """The rows of some blocks go, others come in their place. Keys stay ascending."""

    keys: Keys
    """Of all rows afterwards."""
    _stays: NDArray[np.bool_]
    """Which of the rows before stay."""
    _is_new: NDArray[np.bool_]
    """Which of the rows afterwards are new."""

    @classmethod
    def of(cls, keys: Keys, new_keys: Keys, first: Keys, last: Keys) -> Replacement:
        """The rows of `keys` from each of `first` (B,) to each of `last` (B,) go, those of `new_keys` come."""
        stays = ~between(keys, first, last)
        kept = keys[stays]
        is_new = np.zeros(len(kept) + len(new_keys), bool)
        is_new[np.searchsorted(kept, new_keys) + np.arange(len(new_keys))] = True
        after = np.empty(len(is_new), np.uint64)
        after[is_new], after[~is_new] = new_keys, kept
        return cls(after, stays, is_new)

    def column(self, before: _Column, new: _Column) -> _Column:
        """A column (N, ...) with the rows `new` (M, ...) where they belong."""
        after = np.empty((len(self._is_new), *before.shape[1:]), before.dtype)
        after[self._is_new], after[~self._is_new] = new, before[self._stays]
        return after  # type: ignore[return-value]

    def rows(self, before: dict[str, NDArray[Any]], new: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """All columns, by their names, with :attr:`keys`."""
        return {
            name: self.keys if name == "keys" else self.column(before[name], new[name]) for name in before
        }


def between(keys: Keys, first: Keys, last: Keys) -> NDArray[np.bool_]:
    """(N,) which of the ascending `keys` (N,) lie between one of `first` (B,) and the same of `last` (B,), ends included."""
    edges = np.zeros(len(keys) + 1, np.int64)
    np.add.at(edges, np.searchsorted(keys, first), 1)
    np.add.at(edges, np.searchsorted(keys, last, side="right"), -1)
    found: NDArray[np.bool_] = np.cumsum(edges[:-1]) > 0
    return found


def leaves_of(blocks: Keys) -> tuple[Keys, Keys]:
    """Keys of the first and the last leaf cell of each block."""
    first = blocks << BLOCK_BITS
    return first, first | np.uint64((1 << int(BLOCK_BITS)) - 1)


def shifted(keys: Keys, steps: NDArray[np.int64]) -> Keys:
    """Keys of the cells that are `steps` (S, 3) away from those with these keys (N,), ascending, each once."""
    cells = (lattice_of(keys)[:, None] + steps).reshape(-1, 3)
    # The middle of a cell of 1 m is exact in float64.
    return np.unique(cell_keys(np.ascontiguousarray(cells, np.float64) + 0.5, 1.0, 1))


def changed_rows(
    keys: Keys, columns: tuple[NDArray[Any], ...], new_keys: Keys, new: tuple[NDArray[Any], ...]
) -> Keys:
    """Keys of the rows that differ between two tables: those that came, went, or have other bits in a column."""
    every = np.union1d(keys, new_keys)
    differs = np.ones(len(every), bool)
    both, old_rows, new_rows = np.intersect1d(keys, new_keys, assume_unique=True, return_indices=True)
    same = np.ones(len(both), bool)
    for before, after in zip(columns, new, strict=True):
        first, second = before[old_rows], after[new_rows]
        equal = (first == second) | ((first != first) & (second != second))  # noqa: PLR0124 - NaN is NaN
        same &= equal.all(axis=tuple(range(1, equal.ndim)))
    differs[np.searchsorted(every, both[same])] = False
    return every[differs]
