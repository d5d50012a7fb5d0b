"""Pages in the browser: the viewer of a map, a growing surface, and the changes between two maps."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.changes.changes import COLORS, NAMES, Changes, Region, colors_of
from radarsdf.checks import check
from radarsdf.grids.grid import Grid
from radarsdf.map.colors import SHARES
from radarsdf.map.map import Map
from radarsdf.scans import Scan, Scans
from radarsdf.view.scene import SCAN_COLORS, Canvas, Painter, ScanClouds, State, add_cloud, add_mesh, add_path
from radarsdf.view.serving import CameraPose, Page, aim, framing_pose
from radarsdf.view.sinks import FREE_COLOR, PATH_COLOR, Sink, uncertainty_colors
from radarsdf.view.surface import UNCERTAINTY, ShownSurface, as_html, first_hit, quantities_of, thinned

_GIZMO_SHARE = 0.06  # size of the sensor's handles, as a share of the surface's diagonal
_MARK_SHARE = 0.012  # radius of a click's mark, as a share of its distance: of constant size on the screen
_MARK_COLOR = (0, 190, 255)  # not on the colour scale
_MAX_VERTICES = 500_000
_HELD_S = 2.0  # delay after which the mesh is drawn if the sensor does not move
_SLID_S = 0.25  # a slider reports no end of a drag: this pause marks one
_MAX_LISTED = 12  # changes
_NOTES = {"unseen": ": not observed by the other map", "gone": ": of the earlier map"}
_NAMED_COLORS = [(NAMES[kind], color) for kind, color in sorted(COLORS.items(), reverse=True)]
MEANING = {name + _NOTES.get(name, ""): color for name, color in _NAMED_COLORS}
"""sRGB colour of each kind of change."""


class Viewer(Page):
    """Serves a map, and scans to browse, in the browser until it is stopped.

    During a drag of the sensor, 30,000 vertices are recoloured; all of them are when it ends. The page computes in
    float32 in the map's local frame, but displays world coordinates. Shares `explained` (F,) colour the path. `voxel_size` and `wanted` are arguments of
    :meth:`Map.mesh`, with its errors.
    """

    def __init__(
        self,
        radar_map: Map,
        scans: Scans | None = None,
        *,
        voxel_size: float = 0.1,
        host: str = "127.0.0.1",
        port: int | None = None,
        explained: Floats | None = None,
        **wanted: Any,
    ) -> None:
        super().__init__(host, port)
        self._map = radar_map
        self.surface = ShownSurface.of(radar_map, voxel_size, max_vertices=_MAX_VERTICES, **wanted)
        self._start()
        try:
            self._fill(scans, explained)
        except BaseException:
            super().stop()
            raise

    def wait(self) -> None:
        """Wait until the viewer is stopped. Raises an error of the drawing thread."""
        self._painter.wait()

    def stop(self) -> None:
        self._painter.stop()
        super().stop()

    def _fill(self, scans: Scans | None, explained: Floats | None) -> None:
        server, radar_map, surface = self._server, self._map, self.surface
        origin = radar_map.origin
        path = np.zeros((0, 3)) if scans is None else scans.sensor_poses[:, :3, 3] - origin
        self._extent = np.concatenate([surface.vertices - origin, path])
        aim(server.initial_camera, framing_pose(self._extent))
        x, y, z = (origin if scans is None else scans.sensor_poses[0, :3, 3]).tolist()
        self.quantities = quantities_of(radar_map, surface, (x, y, z))  # choices of the surface's colour
        self._clicked: Floats | None = None
        panel = self._add_controls()
        self._clouds = None if scans is None else self._add_scans(panel, scans, explained)
        self._canvas = Canvas(server, radar_map, surface, self.quantities, self._clouds, self._describe)
        self._gizmo: Any = None
        if radar_map.has_intensity:
            self._add_sensor(np.array([x, y, z]) - origin)
        self._painter = Painter(self._canvas, State((x, y, z), **self._surface_state()))
        server.on_client_connect(self._on_connect)
        server.scene.on_click()(self._on_click)

    # Callbacks are coroutines, since viser would run functions in several threads, in any order.
    def _add_controls(self) -> Any:
        """Add the panels. A narrow screen shows the second one, which is returned, folded, to cover little of the map."""
        gui, surface = self._server.gui, self.surface
        self._legend = gui.add_html(as_html("legend", next(iter(self.quantities.values()))))
        self._quantity = gui.add_dropdown("colour by", tuple(self.quantities), hint="what the surface shows")
        hint = "Click on the surface to query the map. Drag the sensor by its arrows."
        self._answer = gui.add_html(as_html("paragraph", hint))
        reset = gui.add_button("Reset view")
        gui.main_panel.dock_right()
        panel = gui.add_panel()
        panel.dock_below(gui.main_panel)
        tab = panel.add_tab("controls")
        largest_m = float(np.nanmax(surface.uncertainty_m, initial=0.0))
        step_m = 10.0 ** math.floor(math.log10(max(largest_m, 1e-6) / 100))
        end_m = math.ceil(largest_m / step_m) * step_m
        with tab, gui.add_folder("surface"):
            hint = "hides surface with a larger standard error"
            self._uncertainty = gui.add_slider("uncertainty ≤ m", 0.0, end_m, step_m, end_m, hint=hint)
            hint = f"hides surface with a lower confidence; the mesh is {surface.threshold}"
            self._confidence = gui.add_slider("confidence ≥", 0.0, 1.0, 0.01, 0.0, hint=hint)

        async def on_limit(_: Any) -> None:
            self._painter.change(**self._surface_state(), coarse=False, settle_s=_SLID_S)

        async def on_quantity(_: Any) -> None:
            self._legend.content = as_html("legend", self.quantities[self._quantity.value])
            self._painter.change(**self._surface_state(), coarse=False, settle_s=0.0)

        async def on_reset(event: Any) -> None:
            self._frame_all(event.client)

        self._uncertainty.on_update(on_limit)
        self._confidence.on_update(on_limit)
        self._quantity.on_update(on_quantity)
        reset.on_click(on_reset)
        return tab

    def _add_scans(self, tab: Any, scans: Scans, explained: Floats | None) -> ScanClouds:
        gui = self._server.gui
        scale = self.quantities["intensity"].scale if self._map.has_intensity else None
        colors: dict[str, Any] = {**SCAN_COLORS, "measured": scale or SCAN_COLORS["measured"]}
        path_color: Any = colors["trajectory"]
        if explained is not None:
            colors["trajectory"], path_color = SHARES, SHARES(explained)[:-1, None].repeat(2, axis=1)
        with tab, gui.add_folder("scans"):
            gui.add_html(as_html("key", colors))
            slider = gui.add_slider("scan", 0, max(len(scans) - 1, 1), 1, 0, disabled=len(scans) == 1)
            clouds = ScanClouds(self._server, self._map, scans, scale, gui.add_markdown(""), path_color)
            boxes = {name: gui.add_checkbox(name, True) for name in colors}

        async def on_scan(_: Any) -> None:
            sensor = tuple(scans.sensor_poses[int(slider.value), :3, 3].tolist())
            if self._gizmo is not None:
                self._gizmo.position = tuple(np.array(sensor) - self._map.origin)
            self._painter.change(scan=int(slider.value), sensor=sensor, coarse=True, settle_s=_SLID_S)

        async def on_box(_: Any) -> None:
            for name, box in boxes.items():
                clouds.nodes[name].visible = box.value

        slider.on_update(on_scan)
        for box in boxes.values():
            box.on_update(on_box)
        return clouds

    def _surface_state(self) -> dict[str, Any]:
        """Fields of :class:`State` set by the controls of the surface. At its maximum, the slider sets no limit."""
        uncertainty_m = self._uncertainty.value
        max_uncertainty_m = math.inf if uncertainty_m >= self._uncertainty.max else float(uncertainty_m)
        limits = (max_uncertainty_m, float(self._confidence.value))
        return {"limits": limits, "quantity": str(self._quantity.value)}

    def _frame_all(self, client: Any) -> CameraPose:
        camera = client.camera
        pose = framing_pose(self._extent, aspect=_aspect(camera))
        with client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            aim(camera, pose)
        return pose

    async def _on_connect(self, client: Any) -> None:
        """Frame the whole scene in a new page, also after its frame has changed, until the user moves the camera."""
        first = framing_pose(self._extent)  # a page may apply this one after a better one
        aspect, pose = _aspect(client.camera), self._frame_all(client)

        async def on_update(camera: Any) -> None:
            nonlocal aspect, pose
            untouched = _is_at(camera, pose) and _aspect(camera) != aspect
            if untouched or (_is_at(camera, first) and not _is_at(camera, pose)):
                aspect, pose = _aspect(camera), self._frame_all(client)

        client.camera.on_update(on_update)

    def _add_sensor(self, position: Floats) -> None:
        scale = _GIZMO_SHARE * float(np.linalg.norm(np.ptp(self._extent, axis=0)))
        scene, limits = self._server.scene, ((-1e6, 1e6),) * 3
        handles = {"disable_rotations": True, "depth_test": False, "translation_limits": limits}
        self._gizmo = scene.add_transform_controls("/sensor", scale, **handles, position=tuple(position))
        scene.add_icosphere("/sensor/ball", scale / 8, (20, 20, 24))

        async def on_update(event: Any) -> None:
            sensor = self._map.origin + np.asarray(event.target.position, np.float64)
            moving = event.phase != "end"
            self._painter.change(sensor=tuple(sensor.tolist()), coarse=moving, settle_s=_HELD_S * moving)

        self._gizmo.on_update(on_update)

    def _on_click(self, event: Any) -> None:
        vertices = self.surface.vertices - self._map.origin
        point = first_hit(vertices, self._canvas.faces, event.ray_origin, event.ray_direction)
        if point is None:
            return
        self._clicked = point + self._map.origin
        away_m = float(np.linalg.norm(point - np.asarray(event.ray_origin)))
        radius_m = max(_MARK_SHARE * away_m, 0.5 * self.surface.spacing_m)
        self._server.scene.add_icosphere(
            "/clicked", radius_m, _MARK_COLOR, position=tuple(point), cast_shadow=False, receive_shadow=False
        )
        self._describe(self._painter.newest)

    def _describe(self, state: State) -> None:
        if self._clicked is None:
            return
        x, sensor = self._clicked[None], np.array(state.sensor)
        rows = {
            "position": "{:.3f}, {:.3f}, {:.3f} m".format(*self._clicked),
            "signed distance": f"{self._map.sdf(x)[0]:+.3f} m",
            "uncertainty": f"{self._map.uncertainty(x)[0]:.3f} m",
            "confidence": f"{self._map.confidence(x)[0]:.2f}",
        }
        if self._map.has_intensity:
            range_m = float(np.linalg.norm(self._clicked - sensor))
            rows["intensity"] = f"{self._map.intensity(x, sensor)[0]:.1f} from {range_m:.1f} m"
        self._answer.content = as_html("table", rows)


def _aspect(camera: Any) -> float:
    """Aspect ratio of a page's frame, clipped to what a screen can have."""
    return float(np.clip(camera.image_width / max(camera.image_height, 1), 0.1, 10.0))


def _is_at(camera: Any, pose: CameraPose) -> bool:
    return bool(np.allclose(camera.position, pose.position, atol=0.01))


def centre_of(region: Region) -> str:
    return "({:.1f}, {:.1f}, {:.1f}) m".format(*region.box.mean(axis=0))


class GrowingView(Page, Sink):
    """Serves the current surface, trajectory, scan and space."""

    def __init__(self, **address: Any) -> None:
        super().__init__(**address)
        self._start()
        self._legend = self._server.gui.add_html("")
        self._framed = False

    def show_scan(self, scan: Scan, time_s: float) -> None:  # noqa: ARG002
        world = np.concatenate([scan.T_world_sensor[None, :3, 3], scan.world_points])
        add_cloud(self._server, "/returns", self.local(world)[1:], SCAN_COLORS["measured"], 0.15)

    def show_surface(self, mesh: Any, path: Floats, time_s: float) -> None:  # noqa: ARG002
        local, server = self.local(mesh.vertices), self._server
        colors, scale = uncertainty_colors(mesh)
        if not self._framed:
            self._framed = True
            aim(server.initial_camera, framing_pose(local))
        with server.atomic():
            self._legend.content = as_html("legend", {"label": UNCERTAINTY, "scale": scale})
            add_mesh(server, mesh, local, colors)
            if len(path) > 1:
                add_path(server, "/path", self.local(path), PATH_COLOR)

    def show_grid(self, grid: Grid, time_s: float) -> None:  # noqa: ARG002
        free = self.local(grid.centres(grid.free))
        add_cloud(self._server, "/free space", free, FREE_COLOR, 0.2 * grid.voxel_size)


class ChangesView(Page):
    """Serves the coloured surface of :meth:`Changes.mesh`, whose vertices are `edge_m` apart, and lists its regions."""

    def __init__(self, changes: Changes, regions: Sequence[Region], edge_m: float, **address: Any) -> None:
        super().__init__(**address)
        mesh: Any = thinned(changes.mesh(), _MAX_VERTICES, edge_m)[0]
        check(len(mesh.faces), "the map has no surface here")
        vertices = np.asarray(mesh.vertices, np.float64)
        local = vertices - vertices.mean(axis=0)  # the page computes in float32
        self._start()
        server = self._server
        aim(server.initial_camera, framing_pose(local))
        add_mesh(server, mesh, local, colors_of(mesh.vertex_attributes["kind"]))
        listed = regions[:_MAX_LISTED]
        rows = {centre_of(region): f"{region.words}, {region.area_m2:.1f} m²" for region in listed}
        server.gui.add_html(as_html("key", MEANING))
        server.gui.add_html(as_html("paragraph", changes.report["alignment"]))
        server.gui.add_html(as_html("table", rows) if rows else as_html("paragraph", "Nothing changed."))
