# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Maps of any size: scans to tiles, a fit for each, and one map."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from concurrent.futures import Executor
from contextlib import suppress
from os import PathLike
from pathlib import Path

import torch

from radarsdf.checks import instance, path_of, positive
from radarsdf.config.fit_config import FitConfig, settings_of_results
from radarsdf.fitting.steps import FitInput, fit_rays
from radarsdf.io.files import take_lock, write_whole
from radarsdf.io.read import read
from radarsdf.io.scans import Scan, Scans
from radarsdf.returns.noise import NOISE_SETTINGS
from radarsdf.tiles.plan import PLAN, TILES, Plan, TileGrid, failure_path, is_done, map_path
from radarsdf.tiles.planning import SCANS_FILE, CheckedScans, make_plan, read_rays
from radarsdf.tiles.tasks import run_tasks
from radarsdf.tiles.tiled_map import TiledMap

_TILE_CELLS = 512  # edge of a tile, leaf cells
_HALO_CELLS = 64  # half of it counts; see docs/tiles.md
_LOCK = "plan.lock"
_OURS = {PLAN, _LOCK, TILES, SCANS_FILE}


def fit_tiles(
    scans: str | PathLike[str] | Scans | Iterable[Scan],
    out: str | PathLike[str],
    *,
    tile_size: float | None = None,
    halo: float | None = None,
    executor: Executor | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
) -> TiledMap:
    """Fit a map in tiles. Neither all returns nor all of the map are ever in memory.

    If `out` holds a plan of the same scans and settings, tiles that are done are kept: call it again after anything went
    wrong. The result has the same bits with any executor, if ``config.num_threads`` is given.

    Parameters
    ----------
    scans : path-like, Scans, or iterable of Scan
        A path is read by :func:`radarsdf.io.read`. Scans may come one after another; they are read once.
    out : path-like
        A folder, which is made.
    tile_size : float, optional
        Edge of a tile, m, moved to the next multiple of a block of ``config.lattice``. Default: 512 leaf cells.
    halo : float, optional
        Width of the margin round each tile whose returns it is fitted to, m, moved to a multiple of a block. Tiles overlap in
        half of it. Default: 64 leaf cells.
    executor : concurrent.futures.Executor, optional
        What runs the fits: processes, or that of a cluster (``Client.get_executor(pure=False)`` of dask.distributed).
        By default one after another in this process.
    config : FitConfig, optional
        Settings of the fits. With an executor, each has one thread unless ``num_threads`` says otherwise.
    progress : bool, optional
        Whether to show progress bars. By default only on a terminal.

    Returns
    -------
    TiledMap
        Its ``missing`` names the tiles that failed, and why.

    Raises
    ------
    ValueError
        If a scan is invalid, `out` holds something else or another plan, or all tiles failed.
    OSError
        If `out` cannot be written, or another process makes its plan.
    """
    threads = None if executor is None else 1
    plan_tiles(scans, out, tile_size=tile_size, halo=halo, config=config, threads=threads)
    return run_fits(out, executor=executor, progress=progress)


def plan_tiles(
    scans: str | PathLike[str] | Scans | Iterable[Scan],
    out: str | PathLike[str],
    *,
    tile_size: float | None = None,
    halo: float | None = None,
    config: FitConfig | None = None,
    threads: int | None = None,
) -> Plan:
    """Writes the plan and the rays of each tile, in one pass over the scans. `threads`: of a fit, if `config` names none."""
    folder = path_of(out, "out")
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    grid = _grid(config, tile_size, halo)
    given = CheckedScans(read(scans) if isinstance(scans, (str, PathLike)) else scans)
    if not (folder / PLAN).is_file():
        if folder.is_dir() and not {path.name for path in folder.iterdir()} <= _OURS:
            msg = f"{folder} holds other files: give a new folder"
            raise ValueError(msg)
        folder.mkdir(exist_ok=True)
        lock = take_lock(folder / _LOCK, "planned")
        try:
            if not (folder / PLAN).is_file():  # another process may just have made it
                shutil.rmtree(folder / TILES, ignore_errors=True)  # of a plan that was not finished
                config = config.override(num_threads=config.num_threads or threads or torch.get_num_threads())
                plan = make_plan(given, folder, config, grid)
                plan.save(folder)
                return plan
        finally:
            os.close(lock)
    return _known_plan(folder, config, grid, given)


def _known_plan(folder: Path, config: FitConfig, grid: TileGrid, given: CheckedScans) -> Plan:
    """The plan in a folder. Raises a ValueError if it is of other scans or settings."""
    plan = Plan.load(folder)
    if config.num_threads not in (0, plan.config.num_threads):
        msg = f"{folder} was planned for {plan.config.num_threads} threads a tile, not {config.num_threads}"
        raise ValueError(msg)
    unknown = [name for name in NOISE_SETTINGS if getattr(config.returns, name) is None]
    found = {name: getattr(plan.config.returns, name) for name in unknown}
    ours, theirs = (settings_of_results(own) for own in (config.override(returns=found), plan.config))
    different = [name for name in ours if ours[name] != theirs[name]]
    different += ["tile_size"] * (grid.tile_m != plan.tile_m) + ["halo"] * (grid.halo_m != plan.halo_m)
    if not different:
        for _ in given:
            pass
        different += ["scans"] * (given.digest != plan.input_digest)
    if different:
        msg = f"{folder} holds another plan: {', '.join(different)} differ; give a new folder"
        raise ValueError(msg)
    return plan


def run_fits(
    folder: str | PathLike[str],
    *,
    executor: Executor | None = None,
    names: Iterable[str] | None = None,
    progress: bool | None = None,
) -> TiledMap:
    """The second step: fits the tiles of a plan that are not done, all or those of these `names`."""
    root = path_of(folder, "folder")
    plan = Plan.load(root)
    wanted = {tile.name for tile in plan.tiles} if names is None else set(names)
    if unknown := wanted - {tile.name for tile in plan.tiles}:
        msg = f"{folder} has no tile {min(unknown)}"
        raise ValueError(msg)
    todo = [tile for tile in plan.tiles if tile.name in wanted and not is_done(root, plan, tile)]
    failed = run_tasks(fit_tile, [(str(root), tile.name) for tile in todo], executor, progress=progress)
    for i, tile in enumerate(todo):
        with suppress(OSError):  # a disk that is full has said so
            if i in failed and not is_done(root, plan, tile):
                write_whole(failure_path(root, tile), failed[i].encode())
            else:
                failure_path(root, tile).unlink(missing_ok=True)
    if failed and len(failed) == len(plan.tiles):
        msg = f"all {len(failed)} tiles failed, the first: {failed[0]}"
        raise ValueError(msg)
    return TiledMap(root)


def fit_tile(folder: str, name: str, run: str = "") -> None:  # noqa: ARG001 - see run_tasks
    """Fits a tile, unless its map is there. A task takes names, so that it can run anywhere."""
    root = Path(folder)
    plan = Plan.load(root)
    (tile,) = (planned for planned in plan.tiles if planned.name == name)
    if is_done(root, plan, tile):
        return

    def read() -> FitInput:
        rays, inside = read_rays(root, plan, tile)
        return FitInput(
            rays,
            plan.scale,
            inside=inside,
            rough_share=plan.rough_share,
            returns_per_cell=plan.returns_per_cell,
            sensor=plan.sensor,
            box_cells=plan.box_cells(tile.tile),
        )

    radar_map = fit_rays(read, plan.config, progress=False)
    radar_map.report["plan"] = plan.digest
    radar_map.save(map_path(root, tile))


def _grid(config: FitConfig, tile_size: float | None, halo: float | None) -> TileGrid:
    lattice = config.lattice

    def blocks(value: float | None, cells: int, name: str) -> float:
        wanted = cells * lattice.cell_m if value is None else positive(value, name)
        return lattice.block_m * max(1, round(wanted / lattice.block_m))

    tile_m, halo_m = blocks(tile_size, _TILE_CELLS, "tile_size"), blocks(halo, _HALO_CELLS, "halo")
    if halo_m > tile_m:
        msg = f"the halo, {halo_m:g} m, is larger than the tile, {tile_m:g} m: use larger tiles"
        raise ValueError(msg)
    return TileGrid(tile_m, halo_m, corner_m=float(lattice.position(0)))
