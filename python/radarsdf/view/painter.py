# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Draws what the page asks for, in a thread of its own. The newest wish wins."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from radarsdf.view.latest import Latest
from radarsdf.view.serving import WAIT_STEP_S

HELD_S = 2.0
"""After so long without a new position the mesh is shown, though the sensor is still held."""
SLID_S = 0.25
"""A slider has no end of a drag: this is the pause that is taken for one."""


@dataclass(frozen=True)
class Wish:
    """What the page is to show."""

    sensor: tuple[float, float, float]
    """Position of the sensor, world, m."""
    max_uncertainty_m: float
    """Vertices of more uncertainty are hidden."""
    min_confidence: float
    """Vertices of less confidence are hidden."""
    quantity: str = ""
    """Name of what the surface is coloured by."""
    scan: int | None = None
    """The scan whose returns are shown."""
    coarse: bool = False
    """Whether the sensor is on its way, and few points are recoloured at once."""
    settle_s: float = 0.0
    """All is shown if nothing changes for so many seconds."""


class Canvas(Protocol):
    """What a painter paints on."""

    def show_scan(self, wish: Wish) -> None:
        """Show the returns of a scan, if they are not shown yet."""

    def show_cloud(self, wish: Wish) -> None:
        """Recolour few points, at once."""

    def show_mesh(self, wish: Wish, superseded: Callable[[], bool]) -> None:
        """Recolour the whole mesh. It may stop if it is superseded."""


class Painter:
    """Paints the newest wish.

    Parameters
    ----------
    canvas
        What is painted on, from one thread only.
    wish
        The first wish.
    """

    def __init__(self, canvas: Canvas, wish: Wish) -> None:
        self._canvas = canvas
        self._wishes = Latest(wish)
        self._ended = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="radarsdf view", daemon=True)
        self._thread.start()

    @property
    def newest(self) -> Wish:
        """The wish, which may not be painted yet."""
        return self._wishes.newest

    def wish(self, **changes: Any) -> None:
        """Change the wish, from any thread. It returns at once."""
        self._wishes.change(**changes)

    def wait(self) -> None:
        """Wait for the end of the thread. An error that ended it is raised here."""
        while not self._ended.wait(WAIT_STEP_S):
            pass
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End the thread, after what it is painting."""
        self._wishes.close()
        self._thread.join()

    def _run(self) -> None:
        try:
            while (wish := self._wishes.take()) is not None:
                self._canvas.show_scan(wish)
                if wish.coarse:
                    self._canvas.show_cloud(wish)
                if not self._wishes.news(wish.settle_s):
                    self._canvas.show_mesh(wish, self._wishes.news)
        except BaseException as error:  # noqa: BLE001 - it is raised where it can be caught
            self._error = error
        finally:
            self._ended.set()
