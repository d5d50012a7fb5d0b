"""Plan of a tiled map: one JSON file shared by all tasks, and the paths of the tiles' files."""

import hashlib
import itertools
import json
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter
from safetensors import SafetensorError

from radarsdf.arrays import Array, Bools, Floats, Ints
from radarsdf.checks import MAX_POSITION_M, check
from radarsdf.config.fit_config import FitConfig
from radarsdf.io.files import check_regular_file, reading, write_whole
from radarsdf.io.tensors import open_tensors
from radarsdf.map.radar_map import checked_report
from radarsdf.returns.noise import RigNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.sensor import Radars, Sensor, in_map_unit
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN
from radarsdf.rig import Label
from radarsdf.settings import by_name, settings

FORMAT = {"format": "radarsdf.tiles", "format_version": 5}
PLAN, TILES = "plan.json", "tiles"

Tile = tuple[int, int]
"""Index of a tile along x and y. Tile (0, 0) begins at the origin of the world's lattice."""

_Count = Annotated[int, Field(ge=0, le=2**53)]
_Number = Annotated[int, Field(ge=-(2**53), le=2**53)]  # index of a tile or a cell
_Length = Annotated[float, Field(gt=0, le=MAX_POSITION_M)]
_MAX_REASON_BYTES = 10_000


@dataclass(frozen=True)
class TileGrid:
    """Squares of the horizontal plane, unbounded in height, with a halo around each."""

    tile_m: float  # edge of a tile: a multiple of the block
    halo_m: float  # margin of a tile's returns: at most its edge
    corner_m: float  # lower corner of tile (0, 0) along x and y, world

    def lower_corner(self, tile: Tile) -> Floats:
        """(2,) lower corner of a tile, world, m."""
        return self.corner_m + np.array(tile) * self.tile_m

    def tiles_of(self, positions: Array) -> Ints:
        """(N, 2) tiles that contain positions (N, 3), world, m."""
        return np.floor(self._along(positions) / self.tile_m).astype(np.int64)

    def crossed(self, ends: Floats, others: Floats) -> Iterator[tuple[Ints, Ints]]:
        """Rows (M,) of segments from `ends` to `others` (N, 3), world, m, and the tiles (M, 2) whose halos they enter, unique."""
        a, b = self._along(ends), self._along(others)
        lower, upper = np.minimum(a, b) - self.halo_m, np.maximum(a, b) + self.halo_m
        first, last = (np.floor(ends / self.tile_m).astype(np.int64) for ends in (lower, upper))
        most = (last - first).max(axis=0, initial=-1)
        for step in itertools.product(range(most[0] + 1), range(most[1] + 1)):
            rows = np.flatnonzero((first + step <= last).all(axis=1))
            tiles = first[rows] + step
            meets = self._meets(a[rows], b[rows], tiles)
            yield rows[meets], tiles[meets]

    def _meets(self, a: Floats, b: Floats, tiles: Ints) -> Bools:
        """Whether segments, relative to the corner of tile (0, 0), meet the boxes of their tiles, all (M, 2), by slabs."""
        lower, extent = tiles * self.tile_m - self.halo_m, b - a
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([lower - a, lower + self.tile_m + 2 * self.halo_m - a]) / extent
        # A segment parallel to a slab is inside it: the tiles come from the segment's own bounds.
        enter = np.where(extent == 0, -np.inf, ends.min(axis=0)).max(axis=1)
        leave = np.where(extent == 0, np.inf, ends.max(axis=0)).min(axis=1)
        return np.maximum(enter, 0) <= np.minimum(leave, 1)

    def weights(self, tile: Tile, positions: Floats) -> Floats:
        """(N,) weights of a tile at positions (N, 3), world, m. The weights of all tiles sum to one.

        They rise smoothly within half a halo around each edge. The outer half, where a tile knows less, has no weight.
        """
        beyond_lower = self._along(positions, tile)
        factors = np.ones((len(positions), 2))
        for inwards in (beyond_lower, self.tile_m - beyond_lower):
            t = np.clip(inwards / self.halo_m + 0.5, 0.0, 1.0)
            factors *= t * t * (3 - 2 * t)
        return factors.prod(axis=1)

    def within_half_a_halo(self, tile: Tile, positions: Floats) -> Ints:
        """(M,) rows of positions (N, 3), world, m, at which a tile has a weight."""
        from_corner, half_m = self._along(positions, tile), self.halo_m / 2
        return np.flatnonzero(((from_corner > -half_m) & (from_corner < self.tile_m + half_m)).all(axis=1))

    def _along(self, positions: Array, tile: Tile = (0, 0)) -> Floats:
        """(N, 2) offsets of positions (N, 3), world, m, from the lower corner of a tile."""
        return positions[:, :2] - self.corner_m - np.array(tile) * self.tile_m


@settings
class TilePlan:
    """Properties of a tile known before its fit."""

    tile: tuple[_Number, _Number]
    returns: _Count  # number of returns in the tile itself
    rays: Annotated[_Count, Field(ge=1)]  # crossing it or its halo
    origin_cells: tuple[_Number, _Number, _Number]  # origin of its map, in the lattice
    memory_bytes: _Count = 0  # estimates for its fit
    seconds: Annotated[float, Field(ge=0)] = 0.0

    @property
    def name(self) -> str:
        return f"{self.tile[0]}_{self.tile[1]}"


@settings
class RadarPlan:
    label: int | str | None  # None: it is the only one
    sensor: Sensor  # with its noise, and its unit
    intensity_range: tuple[float, float] | None  # without outliers, its own units
    # Medians of the deviations that it states for range, azimuth and elevation, m, rad, rad. None: it states none, or false ones
    median_deviations: tuple[float, float, float] | None


@settings
class Plan:
    """Settings common to all tasks, and the tiles. Its numbers name folders, so their types are checked."""

    config: FitConfig  # settings of all fits, with the sensor's noise and the number of threads
    tile_m: _Length
    halo_m: _Length
    clutter_ratio: Annotated[float, Field(ge=0, le=1)]  # clutter ratio of the largest tiles
    returns_per_cell: Annotated[float, Field(ge=0)]  # mean over the cells of surfels of the same tiles
    sensor: Sensor
    radars: Annotated[tuple[RadarPlan, ...], Field(min_length=1)]
    scans: Annotated[_Count, Field(ge=1)]
    input_digest: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]  # hash of all scans
    with_deviations: bool  # whether the files of the rays have the deviations that sensors state
    tiles: Annotated[tuple[TilePlan, ...], Field(min_length=1)]  # ascending: tiles that contain a return

    @cached_property
    def grid(self) -> TileGrid:
        return TileGrid(self.tile_m, self.halo_m, float(self.config.lattice.position(0)))

    @property
    def tile_cells(self) -> int:
        """Edge of a tile, leaf cells."""
        return round(self.tile_m / self.config.leaf_size_m)

    def box_cells(self, tile: TilePlan) -> Ints:
        """(2, 3) first leaf cell of a tile and the one after the last, from the origin of its map, unbounded in height."""
        first = np.array(tile.tile) * self.tile_cells - tile.origin_cells[:2]
        height = MAX_CELLS_FROM_ORIGIN
        return np.array([[*first, -height], [*(first + self.tile_cells), height]])

    @property
    def intensity_range(self) -> tuple[float, float] | None:
        """Range of the intensities without outliers, in one unit. None: there are none."""
        measuring = [radar for radar in self.radars if radar.intensity_range]
        ends = [in_map_unit(np.array(radar.intensity_range), radar.sensor.unit) for radar in measuring]
        return (float(np.min(ends)), float(np.max(ends))) if ends else None

    @property
    def sensors(self) -> dict[Label, Sensor]:
        """Radars of a rig by label; empty if there is one."""
        return {radar.label: radar.sensor for radar in self.radars if radar.label is not None}

    def radars_of(self, rays: Rays) -> Radars | None:
        """Radars of the rays of a tile; None if there is one."""
        if not self.sensors:
            return None
        noise = RigNoise.of([sensor.noise for sensor in self.sensors.values()], rays)
        return Radars(tuple(self.sensors), noise, tuple(sensor.unit for sensor in self.sensors.values()))

    @cached_property
    def digest(self) -> str:
        """Hash of the whole plan, by which results of another plan are recognised."""
        return hashlib.blake2b(self._to_json(), digest_size=16).hexdigest()

    def digest_of(self, tile: TilePlan) -> str:
        """Identifier of the map of a tile: that of the plan, and the name, since a file may lie in the place of another."""
        return f"{self.digest} {tile.name}"

    def _to_json(self) -> bytes:
        own = asdict(self) | {"sensor": self.sensor.to_dict()}
        own["radars"] = [vars(radar) | {"sensor": radar.sensor.to_dict()} for radar in self.radars]
        return json.dumps(FORMAT | own, indent=1).encode()

    def save(self, folder: Path) -> None:
        write_whole(folder / PLAN, self._file_bytes())

    def _file_bytes(self) -> bytes:
        content = self._to_json()
        return content[:-2] + f',\n "crc32": {zlib.crc32(content)}\n}}'.encode()

    @classmethod
    def load(cls, folder: Path) -> "Plan":
        """Load the plan of a folder. Raises a ValueError if it is missing, damaged, or of another version."""
        path = folder / PLAN
        planned = path.exists() or not folder.is_dir()
        check(planned, f"{folder} is not a map: folders written by radarsdf tiles have a {PLAN}")
        check_regular_file(path)
        with reading(path, "a complete plan", Exception):  # damaged files raise exceptions of many kinds
            content = path.read_bytes()
            described = by_name(json.loads(content), "the plan")
            check({name: described.pop(name, None) for name in FORMAT} == FORMAT, f"it is not of {FORMAT}")
            described.pop("crc32")
            plan = TypeAdapter(cls).validate_json(json.dumps(described))  # as JSON, whose lists become tuples
            check(plan._file_bytes() == content, "its checksum is wrong")
            return plan


def folder_of(folder: Path, tile: Tile) -> Path:
    return folder / TILES / f"{tile[0]}_{tile[1]}"


def map_path(folder: Path, tile: TilePlan) -> Path:
    return folder_of(folder, tile.tile) / "map.safetensors"


def failure_path(folder: Path, tile: TilePlan) -> Path:
    """File with the reason why the fit of a tile failed."""
    return folder_of(folder, tile.tile) / "failed.txt"


def failure_of(folder: Path, tile: TilePlan) -> str:
    """Reason why the fit of a tile failed, as one printable line; empty if it was not tried, or was killed."""
    try:
        text = failure_path(folder, tile).read_bytes()[:_MAX_REASON_BYTES].decode(errors="replace")
    except OSError:
        return ""
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()


def is_done(folder: Path, plan: Plan, tile: TilePlan) -> bool:
    """Whether the map of a tile exists and belongs to this plan. Only the header of its file is read."""
    try:
        return bool(report_of(folder, tile)["plan"] == plan.digest_of(tile))
    except (OSError, KeyError, ValueError):
        return False


def report_of(folder: Path, tile: TilePlan) -> dict[str, Any]:
    """Report of the fit of a finished tile, see :attr:`Map.report`. Raises a ValueError if it is damaged."""
    path = map_path(folder, tile)
    wrong = SafetensorError, KeyError, TypeError, RecursionError
    with reading(path, "a complete radarsdf map", *wrong), open_tensors(path, "np") as file:
        _ = file.checksums  # raises a ValueError if that of the metadata is wrong
        return checked_report(json.loads(file.metadata["description"])["report"])
