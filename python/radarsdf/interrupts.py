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
    """Delay Ctrl-C in a ``with`` block, and yield a function that returns whether it was pressed.

    A second Ctrl-C interrupts at once. Nothing changes outside the main thread, which alone receives the signal, nor if the
    program has its own handler.
    """
    pressed = False
    handler_before = signal.getsignal(signal.SIGINT)
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or handler_before is not signal.default_int_handler:
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
    """Delay Ctrl-C until an import is complete: trimesh takes any exception meanwhile for a missing optional module."""
    with deferred_interrupts() as pressed:
        yield
    if pressed():
        raise KeyboardInterrupt
