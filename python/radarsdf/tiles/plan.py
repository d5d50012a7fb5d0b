# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The plan of a map in tiles: one JSON file, on which all tasks agree."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import os
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from radarsdf.checks import MAX_POSITION_M
from radarsdf.config.fit_config import FitConfig
from radarsdf.io.files import check_regular_file, write_whole
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN
from radarsdf.settings import by_name, settings
from radarsdf.tiles.grid import Tile, TileGrid

FORMAT = "radarsdf.tiles"
FORMAT_VERSION = 1
PLAN, TILES = "plan.json", "tiles"
_Count = Annotated[int, Field(ge=0, le=2**53)]
_Number = Annotated[int, Field(ge=-(2**53), le=2**53)]  # of a tile or a cell
_Length = Annotated[float, Field(gt=0, le=MAX_POSITION_M)]
_MAX_REASON_BYTES = 10_000
_FromList = Field(strict=False)  # JSON has lists, not tuples


@settings
class TilePlan:
    """What is known of one tile before its fit."""

    tile: Annotated[tuple[_Number, _Number], _FromList]
    """Its number along x and y."""
    returns: _Count
    """Returns that it owns: those in the tile itself."""
    rays: Annotated[_Count, Field(ge=1)]
    """Rays that cross it or its halo."""
    origin_cells: Annotated[tuple[_Number, _Number, _Number], _FromList]
    """Origin of its map: the corner of a block, in leaf cells of the lattice."""
    scans: Annotated[tuple[_Count, _Count], _FromList]
    """The first and the last scan with a ray here."""
    memory_bytes: _Count = 0
    """Estimate of what its fit takes."""
    seconds: Annotated[float, Field(ge=0)] = 0.0
    """Estimate of the time of its fit."""

    @property
    def name(self) -> str:
        """Of its files."""
        return _name(self.tile)


@settings
class Plan:
    """What the tasks have in common, and a list of tiles. Tiles are pure functions of their plan and their rays.

    Raises
    ------
    ValueError
        If a value is of a wrong type or out of range, or values contradict each other. Folders are named by these
        numbers, so nothing else must come in from a file.
    """

    config: FitConfig
    """Settings of all fits, with the noise of the sensor and the number of threads, on which bits may depend."""
    tile_m: _Length
    """Edge of a tile, m."""
    halo_m: _Length
    """What a tile knows beyond its edges, m."""
    intensity_range: Annotated[tuple[float, float], _FromList] | None
    """Lowest and highest intensity of those that can belong to the others, sensor units; a fit leaves out what is beyond.
    None: there are none."""
    rough_share: Annotated[float, Field(ge=0, le=1)]
    """Share of the returns that lie on no thin surface, of the largest tiles."""
    returns_per_cell: Annotated[float, Field(ge=0)]
    """Mean number of returns in the cells of surfels of these tiles."""
    sensor: Sensor
    """The radar."""
    scans: Annotated[_Count, Field(ge=1)]
    """Number of scans."""
    input_digest: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    """Of all scans, poses and intensities."""
    tiles: Annotated[tuple[TilePlan, ...], Field(min_length=1)]
    """The tiles that own a return, in ascending order."""

    def __post_init__(self) -> None:
        lattice = self.config.lattice
        for name in ("tile_m", "halo_m"):
            blocks = getattr(self, name) / lattice.block_m
            if round(blocks) < 1 or not math.isclose(blocks, round(blocks), rel_tol=1e-9):
                msg = f"plan.{name} must be a multiple of {lattice.block_m:g} m, not {getattr(self, name)}"
                raise ValueError(msg)
        if self.halo_m > self.tile_m:
            msg = f"plan.halo_m must be at most plan.tile_m, {self.tile_m}, not {self.halo_m}"
            raise ValueError(msg)
        if self.intensity_range is not None:
            IntensityScale.between(self.intensity_range)
        if any(a.tile >= b.tile for a, b in itertools.pairwise(self.tiles)):
            msg = "plan.tiles must be in ascending order, each of them once"
            raise ValueError(msg)
        for planned in self.tiles:
            corners = (*self.grid.lower_corner(planned.tile), *lattice.position(planned.origin_cells))
            if not np.abs(corners).max() <= MAX_POSITION_M:
                msg = f"plan.tiles: tile {planned.name} is more than {MAX_POSITION_M:g} m away"
                raise ValueError(msg)
            if any(cells % lattice.block_cells for cells in planned.origin_cells):
                msg = f"plan.tiles: the origin of tile {planned.name} is not the corner of a block"
                raise ValueError(msg)
            if not planned.scans[0] <= planned.scans[1] < self.scans:
                msg = f"plan.tiles: tile {planned.name} has other scans than 0 to {self.scans - 1}"
                raise ValueError(msg)

    @cached_property
    def grid(self) -> TileGrid:
        """Of the tiles."""
        return TileGrid(self.tile_m, self.halo_m, float(self.config.lattice.position(0)))

    @cached_property
    def by_tile(self) -> dict[Tile, TilePlan]:
        """The same tiles by their numbers."""
        return {planned.tile: planned for planned in self.tiles}

    @property
    def scale(self) -> IntensityScale | None:
        """Of the intensities."""
        return None if self.intensity_range is None else IntensityScale.between(self.intensity_range)

    @property
    def tile_cells(self) -> int:
        """Edge of a tile, leaf cells."""
        return round(self.tile_m / self.config.leaf_size_m)

    def origin_cells(self, tile: Tile) -> np.ndarray[Any, np.dtype[np.int64]]:
        """(3,) origin of a tile's map, leaf cells of the lattice."""
        return np.array(self.by_tile[tile].origin_cells, np.int64)

    def box_cells(self, tile: Tile) -> np.ndarray[Any, np.dtype[np.int64]]:
        """(2, 3) first leaf cell of a tile, and the one after the last, from the origin of its map. Of any height."""
        first = np.array([*(np.array(tile) * self.tile_cells), -MAX_CELLS_FROM_ORIGIN])
        first[:2] -= self.origin_cells(tile)[:2]
        return np.stack([first, [*(first[:2] + self.tile_cells), MAX_CELLS_FROM_ORIGIN]])

    @cached_property
    def digest(self) -> str:
        """Of all that is in the plan. Results of another plan are not taken for results of this one."""
        return hashlib.blake2b(self._to_json(), digest_size=16).hexdigest()

    def _to_json(self) -> bytes:
        described = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "config": self.config.to_dict(),
            "tile_m": self.tile_m,
            "halo_m": self.halo_m,
            "intensity_range": self.intensity_range,
            "rough_share": self.rough_share,
            "returns_per_cell": self.returns_per_cell,
            "sensor": self.sensor.to_dict(),
            "scans": self.scans,
            "input_digest": self.input_digest,
            "tiles": [dataclasses.asdict(planned) for planned in self.tiles],
        }
        return json.dumps(described, indent=1).encode()

    def save(self, folder: Path) -> None:
        """Writes the plan, whole or not at all."""
        write_whole(folder / PLAN, self._to_json())

    @classmethod
    def load(cls, folder: Path) -> Plan:
        """Reads the plan of a folder.

        Raises
        ------
        ValueError
            If the folder has none, or it is damaged, or of another version.
        OSError
            If it cannot be read.
        """
        path = folder / PLAN
        if folder.is_dir() and not path.exists():
            msg = f"{folder} is no map: a folder that radarsdf tiles wrote has a {PLAN}"
            raise ValueError(msg)
        path = within(folder, path)
        check_regular_file(path)
        try:
            described = by_name(json.loads(path.read_bytes()), "the plan")
            if (described.pop("format", None), described.pop("format_version", None)) != (
                FORMAT,
                FORMAT_VERSION,
            ):
                msg = f"it is not a plan of format {FORMAT}, version {FORMAT_VERSION}"
                raise ValueError(msg)
            tiles = described.pop("tiles", None)
            if not isinstance(tiles, list):
                msg = f"plan.tiles must be a list, not {tiles!r:.50}"
                raise ValueError(msg)  # noqa: TRY004 - of a file, a wrong type is a wrong value
            return cls(
                config=FitConfig.from_dict(described.pop("config", None)),
                sensor=Sensor.from_dict(described.pop("sensor", None)),
                tiles=tuple(TilePlan(**by_name(planned, "a tile of the plan")) for planned in tiles),
                **described,
            )
        except Exception as error:  # damaged files raise exceptions of many kinds
            msg = f"{path} is not a whole plan: {error}"
            raise ValueError(msg) from error


def within(folder: Path, path: Path) -> Path:
    """`path`, which is in the folder of a map in tiles.

    The folder may be a link, and what is in it may link to other places in it. But a folder that comes from elsewhere must
    not lead what is written or read to a file of somebody else.

    Raises
    ------
    ValueError
        If a link leads out of the folder.
    """
    if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
        msg = f"{path} is a link that leads out of {folder}, which a map in tiles must not have"
        raise ValueError(msg)
    return path


def _name(tile: Tile) -> str:
    return f"{tile[0]}_{tile[1]}"


def folder_of(folder: Path, tile: Tile) -> Path:
    """Where the files of a tile are."""
    return folder / TILES / _name(tile)


def map_path(folder: Path, tile: TilePlan) -> Path:
    """The map of a tile."""
    return within(folder, folder_of(folder, tile.tile) / "map.safetensors")


def failure_path(folder: Path, tile: TilePlan) -> Path:
    """Why the fit of a tile failed."""
    return within(folder, folder_of(folder, tile.tile) / "failed.txt")


def failure_of(folder: Path, tile: TilePlan) -> str:
    """Why the fit of a tile failed, as one line of letters; empty if it was not tried, or was killed."""
    path = failure_path(folder, tile)
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        text = file.read(_MAX_REASON_BYTES).decode(errors="replace")
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()
