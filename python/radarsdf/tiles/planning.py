"""Planning: one pass over the scans that writes the rays crossing each tile to its file."""

import dataclasses
import hashlib
import logging
import math
import shutil
import zlib
from collections.abc import Iterable, Iterator
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.arrays import Bools, Floats, Ints
from radarsdf.checks import are_rigid, check, one_for_each_scan, restating
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import cell_keys
from radarsdf.fitting.estimate import estimate_rays
from radarsdf.io.npz import array_in
from radarsdf.returns.intensities import Intensities, Plausible
from radarsdf.returns.moving import static_rays
from radarsdf.returns.noise import (
    NOISE_SETTINGS,
    RigNoise,
    SensorNoise,
    are_credible,
    rig_noise,
    sensor_noise,
)
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import LeftOut, Rays, check_range, median_deviations, middle_scan, rays_from
from radarsdf.returns.sensor import SAME_UNIT, Sensor, Unit, in_map_unit, intensity_units
from radarsdf.returns.sums import lattice_of
from radarsdf.rig import Label
from radarsdf.scans import Scan, scans_in_memory
from radarsdf.tiles.plan import Plan, RadarPlan, Tile, TileGrid, TilePlan, folder_of

_LOG = logging.getLogger("radarsdf.tiles")
SCANS_FILE = "scans.npy"
_RECORD = [("point", "<f4", (3,)), ("scan", "<i4"), ("intensity", "<f4")]
"""A return in the frame of its tile, m; index of its scan; its intensity, sensor units, NaN if there are none."""
_CHUNK_SCANS = 256  # scans in memory at a time
_CHUNK_RETURNS = 500_000  # returns in memory at a time: fewer scans of a dense sensor
_CHUNK_M = 1000.0  # scans of a chunk share a local frame, in which float32 must be precise
_SENSOR_SCANS = 512  # largest sample of scans for the sensor model
_SAMPLED_TILES = 4  # tiles that estimate noise, units and clutter ratio


def checked_scans(scans: Iterable[Any], digest: hashlib.blake2b) -> Iterator[Scan]:
    """Check scans one by one, add all to `digest`, and yield those with a rigid pose."""
    rigid = []
    for i, scan in enumerate(one_for_each_scan(scans, "scans")):
        check(isinstance(scan, Scan), f"scan {i} is {type(scan).__name__}, not radarsdf.io.Scan", TypeError)
        shape = np.shape(scan.T_world_sensor)
        check(shape == (4, 4), f"scan {i} has no pose: T_world_sensor must be (4, 4), not {shape}")
        for array in (scan.points, scan.T_world_sensor, scan.intensities, scan.doppler_mps, scan.sigma):
            digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
        digest.update(repr(scan.sensor).encode())
        rigid.append(bool(are_rigid(np.asarray(scan.T_world_sensor)[None])[0]))
        if rigid[-1]:
            yield scan
    bad = np.flatnonzero(~np.array(rigid, bool)).tolist()
    wrong = f"{len(bad)} of {len(rigid)} poses are not rigid transforms"
    check(not bad or 2 * len(bad) < len(rigid), f"{wrong}, the first is pose {min(bad, default=0)}")
    for note in LeftOut(poses=bad).notes:
        _LOG.warning(note)


def _chunks(scans: Iterable[Scan], together: int) -> Iterator[list[Scan]]:
    """Yield lists of consecutive scans that keep the groups to accumulate whole."""
    chunk: list[Scan] = []
    for scan in scans:
        if chunk and len(chunk) % together == 0:
            way = np.asarray(scan.T_world_sensor)[:3, 3] - np.asarray(chunk[0].T_world_sensor)[:3, 3]
            is_far, returns = (np.abs(way) >= _CHUNK_M).any(), sum(map(len, chunk))
            if is_far or len(chunk) >= _CHUNK_SCANS or returns >= _CHUNK_RETURNS:
                yield chunk
                chunk = []
        chunk.append(scan)
    if chunk:
        yield chunk


class _Returns:
    def __init__(self) -> None:
        self.samples: list[tuple[int, Scan]] = []  # scans with the smallest hashes
        self.intensities = Intensities()

    def add(self, scan: Scan) -> None:
        self.samples.append((zlib.crc32(np.asarray(scan.points).tobytes()), scan))
        self.samples = sorted(self.samples, key=itemgetter(0))[:_SENSOR_SCANS]

    def median_deviations(self) -> tuple[float, float, float] | None:
        stated = [np.asarray(scan.sigma) for _, scan in self.samples if scan.sigma is not None]
        medians = median_deviations(np.concatenate(stated)) if stated else np.full(3, np.nan)
        along, azimuth, elevation = np.nan_to_num(medians, nan=1.0).tolist()
        return (along, azimuth, elevation) if np.isfinite(medians).any() else None


class Planner:
    def __init__(self, folder: Path, config: FitConfig, grid: TileGrid) -> None:
        self._folder, self._config, self._grid = folder, config, grid
        self._origins: dict[Tile, Ints] = {}  # (3,) origins of the tiles' maps, leaf cells
        self._counts: dict[Tile, Ints] = {}  # numbers of returns in each tile, and of rays
        self._axes: list[Floats] = []  # (F, 7) sensor positions and z axes, world, and row of the radar
        self._radars: dict[Label, _Returns] = {}
        self._with_intensities: bool | None = None
        self._record: np.dtype[np.void] | None = None  # of the first scans

    def _add(self, scans: list[Scan]) -> None:
        first = sum(map(len, self._axes))
        for number, scan in enumerate(scans, first):
            has = scan.intensities is not None
            alike = self._with_intensities in (None, has)
            check(alike, f"all scans have intensities, or none: scan {number} is not like those before it")
            self._with_intensities = has
        rays = self._rays(scans, first)
        for i in np.unique(rays.scans).tolist():
            self._radars.setdefault(scans[i].sensor, _Returns()).add(scans[i])
        row = {label: i for i, label in enumerate(self._radars)}
        radars = np.array([row.get(scan.sensor, 0) for scan in scans], np.int32)  # 0: it has no returns
        poses = np.stack([np.asarray(scan.T_world_sensor, np.float64) for scan in scans])
        together = self._config.returns.accumulate_scans
        seen_from = [middle_scan(i, len(scans), together) for i in range(len(scans))]
        self._axes.append(np.concatenate([poses[seen_from, :3, 3], poses[:, :3, 2], radars[:, None]], axis=1))
        self._record = self._record or record_of(rays.stated is not None)
        if len(rays) == 0:
            return
        if rays.intensities is not None:
            keys = rays.hashes()
            for i, radar in enumerate(self._radars.values()):
                heard = radars[rays.scans] == i
                radar.intensities.add(rays.intensities[heard], keys[heard])
        points, sensors = rays.in_world()
        owner = self._grid.tiles_of(points)
        pairs = zip(*self._grid.crossed(points, sensors), strict=True)
        rows, tiles = (np.concatenate(parts) for parts in pairs)
        for i, j in np.unique(tiles, axis=0).tolist():
            tile, own = (i, j), np.sort(rows[(tiles == (i, j)).all(axis=1)])
            path = rays_path(self._folder, tile)
            if tile not in self._origins:
                middle = self._grid.lower_corner(tile) + self._grid.tile_m / 2
                self._origins[tile] = self._config.lattice.nearest_block([*middle, sensors[own[0], 2]])
                self._counts[tile] = np.zeros(2, np.int64)
                path.parent.mkdir(parents=True)
            self._counts[tile] += (owner[own] == tile).all(axis=1).sum(), len(own)
            records = np.zeros(len(own), self._record)
            records["point"] = points[own] - self._config.lattice.position(self._origins[tile])
            records["scan"] = rays.scans[own] + first
            records["intensity"] = np.nan if rays.intensities is None else rays.intensities[own]
            if "stated" in (self._record.names or ()):
                records["stated"] = np.nan if rays.stated is None else rays.stated[own]
            with path.open("ab") as file:
                file.write(records.data)

    def _rays(self, scans: list[Scan], first: int) -> Rays:
        """Prepare the static returns, checked, in a frame of their own."""
        held = scans_in_memory(scans)
        where = f"of the {len(scans)} scans from number {first} on, numbered from 0"
        with restating(where, ValueError, TypeError):
            given = held.points, held.poses, held.intensities, held.doppler_mps, held.rig
            return static_rays(*given, self._config, held.sigmas, whole=False)[0]

    def plan(self, scans: Iterable[Scan], digest: hashlib.blake2b) -> Plan:
        """Read scans once, write the rays of each tile, and return the plan. `digest`: of the scans, after they are read."""
        for chunk in _chunks(scans, self._config.returns.accumulate_scans):
            self._add(chunk)
        check(self._axes, "there are no scans")
        tiles = []
        for tile, (returns, rays) in sorted(self._counts.items()):
            if returns == 0:
                shutil.rmtree(folder_of(self._folder, tile))
                continue
            x, y, z = self._origins[tile].tolist()
            tiles.append(TilePlan(tile=tile, returns=int(returns), rays=int(rays), origin_cells=(x, y, z)))
        check(tiles, "no return of any scan lies within the ranges")
        axes = np.concatenate(self._axes)
        np.save(self._folder / SCANS_FILE, axes, allow_pickle=False)
        radars = [
            RadarPlan(
                label=label if label is None or isinstance(label, (int, str)) else str(label),
                sensor=self._sensor([(own, SAME_UNIT)]),
                intensity_range=self._intensity_range(own, tiles, axes[:, 6] == i),
                median_deviations=own.median_deviations(),
            )
            for i, (label, own) in enumerate(self._radars.items())
        ]
        draft = Plan(
            config=self._config,
            tile_m=self._grid.tile_m,
            halo_m=self._grid.halo_m,
            clutter_ratio=0.0,
            returns_per_cell=0.0,
            sensor=radars[0].sensor,
            radars=tuple(radars),
            scans=len(axes),
            input_digest=digest.hexdigest(),
            with_deviations=self._record == record_of(True),
            tiles=tuple(tiles),
        )
        plan = self._completed(draft)
        if self._with_intensities:
            check_range(*(plan.intensity_range or (0.0, 0.0)))
        return plan

    def _intensity_range(
        self, radar: _Returns, tiles: list[TilePlan], of_scans: Bools
    ) -> tuple[float, float] | None:
        """Range of the intensities of a radar, that of the scans in the mask `of_scans` (F,). None: it measures none."""
        intensities = radar.intensities
        low, high, plausible = intensities.low, intensities.high, intensities.plausible()
        if not plausible.holds(np.array([low, high])).all():
            low, high = math.inf, -math.inf
            for tile in tiles:
                rows = np.fromfile(rays_path(self._folder, tile.tile), self._record)
                values = rows["intensity"][of_scans[rows["scan"]]]
                values = values[plausible.holds(values)]
                low, high = float(values.min(initial=low)), float(values.max(initial=high))
        return (low, high) if low <= high else None

    def _completed(self, plan: Plan) -> Plan:
        """Complete the plan with the noise, units and clutter ratio of the largest tiles, and the cost of each."""
        num_threads, noises = plan.config.num_threads, list[SensorNoise]()
        units: list[tuple[Unit | None, ...]] = []
        tiles, clutter, returns, cells, in_cells = [], 0.0, 0, 0, 0.0
        plan = self._without_false_deviations(plan)
        for tile in sorted(plan.tiles, key=lambda planned: -planned.returns):
            rays, inside = read_rays(self._folder, plan, tile)
            cost = estimate_rays(rays, plan.config, inside)
            seconds = round(cost.seconds, 3)
            tiles.append(dataclasses.replace(tile, memory_bytes=cost.peak_memory_bytes, seconds=seconds))
            if len(noises) == _SAMPLED_TILES:
                continue
            surfels = Surfels.of(rays, plan.config.leaf_size_m, num_threads)
            noise_of = rig_noise if plan.sensors else sensor_noise
            noises.append(noise_of(surfels, rays, plan.config.returns, num_threads))
            units.append(intensity_units(surfels, rays, num_threads) if plan.sensors else (SAME_UNIT,))
            if (weights := noises[-1].weights(rays)) is not None:
                surfels = Surfels.of(rays, plan.config.leaf_size_m, num_threads, weights)
            clutter += surfels.clutter_ratio() * len(rays)
            returns += len(rays)
            # Of the cells beyond, the tile has only the returns whose rays cross it.
            held = np.unique(surfels.cells_at(rays.points[inside]))
            held = held[held >= 0]
            in_cells += float(surfels.counts[held].sum())
            cells += len(held)
        noise = SensorNoise.median([of_tile.mean for of_tile in noises])
        of_rigs = (rig.of_sensors for rig in noises if isinstance(rig, RigNoise))
        own_noise = [*map(SensorNoise.median, zip(*of_rigs, strict=True))] or [noise]
        # Medians of the tiles in which the units are relative to the first radar.
        alike = [of_tile for of_tile in units if of_tile[0] == SAME_UNIT] or units[:1]
        each = ([unit for unit in of_radar if unit is not None] for of_radar in zip(*alike, strict=True))
        same_unit: list[Unit] = [tuple(np.median(own or [SAME_UNIT], axis=0).tolist()) for own in each]
        radars = []
        for radar, own, unit in zip(plan.radars, own_noise, same_unit, strict=True):
            model = dataclasses.replace(radar.sensor, noise=own, unit=unit)
            radars.append(dataclasses.replace(radar, sensor=model))
        sensor = self._sensor(zip(self._radars.values(), same_unit, strict=True))
        return dataclasses.replace(
            plan,
            config=plan.config.override(returns=dict(zip(NOISE_SETTINGS, noise.deviations, strict=True))),
            sensor=dataclasses.replace(sensor, noise=noise),
            radars=tuple(radars),
            tiles=tuple(sorted(tiles, key=lambda tile: tile.tile)),
            clutter_ratio=clutter / returns,
            returns_per_cell=in_cells / max(cells, 1),
        )

    def _without_false_deviations(self, plan: Plan) -> Plan:
        if not plan.with_deviations:
            return plan
        rays, _ = read_rays(self._folder, plan, max(plan.tiles, key=attrgetter("returns")))
        credible = are_credible(rays, plan.config.leaf_size_m, plan.config.returns, plan.config.num_threads)
        each = zip(plan.radars, credible, strict=True)
        radars = (own if true else dataclasses.replace(own, median_deviations=None) for own, true in each)
        return dataclasses.replace(plan, radars=tuple(radars))

    def _sensor(self, radars: Iterable[tuple[_Returns, Unit]]) -> Sensor:
        """Estimate a sensor without noise from the samples of radars, with the intensities in one unit."""
        scans = [(scan, unit) for own, unit in radars for _, scan in own.samples]
        measured = [(np.asarray(s.intensities), unit) for s, unit in scans if s.intensities is not None]
        values = [in_map_unit(*own) for own in measured]
        limits = {name: getattr(self._config.returns, name) for name in ("min_range_m", "max_range_m")}
        return Sensor.of([scan.points for scan, _ in scans], values or None, **limits)


def record_of(with_deviations: bool) -> np.dtype[np.void]:
    """Return the type of a return in the files, with the deviations that its sensor states, m, rad, rad, NaN where unknown."""
    return np.dtype([*_RECORD, ("stated", "<f4", (3,))] if with_deviations else _RECORD)


def rays_path(folder: Path, tile: Tile) -> Path:
    return folder_of(folder, tile) / "rays.bin"


def read_rays(folder: Path, plan: Plan, tile: TilePlan) -> tuple[Rays, Bools]:
    """Rays that cross a tile, in the frame of its map, with intensities in one unit; and the mask (N,) of returns in it or its halo."""
    path, record = rays_path(folder, tile.tile), record_of(plan.with_deviations)
    whole = path.exists() and path.stat().st_size == tile.rays * record.itemsize
    check(whole, f"{path} does not hold the {tile.rays} rays of the plan: plan again in a new folder")
    rows = np.fromfile(path, record)
    numbers, scans = np.unique(rows["scan"], return_inverse=True)
    of_scans = np.array(array_in(folder / SCANS_FILE)[numbers])  # a memory map, of which few rows are read
    points = np.ascontiguousarray(rows["point"])
    origin = plan.config.lattice.position(tile.origin_cells)
    positions, up = (of_scans[:, :3] - origin)[scans], np.ascontiguousarray(of_scans[:, 3:6])
    rays = rays_from(points, positions, origin, scans.astype(np.int32), up)
    if plan.sensors:
        radar_of_scan = of_scans[:, 6].astype(np.int32)
        rays = dataclasses.replace(rays, sensor_of_scan=radar_of_scan, num_sensors=len(plan.radars))
    if any(radar.median_deviations for radar in plan.radars):
        medians = [np.array(radar.median_deviations, np.float64) for radar in plan.radars]  # NaN for None
        rays = dataclasses.replace(rays, stated=rows["stated"]).with_relative_deviations(medians)
    if plan.intensity_range is not None:
        values = np.full(len(rows), np.nan, np.float32)
        for radar, own in zip(plan.radars, rays.rows_of_sensors(), strict=True):
            if radar.intensity_range is not None:
                kept = Plausible(*radar.intensity_range).kept(rows["intensity"][own])
                values[own] = in_map_unit(kept, radar.sensor.unit)
        rays = dataclasses.replace(rays, intensities=values)
    cells = lattice_of(cell_keys(points, plan.config.leaf_size_m, plan.config.num_threads))[:, :2]
    (lower, upper), halo = plan.box_cells(tile)[:, :2], round(plan.halo_m / plan.config.leaf_size_m)
    inside = (cells >= lower - halo) & (cells < upper + halo)
    return rays, np.asarray(inside.all(axis=1))
