# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Makes the plan: one pass over the scans, which gives each tile the rays that cross it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.average import SurfaceReturns
from radarsdf.fitting.estimate import estimate_rays
from radarsdf.io.scans import Scan, scans_in_memory
from radarsdf.returns.intensities import Intensities
from radarsdf.returns.moving import Standing
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays, check_range, middle_scan, prepare
from radarsdf.returns.sensor import Sensor
from radarsdf.threads import Workers
from radarsdf.tiles.grid import Tile, TileGrid
from radarsdf.tiles.input_digest import InputDigest
from radarsdf.tiles.plan import Plan, TilePlan
from radarsdf.tiles.ray_files import RayFiles, read_intensities, read_rays, write_scan_axes

_CHUNK_SCANS = 256  # in memory at a time
_CHUNK_RETURNS = 500_000  # likewise: fewer scans of a dense sensor
_CHUNK_M = 1000.0  # scans of a chunk share a local frame, in which float32 must be precise
_SENSOR_SCANS = 512  # at most: those that tell what the sensor is
_LOOKED_AT = 4  # tiles whose noise and roughness stand for all


@dataclass
class _Counts:
    """What a pass counts of a tile."""

    origin_cells: tuple[int, int, int]
    scans: list[int]
    returns: int = 0
    rays: int = 0


class Planner:
    """Takes scans one after another, and writes the rays of each tile.

    Parameters
    ----------
    folder : Path
        Where the files of the tiles are written.
    config : FitConfig
        Settings of all fits.
    grid : TileGrid
        The tiles.
    """

    def __init__(self, folder: Path, config: FitConfig, grid: TileGrid) -> None:
        self._folder, self._config, self._grid = folder, config, grid
        self._files = RayFiles(folder)
        self._tiles: dict[Tile, _Counts] = {}
        self._positions: list[NDArray[np.float64]] = []
        self._up: list[NDArray[np.float64]] = []
        self._samples: list[Scan] = []
        self._every = 1
        self._intensities = Intensities()
        self._with_intensities: bool | None = None

    def add(self, scans: list[Scan], first: int) -> None:
        """Scans that follow each other, the number of the first of which is `first`."""
        for number, scan in enumerate(scans, first):
            self._check(scan, number)
            if number % self._every == 0:
                self._samples.append(scan)
                if len(self._samples) > _SENSOR_SCANS:
                    self._samples, self._every = self._samples[::2], 2 * self._every
        rays = self._rays(scans, first)
        self._keep_scans(scans)
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
            self._add_to(
                (int(tiles[begin, 0]), int(tiles[begin, 1])), rows[begin:end], rays, points, owner, sensors
            )

    def _check(self, scan: Scan, number: int) -> None:
        has = scan.intensities is not None
        if self._with_intensities is None:
            self._with_intensities = has
        if has != self._with_intensities:
            msg = f"scan {number} has {'' if has else 'no '}intensities, and those before it have {'none' if has else 'some'}"
            raise ValueError(msg)

    def _rays(self, scans: list[Scan], first: int) -> Rays:
        """Checked, without what moves, in a frame of their own."""
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
        standing = Standing.of(held.points, held.intensities, held.doppler_mps, self._config.returns)
        return prepare(
            standing.points, held.poses, standing.intensities, whole=False, **self._config.preparation
        )

    def _keep_scans(self, scans: list[Scan]) -> None:
        poses = np.stack([np.asarray(scan.T_world_sensor, np.float64) for scan in scans])
        together = self._config.returns.accumulate_scans
        seen_from = [middle_scan(i, len(scans), together) for i in range(len(scans))]
        self._positions.append(poses[seen_from, :3, 3])
        self._up.append(poses[:, :3, 2])

    def _add_to(
        self,
        tile: Tile,
        rows: NDArray[np.int64],
        rays: Rays,
        points: NDArray[np.float64],
        owner: NDArray[np.int64],
        sensors: NDArray[np.float64],
    ) -> None:
        """Gives a tile the rays in these rows."""
        lattice, scans = self._config.lattice, rays.scans[rows]
        if tile not in self._tiles:
            corner, height_m = self._grid.lower_corner(tile), float(sensors[rows[0], 2])
            middle = lattice.nearest_block([*(corner + self._grid.tile_m / 2), height_m]).tolist()
            self._tiles[tile] = _Counts((middle[0], middle[1], middle[2]), [int(scans[0]), 0])
        counts = self._tiles[tile]
        counts.rays += len(rows)
        counts.returns += int((owner[rows] == tile).all(axis=1).sum())
        counts.scans[1] = int(scans[-1])
        local = (points[rows] - lattice.position(counts.origin_cells)).astype(np.float32)
        self._files.add(tile, local, scans, None if rays.intensities is None else rays.intensities[rows])

    def plan(self, input_digest: str) -> Plan:
        """The plan, once all scans are given. Tiles without a return of their own are left out."""
        self._files.flush()
        for tile in [tile for tile, counts in self._tiles.items() if counts.returns == 0]:
            self._files.remove(tile)
            del self._tiles[tile]
        if not self._tiles:
            msg = "no return of any scan lies within the ranges"
            raise ValueError(msg)
        positions = np.concatenate(self._positions)
        write_scan_axes(self._folder, positions, np.concatenate(self._up))
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
            scans=len(positions),
            input_digest=input_digest,
            tiles=tuple(tiles),
        )
        return self._looked_at(draft)

    def _intensity_range(self) -> tuple[float, float] | None:
        """The lowest and the highest intensity of those that can belong to the others. None: there are none."""
        if not self._with_intensities:
            return None
        low, high, plausible = self._intensities.low, self._intensities.high, self._intensities.plausible()
        if not plausible.holds(np.array([low, high])).all():
            low, high = math.inf, -math.inf
            for tile in self._tiles:
                values = read_intensities(self._folder, tile)
                values = values[plausible.holds(values)]
                low = float(values.min(initial=low))
                high = float(values.max(initial=high))
        check_range(low, high)
        return low, high

    def _looked_at(self, plan: Plan) -> Plan:
        """The plan with what the largest tiles tell of noise and roughness, and with the cost of each."""
        noises, rough, returns, cells = [], 0.0, 0, 0
        for tile in sorted(plan.tiles, key=lambda planned: -planned.returns)[:_LOOKED_AT]:
            rays, _ = read_rays(self._folder, plan, tile)
            with Workers(plan.config.num_threads) as workers:
                surface = SurfaceReturns.of(rays, plan.config, workers.num_threads)
            noises.append(surface.noise)
            rough += surface.surfels.rough_share() * len(rays)
            returns += len(rays)
            cells += len(surface.surfels.keys)
        noise = SensorNoise.median(noises)
        return dataclasses.replace(
            plan,
            config=plan.config.override(returns=noise.settings),
            rough_share=rough / returns,
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


def make_plan(scans: Iterable[Scan], folder: Path, config: FitConfig, grid: TileGrid) -> Plan:
    """Reads all scans once, writes the rays of each tile, and gives the plan.

    Raises
    ------
    ValueError
        If a scan is invalid; the message names it.
    """
    planner, digest, number = Planner(folder, config, grid), InputDigest(), 0
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
            way_m = np.abs(
                np.asarray(scan.T_world_sensor)[:3, 3] - np.asarray(chunk[0].T_world_sensor)[:3, 3]
            )
            if len(chunk) >= _CHUNK_SCANS or returns >= _CHUNK_RETURNS or not (way_m < _CHUNK_M).all():
                yield chunk
                chunk, returns = [], 0
        chunk.append(scan)
        returns += len(scan)
    if chunk:
        yield chunk
