"""Simple pages: a growing surface, and the changes between two maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.changes.changes import COLORS, NAMES, Changes, Region, colors_of
from radarsdf.checks import check
from radarsdf.grids.grid import Grid
from radarsdf.scans import Scan
from radarsdf.view.quantities import key, paragraph, table
from radarsdf.view.scene import POINTS, SCAN_COLORS, add_path
from radarsdf.view.serving import Page, framing_pose, set_initial_camera
from radarsdf.view.sinks import FREE_COLOR, PATH_COLOR, Sink, uncertainty_colors
from radarsdf.view.surface import glb, lightness_of, shaded, thinned

if TYPE_CHECKING:
    import trimesh

_MAX_VERTICES = 500_000
_MAX_LISTED = 12  # changes
_NOTES = {"unseen": ": not observed by the other map", "gone": ": of the earlier map"}
_NAMED_COLORS = [(NAMES[kind], color) for kind, color in sorted(COLORS.items(), reverse=True)]
MEANING = {name + _NOTES.get(name, ""): color for name, color in _NAMED_COLORS}
"""sRGB colour of each kind of change."""


def centre_of(region: Region) -> str:
    return "({:.1f}, {:.1f}, {:.1f}) m".format(*region.box.mean(axis=0))


class GrowingView(Page, Sink):
    """Serves the current surface, trajectory, scan and space."""

    def __init__(self, **address: Any) -> None:
        super().__init__(**address)
        self._start()
        self._framed = False

    def show_scan(self, scan: Scan, time_s: float) -> None:  # noqa: ARG002
        world = np.concatenate([scan.T_world_sensor[None, :3, 3], scan.world_points])
        self._add_points("/returns", self._local(world)[1:], SCAN_COLORS["measured"], 0.15)

    def show_surface(self, mesh: trimesh.Trimesh, path: Floats, time_s: float) -> None:  # noqa: ARG002
        local, server, shade = self._local(mesh.vertices), self._server, lightness_of(mesh.vertex_normals)
        if not self._framed:
            self._framed = True
            set_initial_camera(server, framing_pose(local))
        data = glb(local, mesh.faces, shaded(uncertainty_colors(mesh), shade))
        with server.atomic():
            server.scene.add_glb("/surface", data, cast_shadow=False, receive_shadow=False)
            if len(path) > 1:
                add_path(server, "/path", self._local(path), PATH_COLOR)

    def show_grid(self, grid: Grid, time_s: float) -> None:  # noqa: ARG002
        free = self._local(grid.centres(grid.free))
        self._add_points("/free space", free, FREE_COLOR, 0.2 * grid.voxel_size)

    def _add_points(self, name: str, local: Floats, color: Any, size_m: float) -> None:
        points, colors = local.astype(np.float32), np.full(local.shape, color, np.uint8)
        self._server.scene.add_point_cloud(name, points, colors, point_size=size_m, **POINTS)


class ChangesView(Page):
    """Serves the coloured surface of :meth:`Changes.mesh`, whose vertices are `edge_m` apart, and lists its regions."""

    def __init__(self, changes: Changes, regions: Sequence[Region], edge_m: float, **address: Any) -> None:
        super().__init__(**address)
        mesh: Any = thinned(changes.mesh(), _MAX_VERTICES, edge_m)[0]
        check(len(mesh.faces), "the map has no surface here")
        vertices = np.asarray(mesh.vertices, np.float64)
        local = vertices - vertices.mean(axis=0)  # the page computes in float32
        colors = shaded(colors_of(mesh.vertex_attributes["kind"]), lightness_of(mesh.vertex_normals))
        self._start()
        server = self._server
        set_initial_camera(server, framing_pose(local))
        data = glb(local, mesh.faces, colors)
        server.scene.add_glb("/surface", data, cast_shadow=False, receive_shadow=False)
        listed = regions[:_MAX_LISTED]
        rows = {centre_of(region): f"{region.words}, {region.area_m2:.1f} m²" for region in listed}
        server.gui.add_html(key(MEANING))
        server.gui.add_html(paragraph(changes.report["alignment"]))
        server.gui.add_html(table(rows) if rows else paragraph("Nothing changed."))
