# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The page: a server with the surface, the sensor, the scans and the controls."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.io.scans import Scans
from radarsdf.map.map import Map
from radarsdf.view.canvas import SurfaceCanvas
from radarsdf.view.controls import Controls
from radarsdf.view.framing import FOV_RAD, Look, look_at_all
from radarsdf.view.page import Page, begin_at
from radarsdf.view.painter import HELD_S, SLID_S, Painter, Wish
from radarsdf.view.picking import first_hit
from radarsdf.view.quantities import Colors, quantities_of
from radarsdf.view.surface import ShownSurface
from radarsdf.view.walk import Walk

_GIZMO_SHARE = 0.06  # size of the handles of the sensor in diagonals of the surface
_MARK_SHARE = 0.012  # radius of the mark of a click in distances to it: so large on the screen, near and far
_MARK_COLOR = (0, 190, 255)  # not one of a scale
_CLICKED = "/clicked"


class Viewer(Page):
    """Serves a map in the browser until it is stopped.

    While the sensor is dragged, at most 30,000 vertices are recoloured, spread evenly over the surface: intensities of
    all take too long for ten updates a second on two cores. All are recoloured when the drag ends. The scale of the
    colours does not change: it is the range from the 2nd to the 98th percentile of the values on the surface, of
    intensities that of what is predicted for the first position. The page shows the map's local frame, so that float32
    is fine enough for any coordinates; numbers are world coordinates.

    Parameters
    ----------
    radar_map : RadarMap or TiledMap
        The map.
    scans : Scans, optional
        Scans with poses, to walk through. Their returns are kept in memory.
    voxel_size : float
        Edge of the voxels of the mesh, m.
    box : (2, 3) array_like, optional
        Lower and upper corner of the part to be shown, world, m.
    max_vertices : int
        A mesh of more vertices is thinned.
    host : str
        Address to listen on. Others than those of this machine alone let everyone in who can reach it, by this address;
        with ``0.0.0.0`` by any address and the name of the machine. Other names, and pages of others, are refused.
    port : int, optional
        Port to listen on. None: 8080, or the next that is free.
    progress : bool, optional
        Whether to show a progress bar. By default only on a terminal.
    **limits
        What the mesh leaves out, such as ``min_confidence``: as :meth:`Map.mesh`.

    Raises
    ------
    ImportError
        If viser is missing.
    OSError
        If host and port cannot be listened on.
    ValueError
        If the map has no surface, or for wrong arguments.
    """

    def __init__(
        self,
        radar_map: Map,
        scans: Scans | None = None,
        *,
        voxel_size: float = 0.1,
        box: ArrayLike | None = None,
        max_vertices: int = 500_000,
        host: str = "127.0.0.1",
        port: int | None = None,
        progress: bool | None = None,
        **limits: Any,
    ) -> None:
        super().__init__(host, port)
        self._map = radar_map
        self.surface = ShownSurface.of(
            radar_map, voxel_size, max_vertices=max_vertices, box=box, progress=progress, **limits
        )
        """What is shown."""
        self._start()
        try:
            self._fill(scans)
        except BaseException:
            super().stop()
            raise
        self.notes = self._notes(voxel_size)
        """Sentences on what is shown coarser or thinner than it is."""

    def wait(self) -> None:
        """Wait until the viewer is stopped, from another thread or by Ctrl-C. An error in its thread is raised here."""
        self._painter.wait()

    def stop(self) -> None:
        """Close the page and end all threads."""
        self._painter.stop()
        super().stop()

    def _fill(self, scans: Scans | None) -> None:
        origin, vertices = self._map.origin, self.surface.vertices
        path = np.zeros((0, 3)) if scans is None else scans.poses[:, :3, 3] - origin
        self._extent = np.concatenate([vertices - origin, path])
        size_m = float(np.linalg.norm(np.ptp(self._extent, axis=0)))
        server = self._server
        begin_at(server, look_at_all(self._extent))
        start = origin if scans is None else scans.poses[0, :3, 3]
        first = (float(start[0]), float(start[1]), float(start[2]))
        self.quantities = quantities_of(self._map, self.surface, scans, first)
        """What the surface can be coloured by."""
        measured = None
        if "intensity" in self.quantities:
            scale = self.quantities["intensity"].scale
            measured = scale if isinstance(scale, Colors) else None
        self._walk = None
        count = 0 if scans is None else len(scans)
        self._controls = controls = Controls(server, self.surface, self.quantities, measured, count)
        if scans is not None:
            self._walk = Walk(server, self._map, scans, measured, controls.say_of_scan)
        self._clicked: NDArray[np.float64] | None = None
        self._canvas = SurfaceCanvas(
            server, self._map, self.surface, self.quantities, self._walk, self._describe
        )
        wish = Wish(
            first,
            max_uncertainty_m=controls.max_uncertainty_m,
            min_confidence=controls.min_confidence,
            quantity=controls.quantity,
            scan=None if self._walk is None else 0,
        )
        self._gizmo: Any = None
        if self._map.has_intensity:
            self._add_sensor(np.array(first) - origin, size_m)
        self._painter = Painter(self._canvas, wish)
        controls.connect(self._painter, self._canvas, self._walk, self._go_to_scan, self._look_at_all)
        server.on_client_connect(self._on_connect)
        server.scene.on_click()(self._on_click)

    def _look_at_all(self, client: Any) -> Look:
        """Let a page show all that there is."""
        camera = client.camera
        look = look_at_all(self._extent, aspect=_aspect(camera))
        with client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.fov = FOV_RAD
            camera.position, camera.look_at = look
        return look

    # Coroutines, because viser would run functions in several threads, in any order.
    async def _on_connect(self, client: Any) -> None:
        """Let a new page show all, also after its frame has changed, until somebody looks elsewhere."""
        first = look_at_all(self._extent)  # which a page may take after it was told a better one
        aspect, look = _aspect(client.camera), self._look_at_all(client)

        async def on_update(camera: Any) -> None:
            nonlocal aspect, look
            untouched = _is_at(camera, look) and _aspect(camera) != aspect
            if untouched or (_is_at(camera, first) and not _is_at(camera, look)):
                aspect, look = _aspect(camera), self._look_at_all(client)

        client.camera.on_update(on_update)

    def _add_sensor(self, position: NDArray[np.float64], size_m: float) -> None:
        scale = _GIZMO_SHARE * size_m
        far = 1e6
        self._gizmo = self._server.scene.add_transform_controls(
            "/sensor",
            scale,
            disable_rotations=True,
            depth_test=False,
            translation_limits=((-far, far),) * 3,
            position=tuple(position),
        )
        self._server.scene.add_icosphere("/sensor/ball", scale / 8, (20, 20, 24))

        # A coroutine, because viser would run functions in several threads, in any order.
        async def on_update(event: Any) -> None:
            sensor = self._map.origin + np.asarray(event.target.position, np.float64)
            ended = event.phase == "end"
            self._painter.wish(
                sensor=tuple(sensor.tolist()), coarse=not ended, settle_s=0.0 if ended else HELD_S
            )

        self._gizmo.on_update(on_update)

    def _go_to_scan(self, index: int) -> None:
        """Show a scan, and move the sensor to where it was measured."""
        assert self._walk is not None
        sensor = self._walk.sensor(index)
        if self._gizmo is not None:
            self._gizmo.position = tuple(np.array(sensor) - self._map.origin)
        self._painter.wish(scan=index, sensor=sensor, coarse=True, settle_s=SLID_S)

    def _on_click(self, event: Any) -> None:
        vertices = self.surface.vertices - self._map.origin
        point = first_hit(vertices, self._canvas.faces, event.ray_origin, event.ray_direction)
        if point is None:
            return
        self._clicked = point + self._map.origin
        away_m = float(np.linalg.norm(point - np.asarray(event.ray_origin)))
        self._server.scene.add_icosphere(
            _CLICKED,
            max(_MARK_SHARE * away_m, 0.5 * self.surface.spacing_m),
            _MARK_COLOR,
            position=tuple(point),
            cast_shadow=False,
            receive_shadow=False,
        )
        self._describe(self._painter.newest)

    def _describe(self, wish: Wish) -> None:
        """Say what the map knows of the point that was clicked last, for the sensor of a wish."""
        if self._clicked is None:
            return
        x = self._clicked[None]
        rows = {
            "position": "{:.3f}, {:.3f}, {:.3f} m".format(*self._clicked),
            "signed distance": f"{self._map.sdf(x)[0]:+.3f} m",
            "uncertainty": f"{self._map.uncertainty(x)[0]:.3f} m",
            "confidence": f"{self._map.confidence(x)[0]:.2f}",
        }
        if self._map.has_intensity:
            range_m = float(np.linalg.norm(self._clicked - np.array(wish.sensor)))
            rows["intensity"] = f"{self._map.intensity(x, np.array(wish.sensor))[0]:.1f} from {range_m:.1f} m"
        self._controls.say_of_click(rows)

    def _notes(self, voxel_size: float) -> list[str]:
        notes = []
        if self.surface.spacing_m > voxel_size:
            notes.append(
                f"the mesh is thinned to {len(self.surface.vertices)} vertices, {self.surface.spacing_m:.2g} m apart: "
                "--max-vertices allows more, --box shows a part"
            )
        if self._walk is not None and self._walk.every > 1:
            notes.append(f"of all returns together, one in {self._walk.every} is shown")
        return notes


def _aspect(camera: Any) -> float:
    """Width of a page's frame over its height, within what a screen can have."""
    return float(np.clip(camera.image_width / max(camera.image_height, 1), 0.1, 10.0))


def _is_at(camera: Any, look: Look) -> bool:
    """Whether a page looks from there."""
    return bool(np.allclose(camera.position, look.position, atol=0.01))
