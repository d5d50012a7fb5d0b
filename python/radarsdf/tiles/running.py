# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Runs tasks in this process or on any executor, and goes on where one fails."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, wait
from typing import Any

from tqdm import tqdm

from radarsdf.progress import hides_bar

Task = Callable[..., Any]
_LOOK_S = 2.0  # how often the executor itself is looked at
_NO_SCHEDULER = "the scheduler is gone: call again, what is done is kept"


def run_tasks(
    task: Task,
    arguments: Sequence[tuple[Any, ...]],
    executor: Executor | None,
    *,
    description: str,
    progress: bool | None = None,
) -> dict[int, str]:
    """Calls ``task(*arguments[i], run)`` for each i.

    `run` is another text in each call of this function: an executor that remembers results by arguments, such as that of
    dask.distributed, must not take an old path for a new file.

    Parameters
    ----------
    task : callable
        Of a module, so that other processes can import it.
    arguments : sequence of tuples
        Small, since they are sent.
    executor : concurrent.futures.Executor or None
        None: one after another in this process.
    description : str
        For the progress bar.
    progress : bool or None
        Whether to show one. None: only on a terminal.

    Returns
    -------
    dict
        What went wrong, by i. The other tasks are done.
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
                done, waiting = wait(waiting, _LOOK_S, FIRST_COMPLETED)
                for future in done:
                    try:
                        future.result()
                    except (Exception, CancelledError) as error:  # noqa: BLE001 - likewise
                        failed[futures[future]] = _reason(error)
                    bar.update()
                if _has_no_scheduler(executor):
                    return failed | {futures[future]: _NO_SCHEDULER for future in waiting}
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return failed


def _has_no_scheduler(executor: Executor) -> bool:
    """Whether this is an executor of dask.distributed that is cut off. Its futures are then never done."""
    return getattr(getattr(executor, "_client", None), "status", None) == "closed"


def _reason(error: BaseException) -> str:
    if isinstance(error, (BrokenExecutor, CancelledError)):
        return "a worker was killed: call again, what is done is kept"
    return str(error) or type(error).__name__
