# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface on the page: a mesh at rest, a cloud of points while the sensor moves.

viser takes colours of vertices only with a whole mesh. That is too much for each step of a drag, and the page would be
blank between two meshes. So a step recolours a cloud of some vertices in place. A new mesh is sent when the drag has
ended, beside what is there, which is hidden once the page has drawn the new one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.map.colors import NEUTRAL, intensity_colors
from radarsdf.tiles.any_map import AnyMap
from radarsdf.view.glb import glb
from radarsdf.view.painter import Wish
from radarsdf.view.serving import wait_until_drawn
from radarsdf.view.surface import Surface
from radarsdf.view.thinning import spread_evenly
from radarsdf.view.walk import Walk

DRAG_POINTS = 30_000
"""Vertices that are recoloured while the sensor moves: on two cores intensities of 30,000 points take about 0.025 s, of
400,000 about 0.4 s."""
_POINT_EDGES = 1.4  # size of a point in distances of neighbours, so that there are no holes between them


class Colors:
    """Colours of intensities on a scale that does not change.

    Parameters
    ----------
    low, high
        Limits of the scale, sensor units.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high

    def __call__(self, intensities: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, 3) sRGB of intensities (N,)."""
        return intensity_colors(intensities, self.low, self.high)[:, :3]


class SurfaceCanvas:
    """Draws the surface, coloured by the intensity predicted for the sensor, and the scan of the walk.

    Parameters
    ----------
    server
        The viser server.
    radar_map
        The map.
    surface
        Its mesh.
    colors
        None: the map has no intensities, and the surface is grey.
    walk
        The scans, if there are any.
    shown
        Called with a wish when the mesh of it has been sent.
    """

    def __init__(
        self,
        server: Any,
        radar_map: AnyMap,
        surface: Surface,
        colors: Colors | None,
        walk: Walk | None,
        shown: Callable[[Wish], None],
    ) -> None:
        self._server, self._map, self._surface, self._colors = server, radar_map, surface, colors
        self._walk, self._shown = walk, shown
        self._local = (surface.vertices - radar_map.origin).astype(np.float32)
        self._spread, _, edge_m = spread_evenly(surface.vertices, DRAG_POINTS, surface.spacing_m)
        self._rows = self._spread
        self._limits: tuple[float, float] | None = None  # of what is in the cloud
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
        if colors is not None:
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
        if self._cloud is None:
            return
        limits = (wish.max_uncertainty_m, wish.min_confidence)
        others = limits != self._limits
        if others:
            self._rows = self._spread[self._surface.kept(*limits)[self._spread]]
            self._limits = limits
        colors = self._predicted(self._rows, wish)
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
        rows, faces = self._surface.part(self._surface.kept(wish.max_uncertainty_m, wish.min_confidence))
        colors = self._predicted(rows, wish)
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
            self.coarse = False
            if self._cloud is not None:
                _set_visible(self._cloud, visible=False)
        self._shown(wish)

    def _predicted(self, rows: NDArray[np.int64], wish: Wish) -> NDArray[np.uint8]:
        """(N, 3) colours of vertices (N,)."""
        colors = np.full((len(rows), 3), NEUTRAL, np.uint8)
        if self._colors is not None and len(rows):
            colors = self._colors(self._map.intensity(self._surface.vertices[rows], np.array(wish.sensor)))
        shaded: NDArray[np.uint8] = (colors * self._surface.brightness[rows, None]).astype(np.uint8)
        return shaded


def _set_visible(handle: Any, *, visible: bool) -> None:
    """Show or hide, without a message if nothing changes."""
    if handle.visible != visible:
        handle.visible = visible
