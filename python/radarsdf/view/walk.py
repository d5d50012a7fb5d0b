# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The scans on the page: the path of the sensor, and the returns of one scan, measured and predicted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.scans import Scan, Scans
from radarsdf.map.map import Map

ALL_RETURNS = 200_000
"""Returns of all scans that are shown together at most."""
PATH_COLOR = (40, 44, 52)
MEASURED_COLOR = (0, 72, 140)
"""Without intensities."""
PREDICTED_COLOR = (0, 158, 115)
"""Not a colour of the scale: what is predicted and lies on the surface is seen. Its intensity is that of the surface."""
_SHAPES = {"measured": "circle", "predicted": "diamond", "all": "circle"}
_SIZES_M = {"measured": 0.25, "predicted": 0.2, "all": 0.2}


class Walk:
    """Shows the returns of one scan after another.

    Parameters
    ----------
    server
        The viser server.
    radar_map
        The map that predicts.
    scans
        The scans. All returns are kept in memory.
    colors
        (N, 3) sRGB of intensities (N,). None: the map has none.
    say
        Called with a sentence about the scan that is shown.
    """

    def __init__(
        self,
        server: Any,
        radar_map: Map,
        scans: Scans,
        colors: Callable[[NDArray[Any]], NDArray[np.uint8]] | None,
        say: Callable[[str], None],
    ) -> None:
        self._server, self._map, self._say = server, radar_map, say
        self._points, self._poses = scans.points, scans.poses
        self._intensities = scans.intensities
        self._colors = colors
        self._shown: int | None = None
        self._clouds: dict[str, Any] = {}
        self._visible = {"measured": True, "predicted": True, "all": False}
        path = (self._poses[:, :3, 3] - radar_map.origin).astype(np.float32)
        self.path: Any = server.scene.add_line_segments(
            "/scans/path",
            np.stack([path[:-1], path[1:]], axis=1),
            PATH_COLOR,
            thickness=3.0,
            thickness_units="screen",
        )

    def __len__(self) -> int:
        """Number of scans."""
        return len(self._points)

    def sensor(self, index: int) -> tuple[float, float, float]:
        """Position of the sensor in a scan, world, m."""
        x, y, z = self._poses[index, :3, 3].tolist()
        return x, y, z

    def show(self, index: int) -> None:
        """Show the returns of a scan, unless they are shown."""
        if index == self._shown:
            return
        self._shown = index
        world = self._in_world(index)
        view = self._map.render(self._poses[index])
        measured = None if self._intensities is None else self._intensities[index]
        with self._server.atomic():
            self._draw("measured", world, self._colors_of(measured, len(world)))
            predicted = np.full((len(view), 3), PREDICTED_COLOR, np.uint8)
            self._draw("predicted", view.world_points, predicted)
        error = ""
        if measured is not None and self._map.has_intensity:
            errors = np.abs(
                self._map.intensity(world, self._poses[index, :3, 3], extrapolate=True)
                - np.asarray(measured, np.float64)
            )
            errors = errors[np.isfinite(errors)]
            error = f"; median error of the intensity {np.median(errors):.1f}" if errors.size else ""
        self._say(f"scan {index}: {len(world)} returns measured, {len(view)} predicted{error}")

    def set_visible(self, what: str, visible: bool) -> None:
        """Show or hide the clouds "measured" and "predicted" of the scan, or the cloud of "all" returns."""
        self._visible[what] = visible
        if what == "all" and visible and "all" not in self._clouds:
            self._draw_all()
        if what in self._clouds:
            self._clouds[what].visible = visible

    @property
    def every(self) -> int:
        """Of how many returns one is shown among all."""
        return max(1, -(-sum(map(len, self._points)) // ALL_RETURNS))

    def _draw_all(self) -> None:
        step = self.every
        world = np.concatenate([self._in_world(i) for i in range(len(self))])[::step]
        measured = None if self._intensities is None else np.concatenate(self._intensities)[::step]
        self._draw("all", world, self._colors_of(measured, len(world)))

    def _colors_of(self, intensities: NDArray[Any] | None, count: int) -> NDArray[np.uint8]:
        """(N, 3) sRGB of `count` returns that were measured."""
        if intensities is None or self._colors is None:
            return np.full((count, 3), MEASURED_COLOR, np.uint8)
        return self._colors(np.asarray(intensities, np.float64))

    def _in_world(self, index: int) -> NDArray[np.float64]:
        """(N, 3) returns, world, m."""
        return Scan(self._points[index], self._poses[index]).world_points

    def _draw(self, what: str, world: NDArray[np.float64], colors: NDArray[np.uint8]) -> None:
        local = (world - self._map.origin).astype(np.float32)
        if what in self._clouds:
            cloud = self._clouds[what]
            cloud.points, cloud.colors = local, colors
            return
        self._clouds[what] = self._server.scene.add_point_cloud(
            f"/scans/{what}",
            local,
            colors,
            point_size=_SIZES_M[what],
            point_shape=_SHAPES[what],
            point_shading="flat",
            precision="float32",
            visible=self._visible[what],
        )
