"""Simple pages: a growing surface, and the changes between two maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.changes.changes import COLORS, NAMES, Changes, Region, colors_of
from radarsdf.checks import check
from radarsdf.view.quantities import key, paragraph, table
from radarsdf.view.scene import add_path
from radarsdf.view.serving import Page, framing_pose, set_initial_camera
from radarsdf.view.surface import glb, lightness_of, shaded, thinned

if TYPE_CHECKING:
    import trimesh

_SURFACE_COLOR, _PATH_COLOR = (150, 160, 170), (0, 190, 255)
_MAX_VERTICES = 500_000
_MAX_LISTED = 12  # changes
_NOTES = {"unseen": ": not observed by the other map", "gone": ": of the earlier map"}
_NAMED_COLORS = [(NAMES[kind], color) for kind, color in sorted(COLORS.items(), reverse=True)]
MEANING = {name + _NOTES.get(name, ""): color for name, color in _NAMED_COLORS}
"""sRGB colour of each kind of change."""


def centre_of(region: Region) -> str:
    return "({:.1f}, {:.1f}, {:.1f}) m".format(*region.box.mean(axis=0))


class GrowingView(Page):
    """Serves the current surface and trajectory."""

    def __init__(self, **address: Any) -> None:
        super().__init__(**address)
        self._start()
        self._origin: Floats | None = None

    def show(self, mesh: trimesh.Trimesh, path: Floats) -> None:
        """Show a mesh and the sensor positions (F, 3), world, m, instead of the previous ones."""
        if len(mesh.faces) == 0:
            return
        vertices = np.asarray(mesh.vertices, np.float64)
        server = self._server
        if self._origin is None:  # origin of the page, which computes in float32
            self._origin = path[0].copy()
            set_initial_camera(server, framing_pose(vertices - self._origin))
        local, faces = (vertices - self._origin).astype(np.float32), np.asarray(mesh.faces, np.uint32)
        with server.atomic():
            style = {"color": _SURFACE_COLOR, "side": "double", "flat_shading": True}
            server.scene.add_mesh_simple("/surface", local, faces, **style)
            if len(path) > 1:
                add_path(server, "/path", path - self._origin, _PATH_COLOR)


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
