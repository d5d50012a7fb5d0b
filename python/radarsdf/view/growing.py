# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A page that shows a surface while it grows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from radarsdf.view.framing import look_at_all
from radarsdf.view.page import Page, begin_at

if TYPE_CHECKING:
    import trimesh

_SURFACE_COLOR, _PATH_COLOR = (150, 160, 170), (0, 190, 255)


class GrowingView(Page):
    """Serves the surface and the way of the sensor, whatever they are now, until it is stopped.

    Parameters
    ----------
    host : str
        Address to listen on.
    port : int, optional
        Port to listen on. None: 8080, or the next that is free.

    Raises
    ------
    ImportError
        If viser is missing.
    OSError
        If host and port cannot be listened on.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int | None = None) -> None:
        super().__init__(host, port)
        self._start()
        self._origin: NDArray[np.float64] | None = None

    def show(self, mesh: trimesh.Trimesh, path: NDArray[np.float64]) -> None:
        """Replaces what is shown: a mesh, and the positions (F, 3) of the sensor, world, m."""
        if len(mesh.faces) == 0:
            return
        vertices = np.asarray(mesh.vertices, np.float64)
        server = self._server
        if self._origin is None:  # of the page, which is in float32
            self._origin = path[0].copy()
            begin_at(server, look_at_all(vertices - self._origin))
        with server.atomic():
            server.scene.add_mesh_simple(
                "/surface",
                (vertices - self._origin).astype(np.float32),
                np.asarray(mesh.faces, np.uint32),
                color=_SURFACE_COLOR,
                side="double",
                flat_shading=True,
            )
            if len(path) > 1:
                way = (path - self._origin).astype(np.float32)
                server.scene.add_line_segments(
                    "/path", np.stack([way[:-1], way[1:]], axis=1), colors=_PATH_COLOR, line_width=3.0
                )
