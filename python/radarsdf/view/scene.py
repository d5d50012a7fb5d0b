"""Scene of a viewer's page: the surface and one scan, redrawn by a thread from the newest state of the controls.

viser takes vertex colours only with a whole mesh: too much for each step of a drag, and the page is blank between two. So a
step recolours a cloud of some vertices. The new mesh comes after the drag, and the old scene stays until it is drawn.
"""

import threading
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from radarsdf.arrays import Array, Bytes, Floats, Ints
from radarsdf.map.colors import NEUTRAL, Scale
from radarsdf.map.map import Map
from radarsdf.scans import Scans
from radarsdf.view.serving import WAIT_STEP_S, wait_until_drawn
from radarsdf.view.surface import Position, Quantity, ShownSurface, glb, lightness_of, shaded, spread_evenly

# Measured returns without intensities; predictions are not on the intensity scale, and stand out from the surface.
SCAN_COLORS = {"measured": (0, 72, 140), "predicted": (0, 158, 115), "trajectory": (40, 44, 52)}

# On two cores, intensities of 30,000 points take about 0.025 s, of 400,000 about 0.4 s.
_DRAG_POINTS = 30_000
_POINT_SIZE = 1.4  # size in vertex spacings, which leaves no holes between points
_STYLES = {"measured": ("circle", 0.25), "predicted": ("diamond", 0.2)}  # size, m
# In float16, points would lie on a grid of 3 cm at 60 m.
_POINTS = {"point_shading": "flat", "precision": "float32"}


@dataclass(frozen=True)
class State:
    sensor: Position  # world, m
    limits: tuple[float, float]  # uncertainty, m, and confidence: arguments of :meth:`ShownSurface.kept`
    quantity: str = ""
    scan: int = 0
    coarse: bool = False  # whether the sensor is moving: show the cloud first
    settle_s: float = 0.0  # draw the mesh if nothing changes for this long


class Painter:
    """Draws the newest state on a canvas in its own thread, skipping superseded states."""

    def __init__(self, canvas: Any, state: State) -> None:
        self._canvas = canvas
        self.newest = state  # may not be drawn yet
        self._changed = threading.Condition()
        self._pending, self._stopped = True, False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="radarsdf view", daemon=True)
        self._thread.start()

    def change(self, **fields: Any) -> None:
        """Change fields of the state, from any thread, without waiting."""
        with self._changed:
            self.newest = replace(self.newest, **fields)
            self._pending = True
            self._changed.notify_all()

    def wait(self) -> None:
        """Wait for the thread to end. Raises the error that ended it."""
        while self._thread.is_alive():
            self._thread.join(WAIT_STEP_S)
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join()

    def _superseded(self, within_s: float | None = 0.0) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: self._pending or self._stopped, within_s)

    def _run(self) -> None:
        try:
            while self._superseded(within_s=None) and not self._stopped:
                with self._changed:
                    self._pending, state = False, self.newest
                self._canvas.show_scan(state)
                if state.coarse:
                    self._canvas.show_cloud(state)
                if not self._superseded(state.settle_s):
                    self._canvas.show_mesh(state, self._superseded)
        except BaseException as error:  # noqa: BLE001 - `wait` raises it
            self._error = error


class Canvas:
    """Draws the surface, coloured by a quantity, and the scan. Calls `shown` with a state once its mesh is sent."""

    def __init__(
        self,
        server: Any,
        radar_map: Map,
        surface: ShownSurface,
        quantities: Mapping[str, Quantity],
        scans: "ScanClouds | None",
        shown: Callable[[State], None],
    ) -> None:
        self._server, self._surface, self._quantities = server, surface, quantities
        self._scans, self._shown = scans, shown
        self._local = (surface.vertices - radar_map.origin).astype(np.float32)
        self._spread, _, spacing_m = spread_evenly(surface.vertices, _DRAG_POINTS, surface.spacing_m)
        self._cloud_limits: tuple[float, float] | None = None
        self._drawn: Hashable = None  # what the mesh depends on
        self._meshes: list[Any] = []  # newest last; the older ones are removed once the page has drawn it
        self.sent = 0  # number of meshes so far
        self.faces = surface.faces  # (F, 3) visible triangles, rows of the vertices
        self.coarse = False  # whether the cloud is shown
        server.scene.add_frame("/surface", show_axes=False)  # the parent of mesh and cloud
        self._cloud: Any = None
        if any(quantity.of_sensor for quantity in quantities.values()):
            points, style = self._local[self._spread], {"point_shape": "circle", "visible": False}
            size_m = _POINT_SIZE * spacing_m
            self._cloud = add_cloud(server, "/surface/cloud", points, NEUTRAL, size_m, **style)

    def show_scan(self, state: State) -> None:
        if self._scans is not None:
            self._scans.show(state.scan)

    def show_cloud(self, state: State) -> None:
        """Recolour the cloud and show it instead of the mesh, if the quantity depends on the sensor."""
        if not self._quantities[state.quantity].of_sensor:
            return
        rows = self._spread[self._surface.kept(*state.limits)[self._spread]]
        colors = self._colors(rows, state)
        with self._server.atomic():
            if state.limits != self._cloud_limits:
                self._cloud_limits, self._cloud.points = state.limits, self._local[rows]
            self._cloud.colors = colors
            self.coarse = True
            self._cloud.visible = True
            for mesh in self._meshes:
                mesh.visible = False

    def show_mesh(self, state: State, superseded: Callable[[], bool]) -> None:
        """Send the mesh, and show only it once the page has drawn it, unless the state is superseded before."""
        of_sensor = self._quantities[state.quantity].of_sensor
        drawn = (state.limits, state.quantity, state.sensor if of_sensor else None)
        if drawn == self._drawn and not self.coarse:
            self._shown(state)
            return
        rows, faces = self._surface.part(self._surface.kept(*state.limits))
        colors = self._colors(rows, state)
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
            self._meshes, self._drawn = old + self._meshes, None
            return
        with self._server.atomic():
            for mesh in old:
                mesh.remove()
            self.coarse, self._drawn = False, drawn
            if self._cloud is not None:
                self._cloud.visible = False
        self._shown(state)

    def _colors(self, rows: Ints, state: State) -> Bytes:
        quantity = self._quantities[state.quantity]
        return shaded(quantity.scale(quantity.values(rows, state.sensor)), self._surface.lightness[rows])


class ScanClouds:
    """The sensor's path, and the returns of one scan, measured in the colours of `scale` and predicted; `text` describes it."""

    def __init__(
        self, server: Any, radar_map: Map, scans: Scans, scale: Scale | None, text: Any, path_color: Any
    ) -> None:
        self._server, self._map, self._scans = server, radar_map, list(scans)
        self._scale, self._text = scale, text
        self._shown: int | None = None
        path = scans.sensor_poses[:, :3, 3] - radar_map.origin
        self.nodes: dict[str, Any] = {"trajectory": add_path(server, "/scans/path", path, path_color)}
        self.show(0)

    def show(self, index: int) -> None:
        if index == self._shown:
            return
        self._shown = index
        scan = self._scans[index]
        world, view = scan.world_points, self._map.render(scan.T_world_sensor)
        colors: Any = np.full((len(scan), 3), SCAN_COLORS["measured"], np.uint8)
        if scan.intensities is not None and self._scale is not None:
            colors = self._scale(np.asarray(scan.intensities, np.float64))
        predicted = np.full((len(view), 3), SCAN_COLORS["predicted"], np.uint8)
        with self._server.atomic():
            self._draw("measured", world, colors)
            self._draw("predicted", view.world_points, predicted)
        text = f"scan {index}: {len(scan)} returns measured, {len(view)} predicted"
        if scan.intensities is not None and self._map.has_intensity:
            found = self._map.intensity(world, scan.T_world_sensor[:3, 3], extrapolate=True)
            errors = np.abs(found - np.asarray(scan.intensities, np.float64))
            errors = errors[np.isfinite(errors)]
            text += f"; median error of the intensity {np.median(errors):.1f}" if errors.size else ""
        self._text.content = text

    def _draw(self, what: str, world: Floats, colors: Bytes) -> None:
        local = (world - self._map.origin).astype(np.float32)
        if what in self.nodes:
            self.nodes[what].points, self.nodes[what].colors = local, colors
            return
        shape, size_m = _STYLES[what]
        name = f"/scans/{what}"
        self.nodes[what] = add_cloud(self._server, name, local, colors, size_m, point_shape=shape)


def add_cloud(server: Any, name: str, points: Array, colors: Any, size_m: float, **style: Any) -> Any:
    """Add a cloud of points (N, 3), m, of one sRGB colour, or of colours (N, 3)."""
    values = points.astype(np.float32), np.full(points.shape, colors, np.uint8)
    return server.scene.add_point_cloud(name, *values, point_size=size_m, **_POINTS, **style)


def add_mesh(server: Any, mesh: Any, local: Floats, colors: Bytes) -> None:
    """Add a mesh in sRGB colours (V, 3), shaded by its normals, with its vertices at `local` (V, 3), m."""
    data = glb(local, mesh.faces, shaded(colors, lightness_of(mesh.vertex_normals)))
    server.scene.add_glb("/surface", data, cast_shadow=False, receive_shadow=False)


def add_path(server: Any, name: str, path: Array, color: tuple[int, int, int] | Bytes) -> Any:
    """Add a line through points (N, 3), m, to the scene, of one colour, or of the ends of each segment (N - 1, 2, 3)."""
    path = path.astype(np.float32)
    segments = np.stack([path[:-1], path[1:]], axis=1)
    return server.scene.add_line_segments(name, segments, color, thickness=3.0, thickness_units="screen")
