# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Maps of any size: scans to tiles, a fit for each, and one map."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from radarsdf.checks import are_rigid, flag, instance, one_for_each_scan, path_of, positive
from radarsdf.config.fit_config import FitConfig, settings_of_results
from radarsdf.fitting.steps import FitInput, fit_rays
from radarsdf.io.files import take_lock, write_whole
from radarsdf.io.poses import UNPOSED, NoPoses
from radarsdf.io.read import read
from radarsdf.io.scans import Scan, Scans
from radarsdf.returns.noise import NOISE_SETTINGS
from radarsdf.returns.rays import LeftOut
from radarsdf.tiles.drive_poses import POSES, TRAJECTORY, DrivePoses, DriveToPose
from radarsdf.tiles.plan import PLAN, TILES, Plan, TileGrid, TilePlan, failure_path, is_done, map_path
from radarsdf.tiles.planning import SCANS_FILE, InputDigest, make_plan, read_rays
from radarsdf.tiles.tasks import run_tasks
from radarsdf.tiles.tiled_map import TiledMap

_LOG = logging.getLogger("radarsdf.tiles")
_TILE_CELLS = 512  # edge of a tile, leaf cells
_HALO_CELLS = 64  # half of it counts; see docs/tiles.md
_LOCK = "plan.lock"
_OURS = {PLAN, _LOCK, POSES, TRAJECTORY, TILES, SCANS_FILE}


def fit_tiles(
    scans: str | PathLike[str] | Scans | Iterable[Scan],
    out: str | PathLike[str],
    *,
    tile_size: float | None = None,
    halo: float | None = None,
    executor: Executor | None = None,
    config: FitConfig | None = None,
    refine: bool = False,
    find: bool = False,
    progress: bool | None = None,
) -> TiledMap:
    """Fits a map in tiles. Neither all returns nor all of the map are ever in memory.

    If `out` holds a plan of the same scans and settings, tiles that are done are kept: call it again after anything went
    wrong. The result has the same bits with any executor, if ``config.num_threads`` is given.

    Parameters
    ----------
    scans : path-like, Scans, or iterable of Scan
        A path is read by :func:`radarsdf.io.read`. Scans may come one after another; they are read once, unless poses are
        refined or found.
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
    refine : bool
        Whether poses are refined before the plan is made, as by :func:`radarsdf.refine_poses`, in windows of some hundred
        scans. The poses used are kept in the folder, ``poses.tum``, and their deviations become ``pose_sigma_m`` and
        ``pose_sigma_rad`` of the maps, unless `config` states some.
    find : bool
        Whether poses are found from the radar alone, as by :func:`radarsdf.odometry`, and those of the scans are not used.
        This is done for scans in a path without poses, too. Of a drive in several segments, the longest is used.
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
    plan_tiles(
        scans,
        out,
        tile_size=tile_size,
        halo=halo,
        config=config,
        threads=None if executor is None else 1,
        refine=refine,
        find=find,
        progress=progress,
    )
    return run_fits(out, executor=executor, progress=progress)


def plan_tiles(
    scans: str | PathLike[str] | Scans | Iterable[Scan],
    out: str | PathLike[str],
    *,
    tile_size: float | None = None,
    halo: float | None = None,
    config: FitConfig | None = None,
    threads: int | None = None,
    refine: bool = False,
    find: bool = False,
    progress: bool | None = None,
) -> Plan:
    """The first step of :func:`fit_tiles`: writes the plan and the rays of each tile, in one pass over the scans.

    `threads`: of each fit, if the configuration does not say. Default: as many as PyTorch uses.
    """
    folder = path_of(out, "out")
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    grid = _grid(config, tile_size, halo)
    drive, given = _given(scans, refine=refine, find=find)
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
                if drive is None:
                    for name in (POSES, TRAJECTORY):
                        (folder / name).unlink(missing_ok=True)
                else:
                    poses = DrivePoses.of(drive, config, folder, progress)
                    given, config = poses.scans(given), poses.posed.config(config)
                plan = make_plan(given, folder, config, grid)
                plan.save(folder)
                return plan
        finally:
            os.close(lock)
    return _known_plan(folder, config, grid, drive, given)


def _known_plan(
    folder: Path, config: FitConfig, grid: TileGrid, drive: DriveToPose | None, given: Iterable[Scan]
) -> Plan:
    """The plan in a folder. Raises a ValueError if it is of other scans or settings."""
    plan, poses = Plan.load(folder), DrivePoses.load(folder)
    if (poses is None) != (drive is None):
        made = "as given" if poses is None else "that were refined or found"
        msg = f"{folder} holds another plan, of poses {made}: give a new folder"
        raise ValueError(msg)
    if poses is None or drive is None:
        digest = InputDigest.of(given)
    else:
        config, digest = poses.posed.config(config), poses.digest(drive, config)
    if config.num_threads not in (0, plan.config.num_threads):
        msg = f"{folder} was planned for {plan.config.num_threads} threads a tile, not {config.num_threads}"
        raise ValueError(msg)
    found = {
        name: getattr(plan.config.returns, name)
        for name in NOISE_SETTINGS
        if getattr(config.returns, name) is None
    }
    ours, theirs = (settings_of_results(own) for own in (config.override(returns=found), plan.config))
    different = [name for name in ours if ours[name] != theirs[name]]
    different += ["tile_size"] * (grid.tile_m != plan.tile_m) + ["halo"] * (grid.halo_m != plan.halo_m)
    different += ["scans"] * (digest != plan.input_digest)
    if different:
        msg = f"{folder} holds another plan: {', '.join(different)} differ; give a new folder"
        raise ValueError(msg)
    return plan


def _given(
    scans: str | PathLike[str] | Scans | Iterable[Scan], *, refine: bool, find: bool
) -> tuple[DriveToPose | None, Iterable[Scan]]:
    """The scans, checked one after another as they are read, and how their poses are made. None: they are as given."""
    refine, find = flag(refine, "refine"), flag(find, "find")
    if isinstance(scans, (str, PathLike)):
        path = scans
        try:
            scans = read(path, UNPOSED if find else None)
        except NoPoses:
            scans, find = read(path, UNPOSED), True
    checked = _Checked(scans, with_poses=not find)
    if not (refine or find):
        return None, checked
    if iter(scans) is scans:
        msg = "poses can be refined or found of scans that can be read again: give a path, Scans or a list"
        raise ValueError(msg)
    return DriveToPose(checked, scans.imu if isinstance(scans, Scans) else None, find), checked


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
    failed = run_tasks(
        fit_tile, [(str(root), tile.name) for tile in todo], executor, description="fit", progress=progress
    )
    for i, reason in failed.items():
        # What a task could not write itself: its worker or the scheduler was killed. A disk that is full has said so.
        if not failure_path(root, todo[i]).is_file() and not is_done(root, plan, todo[i]):
            with suppress(OSError):
                write_whole(failure_path(root, todo[i]), reason.encode())
    if failed and len(failed) == len(plan.tiles):
        msg = f"all {len(failed)} tiles failed, the first: {failed[0]}"
        raise ValueError(msg)
    return TiledMap(root)


def fit_tile(folder: str, name: str, run: str = "") -> str:
    """Fits the tile of this name, unless its map is there already, and returns the path of the map.

    A task takes names and returns a name, so that it can run anywhere. `run` is anything: schedulers that keep results by
    arguments run the task again if it differs. Raises what :func:`radarsdf.fit` raises; the reason is also in
    ``failed.txt`` in the tile's folder.
    """
    del run
    root = Path(folder)
    plan = Plan.load(root)
    (tile,) = (planned for planned in plan.tiles if planned.name == name)
    path, failure = map_path(root, tile), failure_path(root, tile)
    if not is_done(root, plan, tile):
        try:
            _fit(root, plan, tile)
        except Exception as error:
            write_whole(failure, (str(error) or type(error).__name__).encode())
            raise
    failure.unlink(missing_ok=True)
    return str(path)


def _fit(root: Path, plan: Plan, tile: TilePlan) -> None:
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

    def blocks(value: float | None, default: float, name: str) -> float:
        wanted = default if value is None else positive(value, name)
        return lattice.block_m * max(1, round(wanted / lattice.block_m))

    grid = TileGrid(
        tile_m=blocks(tile_size, _TILE_CELLS * lattice.cell_m, "tile_size"),
        halo_m=blocks(halo, _HALO_CELLS * lattice.cell_m, "halo"),
        corner_m=float(lattice.position(0)),
    )
    if grid.halo_m > grid.tile_m:
        msg = f"the halo, {grid.halo_m:g} m, is larger than the tile, {grid.tile_m:g} m: use larger tiles"
        raise ValueError(msg)
    return grid


class _Checked:
    """Scans, checked one after another each time that they are read.

    `with_poses`: those whose pose is not a rigid transform are left out.
    """

    def __init__(self, scans: Iterable[Any], *, with_poses: bool) -> None:
        self._scans, self._with_poses = scans, with_poses

    def __iter__(self) -> Iterator[Scan]:
        rigid = []
        for i, scan in enumerate(one_for_each_scan(self._scans, "scans")):
            if not isinstance(scan, Scan):
                msg = f"scan {i} is {type(scan).__name__}, not radarsdf.io.Scan"
                raise TypeError(msg)
            if np.shape(scan.T_world_sensor) != (4, 4):
                msg = f"scan {i} has no pose: T_world_sensor must be (4, 4), not {np.shape(scan.T_world_sensor)}"
                raise ValueError(msg)
            rigid.append(not self._with_poses or bool(are_rigid(np.asarray(scan.T_world_sensor)[None])[0]))
            if rigid[-1]:
                yield scan
        bad = np.flatnonzero(~np.array(rigid, bool)).tolist()
        if bad and 2 * len(bad) >= len(rigid):
            msg = f"{len(bad)} of {len(rigid)} poses are not rigid transforms, the first is pose {bad[0]}"
            raise ValueError(msg)
        for note in LeftOut(poses=bad).notes:
            _LOG.warning(note)
