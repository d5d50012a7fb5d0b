"""Deferral of Ctrl-C and SIGTERM during critical work, and changes that it cannot divide."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any

_STOPS = signal.SIGINT, signal.SIGTERM  # Ctrl-C, and the end of a service or container


@contextmanager
def deferred_interrupts() -> Iterator[Callable[[], bool]]:
    """Defer Ctrl-C in a ``with`` block, and yield a function that returns whether it was pressed.

    A second Ctrl-C interrupts at once. Without effect outside the main thread, which alone receives the signal, or if the
    program has its own handler. SIGTERM is deferred, too, in :func:`terminable`.
    """
    pressed = False

    def remember(_number: int, _frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        _exchange(remember, signal.default_int_handler)

    _exchange(signal.default_int_handler, remember)
    try:
        yield lambda: pressed
    finally:
        _exchange(remember, signal.default_int_handler)


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM act as Ctrl-C in a ``with`` block: else it would end the program without its results."""
    _exchange(signal.SIG_DFL, signal.default_int_handler, signal.SIGTERM)
    try:
        yield
    finally:
        _exchange(signal.default_int_handler, signal.SIG_DFL, signal.SIGTERM)


def _exchange(handler: Any, other: Any, *numbers: signal.Signals) -> None:
    if threading.current_thread() is threading.main_thread():
        for number in numbers or _STOPS:
            if signal.getsignal(number) is handler:
                signal.signal(number, other)


def at_once(*calls: partial[Any]) -> list[Any]:
    """Call compiled functions in turn, and return their results. No asynchronous exception comes between them.

    Python raises those, of signals and of other threads, between bytecodes only, and `map` executes none.
    """
    return list(map(partial.__call__, calls))
