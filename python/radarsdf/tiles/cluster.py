# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A cluster of dask.distributed as an executor, which gives a task the memory that it takes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from radarsdf.extras import require

_CONNECT_S = 10.0
_RESOURCE = "MB"  # what workers may say that they have: dask worker --resources "MB=8000"


@contextmanager
def cluster_executor(address: str, memory_bytes: int) -> Iterator[Executor]:
    """The executor of the cluster at an address, such as ``tcp://host:8786``.

    If its workers say how many ``MB`` they have, each runs as many tasks of `memory_bytes` as fit. Otherwise they run a
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
        said = [worker["resources"].get(_RESOURCE, 0) for worker in workers]
        largest = max((worker["memory_limit"] or math.inf for worker in workers), default=math.inf)
        needed = math.ceil(memory_bytes / 1e6)
        if max(said, default=0) > 0:
            largest = 1e6 * max(said)
        if memory_bytes > largest:
            msg = (
                f"a tile takes about {needed} MB and no worker has more than {largest / 1e6:.0f}: "
                "make the plan with smaller tiles"
            )
            raise MemoryError(msg)
        resources = {"resources": {_RESOURCE: needed}} if any(said) else {}
        # pure: a second task with the same arguments would get the first one's result, although its file may be gone.
        executor = client.get_executor(pure=False, **resources)
        try:
            yield executor
        finally:
            if client.status == "running":
                executor.shutdown(wait=False)  # what an error or Ctrl-C left in work is cancelled
