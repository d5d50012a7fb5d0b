# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Fits in tiles on a cluster of dask.distributed, while a worker or the scheduler is killed: what is lost?

The scheduler and its two workers are processes of their own, as on many machines.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from radarsdf import FitConfig, TiledMap
from radarsdf.io import Scan
from radarsdf.map import storage
from radarsdf.tiles.fit_tiles import plan_tiles, run_fits
from radarsdf.tiles.plan import Plan, is_done, map_path
from radarsdf.tiles.tasks import cluster_executor

from bench.growth.street import street_scans

_CONFIG = FitConfig.quick(num_threads=1)
_TILE_M = 51.2
_WORKERS = 2
_START_S = 300.0


class Cluster:
    """A scheduler and its workers."""

    def __init__(self, folder: Path) -> None:
        known = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", known)
        _wait(lambda: known.is_file() and bool(known.read_text().strip()))
        self.address = json.loads(known.read_text())["address"]
        limits = ("--nthreads", "1", "--no-dashboard", "--local-directory", folder)
        self.workers = [self._start("worker", self.address, *limits) for _ in range(_WORKERS)]

    @staticmethod
    def _start(*words: Any) -> subprocess.Popen[bytes]:
        """In a session of its own, so that a worker can be killed together with the nanny that would start it again."""
        command = [sys.executable, "-m", "distributed.cli.dask_" + words[0], *map(str, words[1:])]
        return subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )

    def close(self) -> None:
        """Ends all processes."""
        for process in (*self.workers, self.scheduler):
            kill(process)
            process.wait()


def kill(process: subprocess.Popen[bytes]) -> None:
    """Kills a process and its children without a word to them."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


@contextmanager
def cluster_in(folder: Path) -> Iterator[Cluster]:
    """A cluster that ends with the block."""
    folder.mkdir()
    cluster = Cluster(folder)
    try:
        yield cluster
    finally:
        cluster.close()


def rows(names: list[str], quick: bool, out: Path) -> Iterator[dict[str, Any]]:
    """A row for each thing that goes wrong."""
    del out
    count = 200_000 if quick else 2_000_000
    scans = [Scan(points, pose) for pose, points, *_ in street_scans(count)]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        plan = plan_tiles(scans, folder / "alone", tile_size=_TILE_M, config=_CONFIG)
        run_fits(folder / "alone", progress=False)
        expected = bits_of(folder / "alone")
        for name in names or ("nothing", "a worker", "the scheduler"):
            city = folder / name.replace(" ", "-")
            plan_tiles(scans, city, tile_size=_TILE_M, config=_CONFIG)
            started_s = time.perf_counter()
            with cluster_in(folder / f"{city.name}-first") as cluster:
                missing, said, done = _fit_and_kill(cluster, city, plan, name)
            times = _times(city, plan)
            if missing:
                with cluster_in(folder / f"{city.name}-second") as cluster:
                    _fit(cluster, city)
            yield {
                "killed": name,
                "tiles": len(plan.tiles),
                "done then": done,
                "missing after that call": missing,
                "said": said,
                "made again by the next": sum(_times(city, plan)[tile] != at for tile, at in times.items()),
                "missing in the end": len(TiledMap(city).missing),
                "same bits as in one process": bits_of(city) == expected,
                "s": round(time.perf_counter() - started_s, 1),
            }


def _fit_and_kill(cluster: Cluster, out: Path, plan: Plan, name: str) -> tuple[int, str, int]:
    """Fits, and kills in the middle. Gives the number of missing tiles, a reason, and the tiles done at the kill."""
    done = 0

    def in_the_middle() -> None:
        nonlocal done
        _wait(lambda: _done(out, plan) >= len(plan.tiles) // 3)
        done = _done(out, plan)
        kill(cluster.scheduler if name == "the scheduler" else cluster.workers[0])

    thread = threading.Thread(target=in_the_middle, daemon=True)
    if name != "nothing":
        thread.start()
    said = "–"
    try:
        missing = _fit(cluster, out).missing
        said = max((reason for reason in missing.values() if reason), default=said)
    except Exception as error:  # noqa: BLE001 - what a client says of a scheduler that is gone is what this measures
        said = f"{type(error).__name__}: {error!s:.100}"
    return len(plan.tiles) - _done(out, plan), said, done


def _fit(cluster: Cluster, out: Path) -> TiledMap:
    with cluster_executor(cluster.address, 0) as executor:
        return run_fits(out, executor=executor, progress=False)


def _wait(done: Callable[[], bool]) -> None:
    until_s = time.monotonic() + _START_S
    while not done():
        if time.monotonic() > until_s:
            msg = f"not there after {_START_S:.0f} s"
            raise TimeoutError(msg)
        time.sleep(0.02)


def _done(out: Path, plan: Plan) -> int:
    return sum(is_done(out, plan, tile) for tile in plan.tiles)


def _times(out: Path, plan: Plan) -> dict[str, int]:
    """When the maps that are there were written, ns."""
    return {
        tile.name: map_path(out, tile).stat().st_mtime_ns for tile in plan.tiles if is_done(out, plan, tile)
    }


def bits_of(folder: Path) -> dict[str, bytes]:
    """All numbers of all maps."""
    found: dict[str, bytes] = {}
    for tile in Plan.load(folder).tiles:
        tensors, _ = storage.parts_of(storage.load_contents(map_path(folder, tile)))
        found |= {f"{tile.name}.{name}": np.asarray(tensor).tobytes() for name, tensor in tensors.items()}
    return found
