# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Sums of a map that grows which are put away to a folder, region by region, and come back with the same bits."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from radarsdf._core import GrowingSums
from radarsdf.io.files import take_lock
from radarsdf.io.npz import arrays_of, write_arrays
from radarsdf.live.regions import REGION_BITS, regions_of
from radarsdf.live.rows import Keys
from radarsdf.live.storage import CELL_COLUMNS, checked_sums
from radarsdf.returns.evidence import BLOCK_BITS

_LOCK = "live.lock"  # also the mark of a folder that a map has used


def locked_folder(folder: Path) -> int:
    """Makes a folder that one map uses, and locks it until the descriptor is closed. Files of a map of before are written over.

    Raises a ValueError if it holds anything else, an OSError if another map uses it.
    """
    folder.mkdir(exist_ok=True)
    ours = (_LOCK, "*scan-*.npz*", "*region-*.npz*") if (folder / _LOCK).is_file() else ()
    if not all(any(path.match(name) for name in ours) for path in folder.iterdir()):
        msg = f"{folder} holds other files: give an empty or new folder"
        raise ValueError(msg)
    return take_lock(folder / _LOCK, "used")


class Shelf:
    """A file for each region that was put away. `folder`: where to; none is made before there is something to write."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._paths: dict[int, Path] = {}

    def __len__(self) -> int:
        return len(self._paths)

    @property
    def regions(self) -> Keys:
        """(R,) keys of the regions that are put away, ascending."""
        return np.array(sorted(self._paths), np.uint64)

    def put_away(self, sums: GrowingSums, regions: Keys) -> Keys:
        """Moves all blocks of `regions` out of `sums`, once all are written. Gives the keys of the blocks, ascending."""
        blocks = sums.block_keys()
        of_blocks = blocks << BLOCK_BITS
        gone, written = [], {}
        for region in regions.tolist():
            own = blocks[of_blocks >> REGION_BITS == region]
            if len(own) == 0:
                continue
            written[region] = self._folder / f"region-{region:016x}.npz"
            columns = (*sums.sums_of(own), *sums.looks_of(own))
            write_arrays(written[region], dict(zip(CELL_COLUMNS, columns, strict=True)))
            gone.append(own)
        self._paths |= written
        keys = np.concatenate([blocks[:0], *gone])
        sums.erase(keys)
        return keys

    def bring_back(self, sums: GrowingSums, regions: Keys) -> Keys:
        """Moves those of `regions` that are put away into `sums`, all or none. Gives the keys of their blocks, ascending."""
        found = [region for region in regions.tolist() if region in self._paths]
        if not found:
            return np.zeros(0, np.uint64)
        read = []
        for region in found:
            path = self._paths[region]
            try:
                read.append(checked_sums(arrays_of(path, tuple(CELL_COLUMNS))))
            except ValueError as error:
                msg = f"{path} is no region of this map, or it is damaged: {error}"
                raise ValueError(msg) from error
        joined = {name: np.concatenate([arrays[name] for arrays in read]) for name in CELL_COLUMNS}
        sums.insert(*joined.values())
        for region in found:
            with suppress(OSError):  # a file that stays harms nothing
                self._paths.pop(region).unlink()
        return np.union1d(joined["look_keys"], joined["keys"] >> BLOCK_BITS)

    def touched(self, blocks: Keys) -> Keys:
        """Those of the regions of `blocks` (B,) that are put away."""
        return np.intersect1d(regions_of(blocks << BLOCK_BITS), self.regions, assume_unique=True)
