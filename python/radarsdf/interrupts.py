"""Deferral of Ctrl-C during critical work, and changes that it cannot divide."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any


@contextmanager
def deferred_interrupts() -> Iterator[Callable[[], bool]]:
    """Defer Ctrl-C in a ``with`` block, and yield a function that returns whether it was pressed.

    A second Ctrl-C interrupts at once. Without effect outside the main thread, which alone receives the signal, or if the
    program has its own handler.
    """
    pressed = False

    def remember(_number: int, _frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    in_main_thread = threading.current_thread() is threading.main_thread()
    if in_main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, remember)
    try:
        yield lambda: pressed
    finally:
        if in_main_thread and signal.getsignal(signal.SIGINT) is remember:
            signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM, which ends services and containers, act as Ctrl-C in a ``with`` block; as :func:`deferred_interrupts`."""
    is_main = threading.current_thread() is threading.main_thread()
    is_ours = is_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if is_ours:
        signal.signal(signal.SIGTERM, lambda _number, _frame: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        if is_ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def at_once(*calls: partial[Any]) -> list[Any]:
    """Call compiled functions in turn, and return their results. No asynchronous exception comes between them.

    Python raises those, of signals and of other threads, between bytecodes only, and `map` executes none.
    """
    return list(map(partial.__call__, calls))
