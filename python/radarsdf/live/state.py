"""State of a live map, and its changes."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.arrays import Array, Floats, Keys
from radarsdf.checks import AnyPath, check
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import QUANTA, SumsChange
from radarsdf.fitting.fit import FitInput
from radarsdf.interrupts import at_once
from radarsdf.live import store
from radarsdf.live.store import Described, LoggedScan, ScanId, ScanLog
from radarsdf.live.sums import RadarSums
from radarsdf.live.surface import NO_KEYS, REGION_BITS, REGION_CELLS, GrowingSurface, regions_of
from radarsdf.live.tracking import Track
from radarsdf.returns.evidence import BLOCK_BITS, VisibilityCounts
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.noise import SensorNoise, rig_noise, sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays, prepare
from radarsdf.returns.sensor import Radars
from radarsdf.returns.sums import WEIGHT_UNIT, lattice_of
from radarsdf.rig import Label, Rig
from radarsdf.scans import all_or_nan
from radarsdf.threads import resolve_num_threads

_Scans = dict[ScanId, LoggedScan]
_SAVED = ("noise", "noise_of", "next_id", "with_intensities")  # attributes saved as they are
# Until the noise is estimated from scans, and for weights that depend on a scan alone.
_USUAL = SensorNoise(0.1, 0.01, 0.01)
_NOISE_RETURNS = 100_000  # sample for the noise, enough to include the required returns on flat surfels
# Rays of a fit, for free space and intensities, which take 100 bytes each: surfaces are those of the sums of all.
_FIT_RETURNS = 4_000_000


class GrowingState:
    """Sums over scans, the scans, and the surface derived from them. Not thread-safe.

    Each change is prepared in new objects and made by one :func:`at_once`: asynchronous exceptions leave it complete or absent.
    """

    def __init__(
        self,
        config: FitConfig,
        origin: Floats | None,
        max_bytes: int | None,
        folder: Path | None,
        mountings: dict[Label, Floats] | None,
    ) -> None:
        self.config = config
        self.mountings = mountings
        names = ("leaf_size_m", "seed", "num_threads", "max_memory_bytes", "returns")
        same = {name: getattr(config, name) for name in names}
        self.quick = FitConfig.quick(**same, encoding={"bridge_cells": config.encoding.bridge_cells})
        self.origin = origin
        self.max_bytes = max_bytes
        self.log = ScanLog(folder, mountings)
        self.track = Track()
        self._away = NO_KEYS  # ascending keys of the regions on disk
        self._num_threads = resolve_num_threads(config.num_threads)
        self._labels: list[Label | None] = [None] if mountings is None else [*mountings]
        self.sums = RadarSums(len(self._labels))
        self.noise = _USUAL
        self.with_intensities: bool | None = None
        self.next_id = 0
        self.number = 0  # of the state of the sums: another one after each change
        self.noise_of = 0  # number of scans at the last estimate of the noise
        self._changed: set[int] = set()  # keys of the blocks to update in the surface
        self._surface: GrowingSurface | None = None

    @property
    def num_bytes(self) -> int:
        surface = 0 if self._surface is None else self._surface.num_bytes
        return self.sums.num_bytes + self.log.num_bytes + surface

    def exchange(self, added: _Scans, removed: Iterable[ScanId], **new: Any) -> Keys:
        """Remove and add scans, and set `new` attributes, atomically. Return the keys of the changed blocks."""
        before = {scan_id: self.log.get(scan_id) for scan_id in removed}
        new = {"origin": self.origin, "log": self.log.exchanged(added, before)} | new
        old = {name: getattr(self, name) for name in new}
        blocks = self._apply(added, before, new)
        try:
            if added:
                self._bound()
        except BaseException:  # such as a full disk
            self._apply(before, added, old)
            raise
        self.log.tidy()
        return blocks

    def _apply(self, added: _Scans, removed: _Scans, new: dict[str, Any]) -> Keys:
        """Change the sums and set attributes atomically. Return the keys of the changed blocks."""
        edge_m = self.config.leaf_size_m
        changes = [SumsChange(edge_m, edge_m / QUANTA) for _ in self._labels]
        for scans, sign in ((removed, -1), (added, 1)):
            for scan in scans.values():
                rays = self._rays_of([scan], self.origin if new["origin"] is None else new["origin"])
                change = changes[self._labels.index(scan.label)]
                weights = _USUAL.weights(rays)
                weights = np.full(len(rays), WEIGHT_UNIT, np.int32) if weights is None else weights
                change.collect(rays.points, rays.directions, rays.ranges_m, weights, sign)
        for change in changes:
            self._bring_back(regions_of(change.block_keys() << BLOCK_BITS))
        return self._commit(self.sums.apply(changes), None, **new)

    def _commit(self, changes: list[partial[Any]], blocks: Keys | None, **new: Any) -> Keys:
        """Change the sums and set attributes at once. Return the changed blocks: `blocks`, or those that `changes` return."""
        surface, self._surface = self._surface, None  # an interruption after the change discards it
        self.number += 1
        *results, _ = at_once(*changes, partial(vars(self).update, new))
        changed = reduce(np.union1d, [keys for keys, _ in results]) if blocks is None else blocks
        self._changed.update(changed.tolist())
        self._surface = surface
        return changed

    def _bound(self) -> None:
        most = (np.inf if self.log.folder is None else 0) if self.max_bytes is None else self.max_bytes
        if self.num_bytes > most:
            if self.noise_of == 0 and self.log.folder is None:  # the scans for its estimate may be sealed
                self._settle_noise()
            self.log = self.log.shrunk(int(max(0, most - (self.num_bytes - self.log.num_bytes))))

    def clear_outside(self, centre: Floats, radius_m: float) -> Keys:
        keys = self.sums.block_keys()
        if self.origin is None:
            return keys
        if self.log.folder is not None:
            regions = regions_of(keys << BLOCK_BITS)
            lower = lattice_of(regions << REGION_BITS) * self.config.leaf_size_m + self.origin
            nearest = np.clip(centre, lower, lower + REGION_CELLS * self.config.leaf_size_m)
            return self._put_away(regions[np.square(nearest - centre).sum(axis=1) > radius_m**2])
        middles = (lattice_of(keys << BLOCK_BITS) + 4) * self.config.leaf_size_m + self.origin
        far = keys[np.square(middles - centre).sum(axis=1) > radius_m**2]
        log = self.log.sealed_beyond(centre, radius_m)
        return self._commit(self.sums.erase(far), far, log=log)

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Restore all regions from disk within the context, and write the same ones again afterwards."""
        away = self._away
        self._bring_back(away)
        try:
            yield
        finally:
            self._put_away(away)

    def _bring_back(self, regions: Keys) -> None:
        regions = np.intersect1d(regions, self._away)
        if len(regions):
            blocks, columns = store.read_regions(self.log.folder, regions, len(self._labels))
            self._commit(self.sums.insert(columns), blocks, _away=np.setdiff1d(self._away, regions))
            for path in store.region_paths(self.log.folder, regions):
                with suppress(OSError):  # a leftover file is harmless
                    path.unlink()

    def _put_away(self, regions: Keys) -> Keys:
        blocks, written = store.write_regions(self.log.folder, self.sums, regions)
        return self._commit(self.sums.erase(blocks), blocks, _away=np.union1d(self._away, written))

    def changes(self) -> tuple[GrowingSurface, tuple[Any, ...], VisibilityCounts]:
        """Return the last surface, the arguments of its update, and the visibility counts."""
        self._settle_noise()  # first: may raise, since scans may be read from disk
        if self._surface is None or not self._surface.complete:
            surface = GrowingSurface(self.quick, np.zeros(3) if self.origin is None else self.origin)
            self._surface = None if self.origin is None else surface
            blocks = self.sums.block_keys()
        else:
            surface = self._surface
            blocks = np.array(sorted(self._changed), np.uint64)
        bits = REGION_BITS - BLOCK_BITS
        in_region = np.arange(1 << int(bits), dtype=np.uint64)
        in_regions = (np.unique(blocks >> bits) << bits)[:, None] | in_region
        sums = self.sums.weighted(self.config.leaf_size_m, self.noise, in_regions.ravel())
        surface.complete = False
        self._changed.clear()
        return surface, (blocks, sums, self.noise, self._num_threads), self.sums.visibility()

    def save(self, path: AnyPath) -> None:
        """Write the state to a file. Raise a ValueError for scan ids that are neither integers nor strings."""
        ids: list[Any] = [*self.log.ids, *self.log.sealed]
        mountings: Any = self.mountings and [(label, T.tolist()) for label, T in self.mountings.items()]
        savable = all(type(name) in (int, str) for name in [*ids, *(self.mountings or ())])
        check(savable, "a map can be saved only if ids of scans and labels are whole numbers or strings")
        scans = list(self.log.scans())
        described = Described(
            config=self.config.to_dict(),
            origin=None if self.origin is None else self.origin.tolist(),
            max_bytes=self.max_bytes,
            sealed=ids[len(scans) :],
            ids=ids[: len(scans)],
            poses=[scan.pose.tolist() for scan in scans],
            times_s=[scan.time_s for scan in scans],
            tracked=[scan_id for scan_id, scan in zip(ids, scans, strict=False) if scan.tracked],
            mountings=mountings,
            radars=[] if self.mountings is None else [[*self.mountings].index(scan.label) for scan in scans],
            **{name: getattr(self, name) for name in _SAVED},
        )
        store.save_state(path, described, scans, self.sums)

    def restore(self, described: Described, scans: list[LoggedScan], sums: Sequence[Sequence[Array]]) -> None:
        at_once(*self.sums.insert(sums))
        vars(self).update({name: getattr(described, name) for name in _SAVED})
        self.log = self.log.exchanged(dict(zip(described.ids, scans, strict=True)), ())
        self.log.sealed |= set(described.sealed)
        self._bound()

    def scans(self, every: int = 1) -> list[LoggedScan]:
        """Return one of every n scans that are not sealed. Raise a ValueError if there are none."""
        scans = list(self.log.scans(every))
        check(scans, "there are no scans to fit: integrate some first")
        return scans

    def fit_input(self) -> Callable[[], FitInput]:
        """Return a function for the input of a fit of all scans, with the incremental sums, and an even sample of many rays."""
        sums = self.sums.weighted(self.config.leaf_size_m, self.noise)
        visibility, origin = self.sums.visibility(), self.origin
        every = 1 + int(sums.counts.sum()) // _FIT_RETURNS
        scans, is_part = self.scans(every), every > 1 or bool(self.log.sealed)

        def read() -> FitInput:
            rays = self._rays_of(scans, origin).without_outliers()
            poses = np.stack([scan.T_world_sensor for scan in scans])
            moving = sum(int((~scan.is_static).sum()) for scan in scans if scan.is_static is not None)
            rays, radars = Radars.unify(rays, self._rig_of(scans), self.config, self._num_threads)
            # The sums weight returns by the noise when they were last derived, but have those of all scans.
            used = sums if radars is None or is_part else None
            scale = IntensityScale.of(rays.intensities)
            return FitInput(rays, scale, poses, moving, sums=used, radars=radars, visibility=visibility)

        return read

    def _settle_noise(self) -> None:
        """Estimate the sensor's noise if the number of scans has doubled or halved since the last time."""
        scans = len(self.log)
        if self.noise_of / 2 < scans < 2 * self.noise_of:
            return
        sums = self.sums.weighted(self.config.leaf_size_m, _USUAL)
        asked = list(self.log.scans(every=max(1, int(sums.counts.sum()) // _NOISE_RETURNS)))
        if asked:
            estimate = sensor_noise if self.mountings is None else rig_noise
            surfels, rays = Surfels.of_sums(sums, self._num_threads), self._rays_of(asked, self.origin)
            noise = estimate(surfels, rays, self.config.returns, self._num_threads)
            if self.mountings is not None:  # it weights all sums
                self._changed.update(self.sums.block_keys().tolist())
            vars(self).update(noise=noise, noise_of=scans)

    def _rays_of(self, scans: Sequence[LoggedScan], origin: Floats | None) -> Rays:
        """Return the rays of the static returns. Those of a scan depend on the scan, its pose and the settings alone."""
        static = [scan.static for scan in scans]
        poses = np.stack([scan.T_world_sensor for scan in static])
        values = [scan.intensities for scan in static if scan.intensities is not None] or None
        points, stated = [scan.points for scan in static], [scan.sigmas for scan in static]
        options = self.config.preparation | {"origin": origin, "whole": False, "rig": self._rig_of(static)}
        rays = prepare(points, poses, values, sigmas=all_or_nan(stated, points), **options)
        return rays.with_relative_deviations()

    def _rig_of(self, scans: Sequence[LoggedScan]) -> Rig | None:
        return None if self.mountings is None else Rig.of([scan.label for scan in scans], self.mountings)
