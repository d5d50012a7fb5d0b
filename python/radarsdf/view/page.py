# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A page that is served until it is stopped."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TYPE_CHECKING, Any

from radarsdf.view.framing import FOV_RAD, Look
from radarsdf.view.serving import WAIT_STEP_S, free_port, require_viser, start_server, stop_server

if TYPE_CHECKING:
    from typing_extensions import Self


def begin_at(server: Any, look: Look) -> None:
    """From where, and at what, pages of a server look when they are opened."""
    camera = server.initial_camera
    camera.fov = FOV_RAD
    camera.position, camera.look_at = map(tuple, look)


class Page:
    """What all pages have in common. The port is chosen first, so that one that is taken is said before any work.

    Parameters
    ----------
    host : str
        Address to listen on.
    port : int or None
        Port to listen on. None: 8080, or the next that is free.
    """

    def __init__(self, host: str, port: int | None) -> None:
        require_viser()
        self.host = host
        self.port = free_port(host, 8080 if port is None else port, exactly=port is not None)

    def _start(self) -> None:
        self._server: Any = start_server(self.host, self.port)

    def wait(self) -> None:
        """Wait until Ctrl-C."""
        while True:
            time.sleep(WAIT_STEP_S)

    def stop(self) -> None:
        """Close the page and end all threads."""
        stop_server(self._server)

    def __enter__(self) -> Self:
        """The page, which the end of the block stops."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Stop."""
        self.stop()
