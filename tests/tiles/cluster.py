"""A cluster of dask.distributed with scheduler and workers in separate processes, as on many machines."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from radarsdf.map.radar_map import load_contents, parts_of
from radarsdf.tiles.plan import Plan, map_path

_WORKERS = 1
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
        """Starts a new session, so that a worker can be killed together with the nanny that would restart it."""
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
    """Kills a process and its children without notice."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


@contextmanager
def cluster_in(folder: Path) -> Iterator[Cluster]:
    """A cluster that is closed at the end of the block."""
    folder.mkdir()
    cluster = Cluster(folder)
    try:
        yield cluster
    finally:
        cluster.close()


def _wait(done: Callable[[], bool]) -> None:
    until_s = time.monotonic() + _START_S
    while not done():
        if time.monotonic() > until_s:
            msg = f"not there after {_START_S:.0f} s"
            raise TimeoutError(msg)
        time.sleep(0.02)


def bits_of(folder: Path) -> dict[str, bytes]:
    """All numbers of all maps."""
    found: dict[str, bytes] = {}
    for tile in Plan.load(folder).tiles:
        tensors, _ = parts_of(load_contents(map_path(folder, tile)))
        found |= {f"{tile.name}.{name}": np.asarray(tensor).tobytes() for name, tensor in tensors.items()}
    return found
