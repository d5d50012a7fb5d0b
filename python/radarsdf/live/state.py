# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a map that grows consists of, and how it changes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import GrowingSums, SumsChange
from radarsdf.config.fit_config import FitConfig
from radarsdf.live.learning import noise_of, quick_of
from radarsdf.live.regions import REGION_CELLS, cubes_of, regions_of
from radarsdf.live.rows import Keys
from radarsdf.live.scan_log import LoggedScan, ScanId, ScanLog
from radarsdf.live.scans import rays_of
from radarsdf.live.shelf import Shelf
from radarsdf.live.storage import Stored
from radarsdf.live.surface import ChangedSums, GrowingSurface
from radarsdf.returns.evidence import BLOCK_BITS, Looks
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.sums import QUANTA, ScanSums, lattice_of
from radarsdf.threads import resolve_num_threads

_NONE = np.zeros(0, np.uint64)
_MARKS = 64  # lists of changed blocks, before they are joined
_BYTES_OF_SUMS = 350  # of a cell with returns, in a table with room for twice as many
_LEFT = 0.75  # of the cells that there may be, so that regions are not put away for each scan
_UNKNOWN = SensorNoise(0.1, 0.01, 0.01)  # nothing depends on it: it is estimated once there are scans


class GrowingState:
    """Sums over scans, the scans themselves, and the surface that follows. One thread at a time.

    Parameters
    ----------
    config : FitConfig
        Settings.
    origin : ndarray or None
        (3,) of the local frame, world, m. None: it follows from the first scan.
    max_bytes : int or None
        Memory beyond which scans are let go, bytes.
    log : ScanLog
        An empty one.
    shelf : Shelf or None
        Where sums are put that are far away. None: they are forgotten.
    """

    def __init__(
        self,
        config: FitConfig,
        origin: NDArray[np.float64] | None,
        max_bytes: int | None,
        log: ScanLog,
        shelf: Shelf | None = None,
    ) -> None:
        self.config, self.quick = config, quick_of(config)
        self.origin = origin
        self.max_bytes = max_bytes
        self.log = log
        self._shelf = shelf
        self._in_use = _NONE  # regions that the last change reached
        self.sums = GrowingSums()
        self.noise = _UNKNOWN
        self.with_intensities: bool | None = None
        self.next_id = 0
        self._noise_of = 0  # number of scans that the noise was estimated from
        self._returns_changed: list[Keys] = []
        self._looks_changed: list[Keys] = []
        self._surface: GrowingSurface | None = None

    @property
    def num_bytes(self) -> int:
        """Memory that all takes, bytes."""
        surface = 0 if self._surface is None else self._surface.num_bytes
        return self.sums.num_bytes + self.log.num_bytes + surface

    def exchange(
        self,
        come: dict[ScanId, LoggedScan],
        gone: Iterable[ScanId],
        origin: NDArray[np.float64] | None = None,
    ) -> Keys:
        """Takes scans out and puts others in, also of the same ids: all of it, or nothing if an error is raised.

        `origin`: of a map that has none yet. Gives the keys of the blocks whose returns changed.
        """
        left = {scan_id: self.log.get(scan_id) for scan_id in gone}
        before, self.origin = self.origin, self.origin if origin is None else origin
        done = False
        try:
            blocks = self._apply(come.values(), left.values())
            done = True
            for scan_id in left.keys() - come.keys():
                self.log.drop(scan_id)
            for scan_id, scan in come.items():
                self.log.put(scan_id, scan)
            if come:
                self.bound()
        except BaseException:  # the disk is full, say
            if done:
                self._apply(left.values(), come.values())
                for scan_id in come.keys() - left.keys():
                    self.log.drop(scan_id)
                for scan_id, scan in left.items():
                    self.log.put(scan_id, scan)
            self.origin = before
            raise
        return blocks

    def _apply(self, come: Iterable[LoggedScan], gone: Iterable[LoggedScan]) -> Keys:
        """Changes the sums, or leaves all as it was. Gives the keys of the blocks whose returns changed."""
        change = SumsChange(self.config.leaf_size_m, self.config.leaf_size_m / QUANTA)
        for scans, sign in ((gone, -1), (come, 1)):
            for scan in scans:
                rays = rays_of(scan, self.config, self.origin)
                change.collect(rays.points, rays.directions, rays.ranges_m, sign)
        if self._shelf is not None:
            blocks = change.block_keys()
            self._bring_back(self._shelf.touched(blocks))
            self._in_use = regions_of(blocks << BLOCK_BITS)
        returns, looks = self.sums.apply(change)
        self._mark(returns, looks)
        return returns

    def bound(self) -> None:
        """Lets scans go where memory is short, and puts regions away if there is a folder."""
        if self.max_bytes is None:
            return
        if self._shelf is not None and len(self._in_use):
            # The surface grows and shrinks with the next mesh.
            surface = 0.0 if self._surface is None else self._surface.num_bytes_of_cell
            if self.sums.num_bytes + surface * self.sums.num_cells > self.max_bytes:
                self._bound_cells(int(self.max_bytes / (_BYTES_OF_SUMS + surface)))
        if self.num_bytes > self.max_bytes:
            if self._noise_of == 0:  # the scans that tell it may go
                self._settle_noise()
            self.log.shrink(max(0, self.max_bytes - (self.num_bytes - self.log.num_bytes)))

    def _bound_cells(self, most: int) -> None:
        """Puts the farthest regions away, if there are more than `most` cells. Those that the last change reached stay."""
        if self.sums.num_cells <= most:
            return
        regions = np.setdiff1d(regions_of(self.sums.block_keys() << BLOCK_BITS), self._in_use)
        away = cubes_of(regions) - cubes_of(self._in_use).mean(axis=0)
        for region in regions[np.argsort(-np.square(away).sum(axis=1), kind="stable")]:
            self._put_away(region[None])
            if self.sums.num_cells <= _LEFT * most:
                break

    def clear_outside(self, centre: NDArray[np.float64], radius_m: float) -> Keys:
        """Forgets blocks beyond a ball, or puts the regions away that lie beyond it. Gives the keys of the blocks."""
        keys = self.sums.block_keys()
        if self.origin is None:
            return keys
        if self._shelf is not None:
            regions = regions_of(keys << BLOCK_BITS)
            lower = cubes_of(regions) * (REGION_CELLS * self.config.leaf_size_m) + self.origin
            nearest = np.clip(centre, lower, lower + REGION_CELLS * self.config.leaf_size_m)
            return self._put_away(regions[np.square(nearest - centre).sum(axis=1) > radius_m**2])
        middles = (lattice_of(keys << BLOCK_BITS) + 4) * self.config.leaf_size_m + self.origin
        gone: Keys = keys[np.square(middles - centre).sum(axis=1) > radius_m**2]
        self.sums.erase(gone)
        self.log.seal_beyond(centre, radius_m)
        self._mark(gone, gone)
        return gone

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Within, nothing is put away. Afterwards, the same regions are again."""
        away = _NONE if self._shelf is None else self._shelf.regions
        self._bring_back(away)
        try:
            yield
        finally:
            self._put_away(away)

    def _bring_back(self, regions: Keys) -> None:
        if self._shelf is not None:
            blocks = self._shelf.bring_back(self.sums, regions)
            self._mark(blocks, blocks)

    def _put_away(self, regions: Keys) -> Keys:
        blocks = _NONE if self._shelf is None else self._shelf.put_away(self.sums, regions)
        self._mark(blocks, blocks)
        return blocks

    def all_sums(self) -> ScanSums:
        """Of all cells."""
        return ScanSums(self.config.leaf_size_m, *self.sums.sums_of(self.sums.block_keys()))

    def changes(self) -> tuple[GrowingSurface, ChangedSums, SensorNoise]:
        """The surface as it was derived last, and what it has to take in."""
        if self._surface is None:
            origin = np.zeros(3) if self.origin is None else self.origin
            surface = GrowingSurface(self.quick, origin)
            self._surface = None if self.origin is None else surface
            self._returns_changed = self._looks_changed = [self.sums.block_keys()]
        else:
            surface = self._surface
        returns, looked = (
            np.unique(np.concatenate([_NONE, *keys])) for keys in (self._returns_changed, self._looks_changed)
        )
        changes = ChangedSums(
            returns,
            ScanSums(self.config.leaf_size_m, *self.sums.sums_of(returns)),
            looked,
            Looks(*self.sums.looks_of(looked)),
        )
        self._returns_changed, self._looks_changed = [], []
        self._settle_noise()
        return surface, changes, self.noise

    def forget_surface(self) -> None:
        """The surface is derived anew from all sums."""
        self._surface = None

    def stored(self) -> Stored:
        """All that a file has to hold."""
        keys = self.sums.block_keys()
        return Stored(
            self.config,
            self.origin,
            self.noise,
            self._noise_of,
            self.next_id,
            self.with_intensities,
            self.max_bytes,
            self.log.sealed_ids,
            dict(zip(self.log.ids, self.log.scans(), strict=True)),
            *self.sums.sums_of(keys),
            *self.sums.looks_of(keys),
        )

    def restore(self, stored: Stored) -> None:
        """Of a new state: what was stored."""
        self.sums.insert(stored.keys, stored.sums, stored.scans_of_cells, stored.look_keys, stored.looks)
        self.noise, self._noise_of = stored.noise, stored.noise_of
        self.next_id, self.with_intensities = stored.next_id, stored.with_intensities
        for scan_id, scan in stored.scans.items():
            self.log.put(scan_id, scan)
        self.log.restore_sealed(stored.sealed)
        self.bound()

    def _mark(self, returns: Keys, looks: Keys) -> None:
        """The surface has to take in these blocks. Of very many scans, the list must not grow without end."""
        for marked, keys in ((self._returns_changed, returns), (self._looks_changed, looks)):
            marked.append(keys)
            if len(marked) > _MARKS:
                marked[:] = [np.unique(np.concatenate(marked))]

    def _settle_noise(self) -> None:
        """Estimates the sensor's noise, if there are twice or half as many scans as there were then."""
        scans = len(self.log)
        if self._noise_of / 2 < scans < 2 * self._noise_of:
            return
        num_threads = resolve_num_threads(self.config.num_threads)
        found = noise_of(self.log, self.all_sums(), self.quick, self.origin, num_threads)
        if found is not None:
            self.noise, self._noise_of = found, scans
