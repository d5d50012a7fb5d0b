# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How a fit ends before its time, and what it hands back then."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from radarsdf.map.radar_map import RadarMap


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a fit.

    Attributes
    ----------
    radar_map : RadarMap or None
        What was learnt so far, a map like any other; None if the training had not begun. In its ``report``,
        ``iterations_done`` falls short of ``iterations``.
    """

    def __init__(self, radar_map: RadarMap | None = None) -> None:
        super().__init__("interrupted while training" if radar_map else "interrupted before the training")
        self.radar_map = radar_map


class Diverged(FloatingPointError):
    """A loss or a parameter stopped being finite; the message says which, in which stage and iteration.

    Attributes
    ----------
    radar_map : RadarMap or None
        The last state found to be finite throughout, at most a hundred iterations older.
    """

    radar_map: RadarMap | None = None


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
