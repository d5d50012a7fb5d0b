# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Runs tasks in this process, on any executor, or on a cluster, and goes on where one fails."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, wait
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from radarsdf.extras import require
from radarsdf.progress import hides_bar

Task = Callable[..., Any]
_POLL_S = 2.0  # how often the executor itself is checked
_NO_SCHEDULER = "the scheduler is gone: call again, what is done is kept"
_CONNECT_S = 10.0
_RESOURCE = "MB"  # what workers may state that they have: dask worker --resources "MB=8000"


def run_tasks(
    task: Task,
    arguments: Sequence[tuple[Any, ...]],
    executor: Executor | None,
    *,
    description: str,
    progress: bool | None = None,
) -> dict[int, str]:
    """Calls ``task(*arguments[i], run)`` for each i, one after another in this process if there is no executor.

    `run` is another text in each call of this function: an executor that remembers results by arguments, such as that of
    dask.distributed, must not take an old path for a new file. Returns what went wrong, by i; the other tasks are done.
    """
    run = secrets.token_hex(8)
    failed: dict[int, str] = {}
    with tqdm(total=len(arguments), desc=description, unit="tile", disable=hides_bar(progress)) as bar:
        if executor is None:
            for i, own in enumerate(arguments):
                try:
                    task(*own, run)
                except Exception as error:  # noqa: BLE001 - of any kind: the other tiles do not depend on this one
                    failed[i] = _reason(error)
                bar.update()
            return failed
        futures = {}
        try:
            futures = {executor.submit(task, *own, run): i for i, own in enumerate(arguments)}
            waiting = set(futures)
            while waiting:
                done, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                for future in done:
                    try:
                        future.result()
                    except (Exception, CancelledError) as error:  # noqa: BLE001 - as above
                        failed[futures[future]] = _reason(error)
                    bar.update()
                # Futures of dask.distributed are never done once their client is cut off.
                if getattr(getattr(executor, "_client", None), "status", None) == "closed":
                    return failed | {futures[future]: _NO_SCHEDULER for future in waiting}
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return failed


def _reason(error: BaseException) -> str:
    if isinstance(error, (BrokenExecutor, CancelledError)):
        return "a worker was killed: call again, what is done is kept"
    return str(error) or type(error).__name__


@contextmanager
def cluster_executor(address: str, memory_bytes: int) -> Iterator[Executor]:
    """The executor of the cluster of dask.distributed at an address, such as ``tcp://host:8786``.

    If its workers state how many ``MB`` they have, each runs as many tasks of `memory_bytes` as fit. Otherwise they run a
    task for each thread, so a worker should have one.

    Raises
    ------
    ImportError
        If dask.distributed is not installed.
    OSError
        If there is no cluster.
    MemoryError
        If no worker has so much memory.
    """
    distributed = require("distributed", what="a cluster needs")
    with distributed.Client(address, timeout=_CONNECT_S) as client:
        workers = list(client.scheduler_info(n_workers=-1)["workers"].values())
        stated = [worker["resources"].get(_RESOURCE, 0) for worker in workers]
        largest = max((worker["memory_limit"] or math.inf for worker in workers), default=math.inf)
        needed = math.ceil(memory_bytes / 1e6)
        if any(stated):
            largest = 1e6 * max(stated)
        if memory_bytes > largest:
            msg = f"a tile takes about {needed} MB and no worker has more than {largest / 1e6:.0f}: make the plan with smaller tiles"
            raise MemoryError(msg)
        resources = {"resources": {_RESOURCE: needed}} if any(stated) else {}
        # pure: a second task with the same arguments would get the first one's result, although its file may be gone.
        executor = client.get_executor(pure=False, **resources)
        try:
            yield executor
        finally:
            if client.status == "running":
                executor.shutdown(wait=False)  # what an error or Ctrl-C left in work is cancelled
