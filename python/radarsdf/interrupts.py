# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Delays Ctrl-C while work must not be interrupted."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def deferred_interrupts() -> Iterator[Callable[[], bool]]:
    """Delays Ctrl-C in a ``with`` block. Gives a function that tells whether it was pressed.

    The caller stops at the next safe place. A second Ctrl-C interrupts at once. Nothing is changed in a
    thread that is not the main one, since only that receives the signal, nor if the program has its own
    handler for the signal.
    """
    pressed = False
    handler_before = signal.getsignal(signal.SIGINT)
    if (
        threading.current_thread() is not threading.main_thread()
        or handler_before is not signal.default_int_handler
    ):
        yield lambda: False
        return

    def remember(_number: int, _frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, handler_before)

    signal.signal(signal.SIGINT, remember)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, handler_before)


@contextmanager
def whole_import() -> Iterator[None]:
    """Delays Ctrl-C until an import is complete.

    For libraries such as trimesh, which take any exception during an import for a missing optional module.
    They would go on without the module, and Ctrl-C would have no effect.
    """
    with deferred_interrupts() as pressed:
        yield
    if pressed():
        raise KeyboardInterrupt
