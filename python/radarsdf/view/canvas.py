# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface on the page: a mesh at rest, a cloud of points while the sensor moves.

viser takes colours of vertices only with a whole mesh. That is too much for each step of a drag, and the page would be
blank between two meshes. So a step recolours a cloud of some vertices in place. A new mesh is sent when the drag has
ended, beside what is there, which is hidden once the page has drawn the new one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.map.colors import NEUTRAL
from radarsdf.map.map import Map
from radarsdf.view.glb import glb
from radarsdf.view.light import shaded
from radarsdf.view.painter import Wish
from radarsdf.view.quantities import Quantity
from radarsdf.view.serving import wait_until_drawn
from radarsdf.view.surface import ShownSurface
from radarsdf.view.thinning import spread_evenly
from radarsdf.view.walk import Walk

DRAG_POINTS = 30_000
"""Vertices that are recoloured while the sensor moves: on two cores intensities of 30,000 points take about 0.025 s, of
400,000 about 0.4 s."""
_POINT_EDGES = 1.4  # size of a point in distances of neighbours, so that there are no holes between them


class SurfaceCanvas:
    """Draws the surface, coloured by a quantity, and the scan of the walk.

    Parameters
    ----------
    server
        The viser server.
    radar_map
        The map.
    surface
        Its mesh.
    quantities
        What it can be coloured by, by name.
    walk
        The scans, if there are any.
    shown
        Called with a wish when the mesh of it has been sent.
    """

    def __init__(
        self,
        server: Any,
        radar_map: Map,
        surface: ShownSurface,
        quantities: Mapping[str, Quantity],
        walk: Walk | None,
        shown: Callable[[Wish], None],
    ) -> None:
        self._server, self._surface, self._quantities = server, surface, quantities
        self._walk, self._shown = walk, shown
        self._local = (surface.vertices - radar_map.origin).astype(np.float32)
        self._spread, _, edge_m = spread_evenly(surface.vertices, DRAG_POINTS, surface.spacing_m)
        self._rows = self._spread
        self._limits: tuple[float, float] | None = None  # of what is in the cloud
        self._drawn: Hashable = None  # what the mesh depends on
        self._meshes: list[Any] = []  # the newest is last; others are removed when the page has drawn that
        self.sent = 0
        """Meshes that were sent so far."""
        self.faces = surface.faces
        """Triangles that are shown, (F, 3) rows of the vertices."""
        self.coarse = False
        """Whether the cloud is shown, or still is because a mesh may not be drawn yet."""
        self.node: Any = server.scene.add_frame("/surface", show_axes=False)
        """The parent of mesh and cloud."""
        self._cloud: Any = None
        if any(quantity.of_sensor for quantity in quantities.values()):
            self._cloud = server.scene.add_point_cloud(
                "/surface/cloud",
                self._local[self._spread],
                np.full((len(self._spread), 3), NEUTRAL, np.uint8),
                point_size=_POINT_EDGES * edge_m,
                point_shape="circle",
                point_shading="flat",
                precision="float32",  # float16 has steps of 3 cm at 60 m
                visible=False,
            )

    def show_scan(self, wish: Wish) -> None:
        """See `Canvas`."""
        if self._walk is not None and wish.scan is not None:
            self._walk.show(wish.scan)

    def show_cloud(self, wish: Wish) -> None:
        """See `Canvas`."""
        if not self._quantities[wish.quantity].of_sensor:
            return  # the mesh stays as it is
        limits = (wish.max_uncertainty_m, wish.min_confidence)
        others = limits != self._limits
        if others:
            self._rows = self._spread[self._surface.kept(*limits)[self._spread]]
            self._limits = limits
        colors = self._colors(self._rows, wish)
        with self._server.atomic():
            if others:
                self._cloud.points = self._local[self._rows]
            self._cloud.colors = colors
            self.coarse = True
            _set_visible(self._cloud, visible=True)
            for mesh in self._meshes:
                _set_visible(mesh, visible=False)

    def show_mesh(self, wish: Wish, superseded: Callable[[], bool]) -> None:
        """See `Canvas`."""
        limits = (wish.max_uncertainty_m, wish.min_confidence)
        drawn = (limits, wish.quantity, wish.sensor if self._quantities[wish.quantity].of_sensor else None)
        if drawn == self._drawn and not self.coarse:
            self._shown(wish)
            return
        rows, faces = self._surface.part(self._surface.kept(*limits))
        colors = self._colors(rows, wish)
        if superseded():
            return
        old, self._meshes = self._meshes, []
        if len(faces):
            self.sent += 1
            data = glb(self._local[rows], faces, colors)
            name = f"/surface/mesh {self.sent}"
            self._meshes = [self._server.scene.add_glb(name, data, cast_shadow=False, receive_shadow=False)]
        self.faces = rows[faces].astype(np.int32)
        wait_until_drawn(self._server, superseded)
        if superseded():
            self._meshes = old + self._meshes
            return
        with self._server.atomic():
            for mesh in old:
                mesh.remove()
            self.coarse, self._drawn = False, drawn
            if self._cloud is not None:
                _set_visible(self._cloud, visible=False)
        self._shown(wish)

    def _colors(self, rows: NDArray[np.int64], wish: Wish) -> NDArray[np.uint8]:
        """(N, 3) colours of vertices (N,)."""
        colors = self._quantities[wish.quantity].colors(rows, wish.sensor)
        return shaded(colors, self._surface.lightness[rows])


def _set_visible(handle: Any, *, visible: bool) -> None:
    """Show or hide, without a message if nothing changes."""
    if handle.visible != visible:
        handle.visible = visible
