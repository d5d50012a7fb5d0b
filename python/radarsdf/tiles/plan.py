# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The plan of a map in tiles: one JSON file, on which all tasks agree."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.config import FitConfig
from radarsdf.field.intensity_scale import IntensityScale
from radarsdf.io.files import check_regular_file, write_whole
from radarsdf.returns.sensor import Sensor
from radarsdf.tiles.grid import Tile, TileGrid

FORMAT = "radarsdf.tiles"
FORMAT_VERSION = 1
PLAN = "plan.json"


@dataclass(frozen=True)
class TilePlan:
    """What is known of one tile before its fit."""

    tile: Tile
    """Its number along x and y."""
    returns: int
    """Returns that it owns: those in the tile itself."""
    rays: int
    """Rays that cross it or its halo."""
    origin_cells: tuple[int, int, int]
    """Origin of its map: the corner of a block, in leaf cells of the lattice."""
    scans: tuple[int, int]
    """The first and the last scan with a ray here."""
    memory_bytes: int = 0
    """Estimate of what its fit takes."""
    seconds: float = 0.0
    """Estimate of the time of its fit."""

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.tile[0]}_{self.tile[1]}"


@dataclass(frozen=True)
class Plan:
    """What the tasks have in common, and a list of tiles. Tiles are pure functions of their plan and their rays."""

    config: FitConfig
    """Settings of all fits, with the noise of the sensor and the number of threads, on which bits may depend."""
    tile_m: float
    """Edge of a tile, m."""
    halo_m: float
    """What a tile knows beyond its edges, m."""
    intensity_range: tuple[float, float] | None
    """Lowest and highest intensity, sensor units. None: there are none."""
    rough_share: float
    """Share of the returns that lie on no thin surface, of the largest tiles."""
    sensor: Sensor
    """The radar."""
    scans: int
    """Number of scans."""
    input_digest: str
    """Of all scans, poses and intensities."""
    tiles: tuple[TilePlan, ...]
    """The tiles that own a return, in ascending order."""

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
        return None if self.intensity_range is None else IntensityScale.between(*self.intensity_range)

    @property
    def tile_cells(self) -> int:
        """Edge of a tile, leaf cells."""
        return round(self.tile_m / self.config.leaf_size_m)

    def origin_cells(self, tile: Tile) -> np.ndarray[Any, np.dtype[np.int64]]:
        """(3,) origin of a tile's map, leaf cells of the lattice."""
        return np.array(self.by_tile[tile].origin_cells, np.int64)

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
        check_regular_file(path)
        try:
            described = json.loads(path.read_bytes())
            if described.pop("format") != FORMAT or described.pop("format_version") != FORMAT_VERSION:
                msg = f"it is not a plan of format {FORMAT}, version {FORMAT_VERSION}"
                raise ValueError(msg)
            tiles = [
                TilePlan(
                    **planned | {name: tuple(planned[name]) for name in ("tile", "origin_cells", "scans")}
                )
                for planned in described.pop("tiles")
            ]
            intensities = described.pop("intensity_range")
            return cls(
                config=FitConfig.from_dict(described.pop("config")),
                sensor=Sensor.from_dict(described.pop("sensor")),
                intensity_range=None
                if intensities is None
                else (float(intensities[0]), float(intensities[1])),
                tiles=tuple(tiles),
                **described,
            )
        except Exception as error:  # damaged files raise exceptions of many kinds
            msg = f"{path} is not a whole plan: {error}"
            raise ValueError(msg) from error


def folder_of(folder: Path, tile: TilePlan) -> Path:
    """Where the files of a tile are."""
    return folder / "tiles" / tile.name


def map_path(folder: Path, tile: TilePlan) -> Path:
    """The map of a tile."""
    return folder_of(folder, tile) / "map.safetensors"


def failure_path(folder: Path, tile: TilePlan) -> Path:
    """Why the fit of a tile failed."""
    return folder_of(folder, tile) / "failed.txt"
