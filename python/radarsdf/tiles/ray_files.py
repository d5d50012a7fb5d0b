# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The rays of a tile in a file: written a part at a time, read whole by the tile's fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import cell_keys
from radarsdf.checks import MAX_POSITION_M
from radarsdf.io.files import check_regular_file
from radarsdf.io.npz import array_in
from radarsdf.returns.intensities import Plausible
from radarsdf.returns.rays import Rays, rays_from
from radarsdf.returns.sums import lattice_of
from radarsdf.tiles.grid import Tile
from radarsdf.tiles.plan import Plan, TilePlan, folder_of, within

_RECORD = np.dtype([("point", "<f4", (3,)), ("scan", "<i4"), ("intensity", "<f4")])
"""A return in the frame of its tile, m; its scan; its intensity, sensor units, NaN if there are none."""
_BUFFER_BYTES = 64 << 20  # of all tiles together, before they are appended to their files
SCANS_FILE = "scans.npy"


class RayFiles:
    """Appends returns to the files of tiles. What was there before is replaced."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._buffers: dict[Tile, list[NDArray[np.void]]] = {}
        self._begun: set[Tile] = set()
        self._held_bytes = 0

    def add(
        self,
        tile: Tile,
        points: NDArray[np.float32],
        scans: NDArray[np.int32],
        intensities: NDArray[np.float32] | None,
    ) -> None:
        """Returns (N, 3) of a tile, in its frame, m, scan by scan."""
        rows = np.zeros(len(points), _RECORD)
        rows["point"], rows["scan"] = points, scans
        rows["intensity"] = np.nan if intensities is None else intensities
        self._buffers.setdefault(tile, []).append(rows)
        self._held_bytes += rows.nbytes
        if self._held_bytes > _BUFFER_BYTES:
            self.flush()

    def flush(self) -> None:
        """Writes what is held."""
        for tile, parts in self._buffers.items():
            path = rays_path(self._folder, tile)
            if tile not in self._begun:
                path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab" if tile in self._begun else "wb") as file:
                for rows in parts:
                    file.write(rows.data)
            self._begun.add(tile)
        self._buffers, self._held_bytes = {}, 0

    def remove(self, tile: Tile) -> None:
        """Removes the file of a tile, and its folder if that is then empty."""
        path = rays_path(self._folder, tile)
        path.unlink(missing_ok=True)
        if not any(path.parent.iterdir()):
            path.parent.rmdir()


def write_scan_axes(folder: Path, positions: NDArray[np.float64], up: NDArray[np.float64]) -> None:
    """Writes from where each scan was seen and its z axis, (F, 3) each, world, m."""
    np.save(within(folder, folder / SCANS_FILE), np.concatenate([positions, up], axis=1), allow_pickle=False)


def read_rays(folder: Path, plan: Plan, tile: TilePlan) -> tuple[Rays, NDArray[np.bool_]]:
    """The rays that cross a tile, in the frame of its map, and which of their returns (N,) are in it or its halo.

    Raises
    ------
    ValueError
        If the file is gone, or is not what the plan says.
    OSError
        If it cannot be read.
    """
    path = rays_path(folder, tile.tile)
    if not path.exists():
        msg = f"{path} is gone, as after radarsdf tiles clean: fit the scans again in a new folder"
        raise ValueError(msg)
    check_regular_file(path)
    found = path.stat().st_size / _RECORD.itemsize
    if found != tile.rays:
        msg = f"{path} has {found:g} rays instead of {tile.rays}: make the plan again"
        raise ValueError(msg)
    rows = np.fromfile(path, _RECORD)
    table = array_in(within(folder, folder / SCANS_FILE))  # of which few rows are needed
    if (
        table.shape != (plan.scans, 6)
        or table.dtype != np.float64
        or not 0 <= rows["scan"].min() <= rows["scan"].max() < plan.scans
    ):
        msg = f"{folder / SCANS_FILE} does not belong to {path}: make the plan again"
        raise ValueError(msg)
    numbers, scans = np.unique(rows["scan"], return_inverse=True)
    of_scans = np.array(table[numbers])
    points = np.ascontiguousarray(rows["point"])
    if not ((np.abs(points) <= MAX_POSITION_M).all() and (np.abs(of_scans) <= MAX_POSITION_M).all()):
        msg = f"{path} or {folder / SCANS_FILE} holds something other than finite positions: make the plan again"
        raise ValueError(msg)
    intensities = None
    if plan.intensity_range is not None:
        values = rows["intensity"]
        if not np.isfinite(values).all():
            msg = f"{path} holds an intensity that is not finite: make the plan again"
            raise ValueError(msg)
        intensities = Plausible(*plan.intensity_range).kept(values)
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


def read_intensities(folder: Path, tile: Tile) -> NDArray[np.float32]:
    """(N,) of the rays that cross a tile, as they were given, sensor units."""
    intensities: NDArray[np.float32] = np.fromfile(rays_path(folder, tile), _RECORD)["intensity"]
    return intensities


def rays_path(folder: Path, tile: Tile) -> Path:
    """The rays of a tile."""
    return within(folder, folder_of(folder, tile) / "rays.bin")
