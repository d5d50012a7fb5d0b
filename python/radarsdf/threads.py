# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Threads that each run whole pieces of work, with PyTorch's own threads off.

PyTorch splits every single operation over OpenMP's threads, which spin while they wait for each other. Beside another
busy process, a fit of 1.8 s took 88 s, since a thread that should work waited for the time slice of one that spun.
Pieces of work on Python's threads, which sleep when they wait, meet once an iteration instead of a hundred times, and
share the processor fairly; on an idle machine they are no slower. The interpreter's lock costs little: PyTorch and the
compiled core release it.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

import torch

if TYPE_CHECKING:
    from typing_extensions import Self

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_lock = threading.Lock()
_users = 0
_threads_before = 0
_blocks = threading.local()  # .depth: blocks that this thread is in


def _use_one_thread() -> None:
    torch.get_num_threads()  # a thread's first call of anything else would undo the next line
    torch.set_num_threads(1)


def _begin_anew() -> None:
    """In a forked child there is only the thread that forked, and OpenMP waits for its others for ever.

    A lock that another thread held would never be released. The compiled core sees to its own number of threads.
    """
    global _lock, _users, _blocks  # noqa: PLW0603 - the child begins anew
    _lock = threading.Lock()
    _users, _blocks = 0, threading.local()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


def resolve_num_threads(num_threads: int) -> int:
    """`num_threads`, or where it is 0 as many as PyTorch would use."""
    with _lock:
        return num_threads or (_threads_before if _users else torch.get_num_threads())


class Workers:
    """`num_threads` threads for the time of a ``with`` block.

    PyTorch's number of threads is each thread's own, and a new thread begins with what was set last anywhere. So every
    thread's outermost block sets 1 and restores, and a thread that meets PyTorch first while another is in a block
    takes over the number from before that block.
    """

    def __init__(self, num_threads: int = 0) -> None:
        self.num_threads = resolve_num_threads(num_threads)
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> Self:
        global _users, _threads_before  # noqa: PLW0603 - there is one PyTorch
        with _lock:
            depth = getattr(_blocks, "depth", 0)
            if _users == 0:
                _threads_before = torch.get_num_threads()
            if depth == 0:
                _blocks.threads_before = _threads_before
                _use_one_thread()
            _blocks.depth = depth + 1
            _users += 1
        self._pool = ThreadPoolExecutor(self.num_threads, "radarsdf", initializer=_use_one_thread)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        global _users  # noqa: PLW0603
        assert self._pool is not None
        try:
            self._pool.shutdown(cancel_futures=True)
        finally:  # a second Ctrl-C does not wait for the threads
            with _lock:
                _users -= 1
                _blocks.depth -= 1
                if _blocks.depth == 0:
                    torch.set_num_threads(_blocks.threads_before)

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> Iterator[_Result]:
        """Like the built-in, in order, the items on different threads. Grad mode is each thread's own."""
        assert self._pool is not None
        if self.num_threads == 1 or len(items) <= 1:
            return map(function, items)
        if len(items) > self.num_threads:
            return self._pool.map(function, items)
        # One for each: this thread takes the first, rather than wait and be woken, which an iteration would feel.
        others = self._pool.map(function, items[1:])
        with torch.enable_grad():  # as in a new thread
            first = function(items[0])
        return itertools.chain([first], others)
