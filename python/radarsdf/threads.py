"""A pool of Python threads that replaces PyTorch's own threads.

PyTorch splits every operation over OpenMP threads, which spin while they wait for each other. Next to another busy
process, a fit of 1.8 s took 88 s: working threads waited for the time slices of threads that only spun. Python threads
sleep while they wait, synchronise once per iteration, and are no slower on an idle machine, since PyTorch and the compiled
core release the GIL. For work of less than a millisecond, there is :attr:`ThreadPool.core_threads`.
"""

import itertools
import os
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from typing import TypeVar

import torch
from torch.nn import functional
from typing_extensions import Self

from radarsdf import core

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_TRANSCENDENTAL = ("cos", "erf", "exp", "log", "log10", "log1p", "log2", "pow", "sigmoid", "sin", "tanh")
_VECTOR_LENGTH = 1024  # elements: enough for vectors, too few for PyTorch to split among threads

_wanted, _known = os.environ.get("RADARSDF_ISA"), core.available_instruction_sets()
if _wanted and _wanted not in _known:  # the core keeps its own choice
    used = f"{', '.join(_known)}: {core.instruction_set()} is used"
    warnings.warn(f"RADARSDF_ISA={_wanted!s:.50} is none of {used}", RuntimeWarning, stacklevel=2)


class _State:
    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.open_blocks = 0
        self.usual_threads = 0  # PyTorch's number before the first open block
        self.here = threading.local()  # `inside`: whether this thread is in a block


_state = _State()


def _use_one_thread() -> None:
    torch.get_num_threads()  # initialises PyTorch in this thread, which would otherwise undo the next line
    torch.set_num_threads(1)


def _reset_after_fork() -> None:
    """Use one thread in a forked child, which has only the forking one: OpenMP would wait forever for the others."""
    _state.__init__()  # type: ignore[misc]
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reset_after_fork)


@cache
def start_vector_library() -> None:
    """Call PyTorch's transcendental functions once in this process, from a single thread.

    Their libraries detect the instruction set in the first call. If several threads make it at once, some get
    other last bits than later: about one in fifty processes would give another fit.
    """
    with _state.lock, torch.no_grad():
        for dtype in (torch.float32, torch.float64):
            numbers = torch.full((_VECTOR_LENGTH,), 0.5, dtype=dtype, device="cpu")
            for name in _TRANSCENDENTAL:
                getattr(torch, name)(*[numbers] * (2 if name == "pow" else 1))
            functional.binary_cross_entropy_with_logits(numbers, numbers)
            torch.randn(_VECTOR_LENGTH, generator=torch.Generator("cpu"), dtype=dtype, device="cpu")


def resolve_num_threads(num_threads: int) -> int:
    """Return `num_threads`, or for 0 PyTorch's number, as it was before a block of :class:`ThreadPool`."""
    with _state.lock:
        return num_threads or (_state.usual_threads if _state.open_blocks else torch.get_num_threads())


class ThreadPool:
    """A pool of `num_threads` threads for a ``with`` block. 0: as many as PyTorch uses."""

    # PyTorch keeps its number of threads per thread; a new thread starts with what any thread set last. So the outermost
    # block of each thread sets 1, and restores the number from before the first open block, because a thread
    # that first used PyTorch since then has read 1.

    def __init__(self, num_threads: int = 0) -> None:
        self.num_threads = resolve_num_threads(num_threads)

    def __enter__(self) -> Self:
        start_vector_library()
        with _state.lock:
            if _state.open_blocks == 0:
                _state.usual_threads = torch.get_num_threads()
            _state.open_blocks += 1
            self._is_outermost = not getattr(_state.here, "inside", False)
            if self._is_outermost:
                self._threads_after = _state.usual_threads
                _state.here.inside = True
                _use_one_thread()
        self._pool = ThreadPoolExecutor(self.num_threads, "radarsdf", initializer=_use_one_thread)
        return self

    def __exit__(self, *_: object) -> None:
        self.__dict__.pop("core_threads", None)  # its threads end with it
        try:
            self._pool.shutdown(cancel_futures=True)
        finally:  # even if a second Ctrl-C interrupts the wait for the threads
            with _state.lock:
                _state.open_blocks -= 1
                if self._is_outermost:
                    _state.here.inside = False
                    torch.set_num_threads(self._threads_after)

    @cached_property
    def core_threads(self) -> core.ThreadPool:
        """Equally many threads of the core, for short work without Python: they spin for a moment before they sleep.

        On two threads, a training iteration took 4.1 ms with the pool, which was woken ten times, and takes 2.3 ms.
        """
        return core.ThreadPool(self.num_threads)

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> Iterator[_Result]:
        """Like the built-in ``map``, with the items on different threads and gradients enabled.

        With one thread or one item it runs in the calling thread, with its grad mode.
        """
        if self.num_threads == 1 or len(items) <= 1:
            return map(function, items)
        # With a thread for every item, the calling one computes the first: waking another takes a noticeable time.
        own = 0 if len(items) > self.num_threads else 1
        futures = [self._pool.submit(function, item) for item in items[own:]]
        futures.reverse()  # a result is released once it is used
        with torch.enable_grad():  # as in the threads of the pool
            first = [function(item) for item in items[:own]]
        return itertools.chain(first, (futures.pop().result() for _ in range(len(futures))))
