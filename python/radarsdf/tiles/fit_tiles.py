"""Fits of maps of any size: scans to tiles, a fit per tile, and one map."""

import hashlib
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager, suppress
from pathlib import Path

import torch
from tqdm import tqdm

from radarsdf.checks import AnyPath, check, hides_bar, instance, path_of, positive
from radarsdf.config.fit_config import FitConfig, settings_of_results
from radarsdf.extras import require
from radarsdf.fitting.fit import FitInput, fit_rays
from radarsdf.io.files import take_lock, write_whole
from radarsdf.io.read import read
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.noise import NOISE_SETTINGS
from radarsdf.scans import Scan, Scans
from radarsdf.tiles.plan import PLAN, TILES, Plan, TileGrid, failure_path, is_done, map_path
from radarsdf.tiles.planning import SCANS_FILE, Planner, checked_scans, read_rays
from radarsdf.tiles.tiled_map import TiledMap

_TILE_CELLS = 512  # edge of a tile, leaf cells
_HALO_CELLS = 64  # half of it has a weight; see docs/tiles.md
_LOCK = "plan.lock"
_POLL_S = 2.0  # interval of checks of the executor itself
_NO_SCHEDULER = "the scheduler is gone: call again, finished tiles are kept"
_CONNECT_S = 10.0
_OURS = {PLAN, _LOCK, TILES, SCANS_FILE}


def fit_tiles(
    scans: AnyPath | Scans | Iterable[Scan],
    out: AnyPath,
    *,
    tile_size: float | None = None,
    halo: float | None = None,
    executor: Executor | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
) -> TiledMap:
    """Fit a map in tiles, with neither all returns nor the whole map in memory at any time.

    If `out` holds a plan of the same scans and settings, finished tiles are kept: call it again after any
    failure. With ``config.num_threads``, the result has the same bits with any executor.

    Parameters
    ----------
    scans : path-like, Scans, or iterable of Scan
        A path is read by :func:`radarsdf.io.read`. Scans may be a generator; they are read once.
    out : path-like
        Folder to create.
    tile_size : float, optional
        Edge of a tile, m, rounded to blocks of ``config.lattice``. Default: 512 leaf cells.
    halo : float, optional
        Width of the margin of returns that a tile fits, too, m, rounded to blocks; half of it overlaps. Default: 64 leaf cells.
    executor : concurrent.futures.Executor, optional
        Executor of the fits: of processes, or of a cluster (``Client.get_executor(pure=False)`` of dask.distributed).
        By default, tiles are fitted one after another in this process.
    config : FitConfig, optional
        Settings of the fits. With an executor, each has one thread unless ``num_threads`` is set.
    progress : bool, optional
        Whether to show progress bars. Default: only on a terminal.

    Returns
    -------
    TiledMap
        Its ``missing`` names the failed tiles and the reasons.

    Raises
    ------
    ValueError, OSError
        If a scan is invalid, `out` holds other files or another plan, cannot be written, or all tiles failed.
    """
    of_fit = None if executor is None else 1
    plan_tiles(scans, out, tile_size=tile_size, halo=halo, config=config, threads=of_fit)
    return run_fits(out, executor=executor, progress=progress)


def plan_tiles(
    scans: AnyPath | Scans | Iterable[Scan],
    out: AnyPath,
    *,
    tile_size: float | None = None,
    halo: float | None = None,
    config: FitConfig | None = None,
    threads: int | None = None,
) -> Plan:
    """Write the plan and the rays of each tile in one pass over the scans. `threads`: of a fit, unless `config` sets them."""
    folder = path_of(out, "out")
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    block_m = config.lattice.block_m
    tile_m = _TILE_CELLS * config.leaf_size_m if tile_size is None else positive(tile_size, "tile_size")
    halo_m = _HALO_CELLS * config.leaf_size_m if halo is None else positive(halo, "halo")
    tile_m, halo_m = (block_m * max(1, round(wanted_m / block_m)) for wanted_m in (tile_m, halo_m))
    fits = halo_m <= tile_m
    check(fits, f"the halo, {halo_m:g} m, is larger than the tile, {tile_m:g} m: use larger tiles")
    grid = TileGrid(tile_m, halo_m, corner_m=float(config.lattice.position(0)))
    digest = hashlib.blake2b(digest_size=16)
    given = checked_scans(read(scans) if isinstance(scans, (str, os.PathLike)) else scans, digest)
    if not (folder / PLAN).is_file():
        folder.mkdir(exist_ok=True)
        others = {path.name for path in folder.iterdir()} - _OURS
        check(not others, f"{folder} holds other files: give a new folder")
        with os.fdopen(take_lock(folder / _LOCK, "planned")):
            if not (folder / PLAN).is_file():  # another process may have just written it
                shutil.rmtree(folder / TILES, ignore_errors=True)  # left by an unfinished plan
                config = config.override(num_threads=config.num_threads or threads or torch.get_num_threads())
                plan = Planner(folder, config, grid).plan(given, digest)
                plan.save(folder)
                return plan
    plan = Plan.load(folder)  # must be of the same scans and settings
    unknown = [name for name in NOISE_SETTINGS if getattr(config.returns, name) is None]
    found = {name: getattr(plan.config.returns, name) for name in unknown}
    ours, theirs = (settings_of_results(own) for own in (config.override(returns=found), plan.config))
    different = [name for name in ours if ours[name] != theirs[name]]
    different += ["num_threads"] * (config.num_threads not in (0, plan.config.num_threads))
    different += ["tile_size"] * (grid.tile_m != plan.tile_m) + ["halo"] * (grid.halo_m != plan.halo_m)
    if not different:
        for _ in given:
            pass
        different += ["scans"] * (digest.hexdigest() != plan.input_digest)
    check(not different, f"{folder} holds another plan: {', '.join(different)} differ; give a new folder")
    return plan


def run_fits(
    folder: AnyPath,
    *,
    executor: Executor | None = None,
    names: Iterable[str] | None = None,
    progress: bool | None = None,
) -> TiledMap:
    """Second step: fit the unfinished tiles of a plan, all or those of these `names`."""
    root = path_of(folder, "folder")
    plan = Plan.load(root)
    wanted = {tile.name for tile in plan.tiles} if names is None else set(names)
    unknown = sorted(wanted - {tile.name for tile in plan.tiles})
    check(not unknown, f"{folder} has no tiles {', '.join(unknown)}")
    todo = [tile for tile in plan.tiles if tile.name in wanted and not is_done(root, plan, tile)]
    failed = run_tasks(str(root), [tile.name for tile in todo], executor, progress)
    for tile in todo:
        with suppress(OSError):  # a full disk has been reported
            if tile.name in failed and not is_done(root, plan, tile):
                write_whole(failure_path(root, tile), failed[tile.name].encode())
            else:
                failure_path(root, tile).unlink(missing_ok=True)
    first = failed.get(plan.tiles[0].name)
    check(len(failed) < len(plan.tiles), f"all {len(failed)} tiles failed, the first: {first}")
    return TiledMap(root)


def fit_tile(folder: str, name: str) -> None:
    """Fit a tile unless its map exists. Tasks take names, so that they can run anywhere."""
    root = Path(folder)
    plan = Plan.load(root)
    (tile,) = (planned for planned in plan.tiles if planned.name == name)
    if is_done(root, plan, tile):
        return

    def read() -> FitInput:
        rays, inside = read_rays(root, plan, tile)
        limits, radars = plan.intensity_range, plan.radars_of(rays)
        scale = None if limits is None else IntensityScale.between(limits)
        names = ("clutter_ratio", "returns_per_cell", "sensor", "sensors")
        whole = {name: getattr(plan, name) for name in names}
        box_cells = plan.box_cells(tile)
        return FitInput(rays, scale, inside=inside, whole=whole, box_cells=box_cells, radars=radars)

    radar_map = fit_rays(read, plan.config, progress=False)
    radar_map.report["plan"] = plan.digest_of(tile)
    radar_map.save(map_path(root, tile))


def run_tasks(
    folder: str, names: Sequence[str], executor: Executor | None, progress: bool | None
) -> dict[str, str]:
    """Fit tiles by name, here or on an executor. Returns errors by name; the other tiles are fitted."""
    failed: dict[str, str] = {}
    futures: dict[Future[None], str] = {}
    with tqdm(total=len(names), desc="fit", unit="tile", disable=hides_bar(progress)) as bar:

        def note(name: str, result: Callable[..., None], *arguments: str) -> None:
            try:
                result(*arguments)
            except (BrokenExecutor, CancelledError):
                failed[name] = "a worker was killed: call again, finished tiles are kept"
            except Exception as error:  # noqa: BLE001 - of any kind: the other tiles do not depend on this one
                failed[name] = str(error) or type(error).__name__
            bar.update()

        if executor is None:
            for name in names:
                note(name, fit_tile, folder, name)
            return failed
        try:
            futures = {executor.submit(fit_tile, folder, name): name for name in names}
            waiting = set(futures)
            while waiting:
                done, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                for future in done:
                    note(futures[future], future.result)
                # Futures of dask.distributed never finish once their client is cut off.
                if getattr(getattr(executor, "_client", None), "status", None) == "closed":
                    return failed | {futures[future]: _NO_SCHEDULER for future in waiting}
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return failed


@contextmanager
def cluster_executor(address: str, memory_bytes: int) -> Iterator[Executor]:
    """Connect to the dask.distributed cluster at an address, such as ``tcp://host:8786``, and yield its executor.

    A worker runs one task per thread, so it should have one. Raises a MemoryError if no worker may use
    `memory_bytes`, an OSError if there is no cluster.
    """
    distributed = require("distributed", what="a cluster needs")
    with distributed.Client(address, timeout=_CONNECT_S) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        largest = max((worker["memory_limit"] or math.inf for worker in workers), default=math.inf)
        most = f"no worker has more than {largest / 1e6:.0f}: make the plan with smaller tiles"
        takes = f"a tile takes about {memory_bytes / 1e6:.0f} MB"
        check(memory_bytes <= largest, f"{takes} and {most}", MemoryError)
        # With pure=True, a second task with the same arguments would get the first result, although its file may be gone.
        executor = client.get_executor(pure=False)
        try:
            yield executor
        finally:
            if client.status == "running":
                executor.shutdown(wait=False)  # cancels the tasks left by an error or Ctrl-C
