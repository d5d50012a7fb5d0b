# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Ctrl-C, held back while something must not be torn."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def deferred_interrupts() -> Iterator[Callable[[], bool]]:
    """Gives a function that says whether Ctrl-C was pressed, so that it tears nothing: a second one does not wait.

    Where someone else handles the signal, or the thread is not the main one, which alone receives it, all stays as it
    is.
    """
    pressed = False
    usual = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or usual is not signal.default_int_handler:
        yield lambda: False
        return

    def remember(_number: int, _frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, usual)

    signal.signal(signal.SIGINT, remember)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, usual)


@contextmanager
def whole_import() -> Iterator[None]:
    """For the import of a library that takes any exception within for a part that is missing: Ctrl-C comes after it.

    trimesh does so. It would go on without the part, and nobody would learn that Ctrl-C was pressed.
    """
    with deferred_interrupts() as pressed:
        yield
    if pressed():
        raise KeyboardInterrupt
