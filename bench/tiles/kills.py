# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Fits in tiles on a local cluster of dask.distributed, while a worker or the scheduler is killed: what is lost?"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import distributed
import numpy as np
from radarsdf import FitConfig, TiledMap
from radarsdf.io import Scan
from radarsdf.map import storage
from radarsdf.tiles.cluster import cluster_executor
from radarsdf.tiles.fit_tiles import plan_tiles, run_fits
from radarsdf.tiles.plan import Plan, map_path
from radarsdf.tiles.tile_fit import is_done

from bench.growth.street import street_scans

_CONFIG = FitConfig.quick(num_threads=1)
_TILE_M = 51.2


def rows(names: list[str], quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each thing that goes wrong."""
    count = 200_000 if quick else 2_000_000
    scans = [Scan(points, pose) for pose, points, *_ in street_scans(count)]
    with tempfile.TemporaryDirectory() as folder:
        plan = plan_tiles(scans, Path(folder) / "alone", tile_size=_TILE_M, config=_CONFIG)
        run_fits(Path(folder) / "alone", progress=False)
        expected = _bits(Path(folder) / "alone")
        for name in names or ("nothing", "a worker", "the scheduler"):
            out = Path(folder) / name.replace(" ", "-")
            plan_tiles(scans, out, tile_size=_TILE_M, config=_CONFIG)
            started_s = time.perf_counter()
            kept = 0
            with _cluster() as cluster:
                if name == "the scheduler":
                    kept = _until_the_scheduler_dies(cluster, out, plan)
                else:
                    thread = threading.Thread(target=_kill_a_worker, args=(cluster, out, plan))
                    if name == "a worker":
                        thread.start()
                    _fit(cluster, out)
            redone = 0
            if name == "the scheduler":
                times = {
                    tile.name: map_path(out, tile).stat().st_mtime_ns
                    for tile in plan.tiles
                    if _there(out, tile)
                }
                with _cluster() as cluster:
                    _fit(cluster, out)
                redone = sum(
                    map_path(out, tile).stat().st_mtime_ns != times.get(tile.name, -1)
                    for tile in plan.tiles
                    if tile.name in times
                )
            yield {
                "killed": name,
                "tiles": len(plan.tiles),
                "done before": kept,
                "of these made again": redone,
                "missing in the end": len(TiledMap(out).missing),
                "same bits as in one process": _bits(out) == expected,
                "s": round(time.perf_counter() - started_s, 1),
            }


def _cluster() -> Any:
    local: Any = distributed.LocalCluster  # without types
    return local(n_workers=2, threads_per_worker=1, dashboard_address=None)


def _there(out: Path, tile: Any) -> bool:
    return map_path(out, tile).is_file()


def _fit(cluster: Any, out: Path) -> None:
    with cluster_executor(cluster.scheduler_address, 0) as executor:
        run_fits(out, executor=executor, progress=False)


def _wait(done: Callable[[], bool]) -> None:
    while not done():
        time.sleep(0.02)


def _done(out: Path, plan: Plan) -> int:
    return sum(is_done(out, plan, tile) for tile in plan.tiles)


def _kill_a_worker(cluster: Any, out: Path, plan: Plan) -> None:
    _wait(lambda: _done(out, plan) >= 2)
    os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)


def _until_the_scheduler_dies(cluster: Any, out: Path, plan: Plan) -> int:
    """Closes the cluster under a client in the middle of the work. Gives the number of tiles that were done then."""
    thread = threading.Thread(target=lambda: _quietly(lambda: _fit(cluster, out)), daemon=True)
    thread.start()
    _wait(lambda: _done(out, plan) >= len(plan.tiles) // 3)
    for nanny in cluster.workers.values():
        os.kill(nanny.pid, signal.SIGKILL)
    cluster.close()
    thread.join(60)
    return _done(out, plan)


def _quietly(call: Callable[[], None]) -> None:
    try:
        call()
    except Exception as error:  # noqa: BLE001 - whatever the client says of a scheduler that is gone
        print(f"the client: {type(error).__name__}: {error!s:.100}")


def _bits(folder: Path) -> dict[str, bytes]:
    plan = Plan.load(folder)
    found: dict[str, bytes] = {}
    for tile in plan.tiles:
        tensors, _ = storage.parts_of(storage.load_contents(map_path(folder, tile)))
        found |= {f"{tile.name}.{name}": np.asarray(tensor).tobytes() for name, tensor in tensors.items()}
    return found
