# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Makes the plan: one pass over the scans, which writes the rays that cross each tile to its file."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import cell_keys
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.average import SurfaceReturns
from radarsdf.fitting.estimate import estimate_rays
from radarsdf.io.npz import array_in
from radarsdf.io.scans import Scan, scans_in_memory
from radarsdf.returns.intensities import Intensities, Plausible
from radarsdf.returns.moving import Standing
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays, check_range, middle_scan, prepare, rays_from
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.sums import lattice_of
from radarsdf.threads import Workers
from radarsdf.tiles.plan import Plan, Tile, TileGrid, TilePlan, folder_of

SCANS_FILE = "scans.npy"
_RECORD = np.dtype([("point", "<f4", (3,)), ("scan", "<i4"), ("intensity", "<f4")])
"""A return in the frame of its tile, m; its scan; its intensity, sensor units, NaN if there are none."""
_BUFFER_BYTES = 64 << 20  # of the rays of all tiles together, before they are appended to their files
_CHUNK_SCANS = 256  # in memory at a time
_CHUNK_RETURNS = 500_000  # likewise: fewer scans of a dense sensor
_CHUNK_M = 1000.0  # scans of a chunk share a local frame, in which float32 must be precise
_SENSOR_SCANS = 512  # at most, from which the sensor is described
_SAMPLED_TILES = 4  # whose noise and clutter ratio stand for all


class InputDigest:
    """A digest of scans, to know them again."""

    def __init__(self) -> None:
        self._digest = hashlib.blake2b(digest_size=16)

    def add(self, scan: Scan) -> None:
        """The next scan."""
        for array in (scan.points, scan.T_world_sensor, scan.intensities, scan.doppler_mps):
            self._digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())

    def hex(self) -> str:
        """The digest of all scans so far."""
        return self._digest.hexdigest()

    @classmethod
    def of(cls, scans: Iterable[Scan]) -> str:
        """The digest of all scans."""
        digest = cls()
        for scan in scans:
            digest.add(scan)
        return digest.hex()


def make_plan(scans: Iterable[Scan], folder: Path, config: FitConfig, grid: TileGrid) -> Plan:
    """Reads all scans once, writes the rays of each tile, and returns the plan. Raises a ValueError that names an invalid scan."""
    planner, digest, number = _Planner(folder, config, grid), InputDigest(), 0
    for chunk in _chunks(scans, config.returns.accumulate_scans):
        for scan in chunk:
            digest.add(scan)
        planner.add(chunk, number)
        number += len(chunk)
    if number == 0:
        msg = "there are no scans"
        raise ValueError(msg)
    return planner.plan(digest.hex())


def _chunks(scans: Iterable[Scan], together: int) -> Iterator[list[Scan]]:
    """Lists of consecutive scans, in which whole groups are accumulated."""
    chunk: list[Scan] = []
    returns = 0
    for scan in scans:
        if chunk and len(chunk) % together == 0:
            first, here = (np.asarray(one.T_world_sensor)[:3, 3] for one in (chunk[0], scan))
            is_near = (np.abs(here - first) < _CHUNK_M).all()
            if len(chunk) >= _CHUNK_SCANS or returns >= _CHUNK_RETURNS or not is_near:
                yield chunk
                chunk, returns = [], 0
        chunk.append(scan)
        returns += len(scan)
    if chunk:
        yield chunk


@dataclass
class _Counts:
    """What a pass counts of a tile."""

    origin_cells: tuple[int, int, int]
    scans: list[int]
    returns: int = 0
    rays: int = 0


class _Planner:
    """Takes scans one after another, and writes the rays of each tile."""

    def __init__(self, folder: Path, config: FitConfig, grid: TileGrid) -> None:
        self._folder, self._config, self._grid = folder, config, grid
        self._tiles: dict[Tile, _Counts] = {}
        self._buffers: dict[Tile, list[NDArray[np.void]]] = {}
        self._buffered_bytes = 0
        self._axes: list[
            NDArray[np.float64]
        ] = []  # (F, 6): from where scans were seen, and their z axes, world
        self._samples: list[Scan] = []
        self._every = 1
        self._intensities = Intensities()
        self._with_intensities: bool | None = None

    def add(self, scans: list[Scan], first: int) -> None:
        """Adds scans that follow each other, the number of the first of which is `first`."""
        for number, scan in enumerate(scans, first):
            self._check(scan, number)
            if number % self._every == 0:
                self._samples.append(scan)
                if len(self._samples) > _SENSOR_SCANS:
                    self._samples, self._every = self._samples[::2], 2 * self._every
        rays = self._rays(scans, first)
        self._add_axes(scans)
        if len(rays) == 0:
            return
        if rays.intensities is not None:
            self._intensities.add(rays.intensities)
        points, sensors = rays.in_world()
        rays = dataclasses.replace(rays, scans=rays.scans + np.int32(first))
        pairs = list(self._grid.crossed(points, sensors))
        rows = np.concatenate([pair[0] for pair in pairs])
        tiles = np.concatenate([pair[1] for pair in pairs])
        order = np.lexsort((rows, tiles[:, 1], tiles[:, 0]))
        rows, tiles = rows[order], tiles[order]
        starts = np.flatnonzero((np.diff(tiles, axis=0, prepend=tiles[:1] - 1) != 0).any(axis=1))
        owner = self._grid.tiles_of(points)
        for begin, end in itertools.pairwise([*starts.tolist(), len(rows)]):
            tile, own = (int(tiles[begin, 0]), int(tiles[begin, 1])), rows[begin:end]
            if tile not in self._tiles:
                self._begin(tile, float(sensors[own[0], 2]), int(rays.scans[own[0]]))
            counts = self._tiles[tile]
            counts.rays += len(own)
            counts.returns += int((owner[own] == tile).all(axis=1).sum())
            counts.scans[1] = int(rays.scans[own[-1]])
            self._write(tile, own, points, rays)

    def _check(self, scan: Scan, number: int) -> None:
        has = scan.intensities is not None
        if self._with_intensities is None:
            self._with_intensities = has
        if has != self._with_intensities:
            msg = f"scan {number} has {'' if has else 'no '}intensities, and those before it have {'none' if has else 'some'}"
            raise ValueError(msg)

    def _rays(self, scans: list[Scan], first: int) -> Rays:
        """Static returns, checked, in a frame of their own."""
        try:
            return self._prepared(scans)
        except (ValueError, TypeError) as error:
            for number, scan in enumerate(scans, first):  # which of them it is
                try:
                    self._prepared([scan])
                except (ValueError, TypeError) as of_one:
                    reason = str(of_one).replace("scan 0", "it").replace("pose 0", "its pose")
                    msg = f"scan {number}: {reason}"
                    raise ValueError(msg) from error
            raise

    def _prepared(self, scans: list[Scan]) -> Rays:
        held = scans_in_memory(scans)
        static = Standing.of(held.points, held.intensities, held.doppler_mps, self._config.returns)
        return prepare(static.points, held.poses, static.intensities, whole=False, **self._config.preparation)

    def _add_axes(self, scans: list[Scan]) -> None:
        poses = np.stack([np.asarray(scan.T_world_sensor, np.float64) for scan in scans])
        together = self._config.returns.accumulate_scans
        seen_from = [middle_scan(i, len(scans), together) for i in range(len(scans))]
        self._axes.append(np.concatenate([poses[seen_from, :3, 3], poses[:, :3, 2]], axis=1))

    def _begin(self, tile: Tile, height_m: float, scan: int) -> None:
        middle = self._grid.lower_corner(tile) + self._grid.tile_m / 2
        x, y, z = self._config.lattice.nearest_block([*middle, height_m]).tolist()
        self._tiles[tile] = _Counts((x, y, z), [scan, 0])
        path = rays_path(self._folder, tile)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")

    def _write(self, tile: Tile, own: NDArray[np.int64], points: NDArray[np.float64], rays: Rays) -> None:
        """Buffers some rays, with their ends in the world, m, for the file of a tile."""
        records = np.zeros(len(own), _RECORD)
        records["point"] = points[own] - self._config.lattice.position(self._tiles[tile].origin_cells)
        records["scan"] = rays.scans[own]
        records["intensity"] = np.nan if rays.intensities is None else rays.intensities[own]
        self._buffers.setdefault(tile, []).append(records)
        self._buffered_bytes += records.nbytes
        if self._buffered_bytes > _BUFFER_BYTES:
            self._flush()

    def _flush(self) -> None:
        for tile, parts in self._buffers.items():
            with rays_path(self._folder, tile).open("ab") as file:
                for rows in parts:
                    file.write(rows.data)
        self._buffers, self._buffered_bytes = {}, 0

    def plan(self, input_digest: str) -> Plan:
        """The plan, once all scans are given. Tiles without a return of their own are left out."""
        self._flush()
        for tile in [tile for tile, counts in self._tiles.items() if counts.returns == 0]:
            path = rays_path(self._folder, tile)
            path.unlink()
            if not any(path.parent.iterdir()):
                path.parent.rmdir()
            del self._tiles[tile]
        if not self._tiles:
            msg = "no return of any scan lies within the ranges"
            raise ValueError(msg)
        axes = np.concatenate(self._axes)
        np.save(self._folder / SCANS_FILE, axes, allow_pickle=False)
        tiles = [
            TilePlan(
                tile=tile,
                returns=counts.returns,
                rays=counts.rays,
                origin_cells=counts.origin_cells,
                scans=(counts.scans[0], counts.scans[1]),
            )
            for tile, counts in sorted(self._tiles.items())
        ]
        draft = Plan(
            config=self._config,
            tile_m=self._grid.tile_m,
            halo_m=self._grid.halo_m,
            intensity_range=self._intensity_range(),
            rough_share=0.0,
            returns_per_cell=0.0,
            sensor=self._sensor(SensorNoise(0.0, 0.0, 0.0)),
            scans=len(axes),
            input_digest=input_digest,
            tiles=tuple(tiles),
        )
        return self._completed(draft)

    def _intensity_range(self) -> tuple[float, float] | None:
        """The lowest and the highest intensity of those that are no outliers. None: there are none."""
        if not self._with_intensities:
            return None
        low, high, plausible = self._intensities.low, self._intensities.high, self._intensities.plausible()
        if not plausible.holds(np.array([low, high])).all():
            low, high = math.inf, -math.inf
            for tile in self._tiles:
                values = np.fromfile(rays_path(self._folder, tile), _RECORD)["intensity"]
                values = values[plausible.holds(values)]
                low = float(values.min(initial=low))
                high = float(values.max(initial=high))
        check_range(low, high)
        return low, high

    def _completed(self, plan: Plan) -> Plan:
        """The plan with the noise and the clutter ratio of the largest tiles, and with the cost of each tile."""
        noises, clutter, returns, cells = [], 0.0, 0, 0
        for tile in sorted(plan.tiles, key=lambda planned: -planned.returns)[:_SAMPLED_TILES]:
            rays, _ = read_rays(self._folder, plan, tile)
            with Workers(plan.config.num_threads) as workers:
                surface = SurfaceReturns.of(rays, plan.config, workers.num_threads)
            noises.append(surface.noise)
            clutter += surface.surfels.rough_share() * len(rays)
            returns += len(rays)
            cells += len(surface.surfels.keys)
        noise = SensorNoise.median(noises)
        return dataclasses.replace(
            plan,
            config=plan.config.override(returns=noise.settings),
            rough_share=clutter / returns,
            returns_per_cell=returns / max(cells, 1),
            sensor=self._sensor(noise),
            tiles=tuple(self._estimated(plan, tile) for tile in plan.tiles),
        )

    def _estimated(self, plan: Plan, tile: TilePlan) -> TilePlan:
        """The tile with the memory and time that its own fit takes."""
        rays, inside = read_rays(self._folder, plan, tile)
        expected = estimate_rays(rays, plan.config, inside)
        return dataclasses.replace(
            tile, memory_bytes=expected.peak_memory_bytes, seconds=round(expected.seconds, 3)
        )

    def _sensor(self, noise: SensorNoise) -> Sensor:
        limits = self._config.returns
        return Sensor.of(
            [scan.points for scan in self._samples],
            [scan.intensities for scan in self._samples if scan.intensities is not None] or None,
            noise=noise,
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m,
        )


def rays_path(folder: Path, tile: Tile) -> Path:
    """The rays of a tile."""
    return folder_of(folder, tile) / "rays.bin"


def read_rays(folder: Path, plan: Plan, tile: TilePlan) -> tuple[Rays, NDArray[np.bool_]]:
    """The rays that cross a tile, in the frame of its map, and which of their returns (N,) are in it or its halo.

    Raises a ValueError if the file is gone, or has another number of rays than the plan says.
    """
    path = rays_path(folder, tile.tile)
    if not path.exists():
        msg = f"{path} is gone, as after radarsdf tiles clean: fit the scans again in a new folder"
        raise ValueError(msg)
    found = path.stat().st_size / _RECORD.itemsize
    if found != tile.rays:
        msg = f"{path} has {found:g} rays instead of {tile.rays}: make the plan again"
        raise ValueError(msg)
    rows = np.fromfile(path, _RECORD)
    numbers, scans = np.unique(rows["scan"], return_inverse=True)
    of_scans = np.array(array_in(folder / SCANS_FILE)[numbers])  # a memory map, of which few rows are needed
    points = np.ascontiguousarray(rows["point"])
    intensities = None
    if plan.intensity_range is not None:
        intensities = Plausible(*plan.intensity_range).kept(rows["intensity"])
    origin = plan.config.lattice.position(tile.origin_cells)
    rays = rays_from(
        points,
        (of_scans[:, :3] - origin)[scans],
        origin=origin,
        intensities=intensities,
        scans=scans.astype(np.int32),
        up_of_scan=np.ascontiguousarray(of_scans[:, 3:]),
    )
    cells = lattice_of(cell_keys(points, plan.config.leaf_size_m, plan.config.num_threads))[:, :2]
    halo = round(plan.halo_m / plan.config.leaf_size_m)
    lower = np.array(tile.tile) * plan.tile_cells - plan.origin_cells(tile.tile)[:2] - halo
    inside: NDArray[np.bool_] = np.all(
        (cells >= lower) & (cells < lower + plan.tile_cells + 2 * halo), axis=1
    )
    return rays, inside
