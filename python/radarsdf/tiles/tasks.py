# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Runs tasks in this process, on any executor, or on a cluster, and goes on where one fails."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from radarsdf.checks import hides_bar
from radarsdf.extras import require

_POLL_S = 2.0  # how often the executor itself is checked
_NO_SCHEDULER = "the scheduler is gone: call again, what is done is kept"
_CONNECT_S = 10.0


def run_tasks(
    task: Callable[..., Any],
    arguments: Sequence[tuple[Any, ...]],
    executor: Executor | None,
    *,
    progress: bool | None = None,
) -> dict[int, str]:
    """Calls ``task(*arguments[i], run)`` for each i. Returns what went wrong, by i; the other tasks are done.

    `run` is another text in each call of this function: an executor that remembers results by arguments, such as that of
    dask.distributed, must not take an old path for a new file.
    """
    run = secrets.token_hex(8)
    failed: dict[int, str] = {}
    futures: dict[Future[Any], int] = {}
    with tqdm(total=len(arguments), desc="fit", unit="tile", disable=hides_bar(progress)) as bar:

        def note(i: int, result: Callable[[], Any]) -> None:
            try:
                result()
            except (BrokenExecutor, CancelledError):
                failed[i] = "a worker was killed: call again, what is done is kept"
            except Exception as error:  # noqa: BLE001 - of any kind: the other tiles do not depend on this one
                failed[i] = str(error) or type(error).__name__
            bar.update()

        if executor is None:
            for i, own in enumerate(arguments):
                note(i, lambda own=own: task(*own, run))  # type: ignore[misc]
            return failed
        try:
            futures = {executor.submit(task, *own, run): i for i, own in enumerate(arguments)}
            waiting = set(futures)
            while waiting:
                done, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                for future in done:
                    note(futures[future], future.result)
                # Futures of dask.distributed are never done once their client is cut off.
                if getattr(getattr(executor, "_client", None), "status", None) == "closed":
                    return failed | {futures[future]: _NO_SCHEDULER for future in waiting}
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return failed


@contextmanager
def cluster_executor(address: str, memory_bytes: int) -> Iterator[Executor]:
    """The executor of the cluster of dask.distributed at an address, such as ``tcp://host:8786``.

    Each worker runs a task for each of its threads, so it should have one. Raises a MemoryError if no worker may take
    `memory_bytes`, an OSError if there is no cluster.
    """
    distributed = require("distributed", what="a cluster needs")
    with distributed.Client(address, timeout=_CONNECT_S) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        largest = max((worker["memory_limit"] or math.inf for worker in workers), default=math.inf)
        if memory_bytes > largest:
            msg = f"a tile takes about {memory_bytes / 1e6:.0f} MB and no worker has more than {largest / 1e6:.0f}: make the plan with smaller tiles"
            raise MemoryError(msg)
        # pure: a second task with the same arguments would get the first one's result, although its file may be gone.
        executor = client.get_executor(pure=False)
        try:
            yield executor
        finally:
            if client.status == "running":
                executor.shutdown(wait=False)  # what an error or Ctrl-C left in work is cancelled
