# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A page that shows what changed between two maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from radarsdf.changes.changes import COLORS, NAMES, Changes, Region, colors_of
from radarsdf.view.framing import look_at_all
from radarsdf.view.glb import glb
from radarsdf.view.legends import key, paragraph, table
from radarsdf.view.light import shaded
from radarsdf.view.page import Page, begin_at
from radarsdf.view.surface import lightness_of
from radarsdf.view.thinning import thinned

MEANING = {
    NAMES[kind]
    + {"unseen": ": the other map does not tell", "gone": ": of the earlier map"}.get(NAMES[kind], ""): color
    for kind, color in sorted(COLORS.items(), reverse=True)
}
"""What the colours mean, and what they are: sRGB."""
_MOST_VERTICES = 500_000
_LISTED = 12  # changes, the largest first


class ChangesView(Page):
    """Serves the coloured surface of :meth:`Changes.mesh` with a legend, until it is stopped.

    Parameters
    ----------
    changes : Changes
        What :func:`radarsdf.compare` found.
    regions : sequence of Region
        Changes that are listed.
    edge_m : float
        How far apart the vertices of its surfaces are, m: the edge of the maps' leaf cells.
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
    ValueError
        If there is no surface.
    """

    def __init__(
        self,
        changes: Changes,
        regions: Sequence[Region],
        edge_m: float,
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
    ) -> None:
        super().__init__(host, port)
        mesh: Any = thinned(changes.mesh(), _MOST_VERTICES, edge_m)[0]
        if len(mesh.faces) == 0:
            msg = "there is no surface here"
            raise ValueError(msg)
        vertices = np.asarray(mesh.vertices, np.float64)
        middle = vertices.mean(axis=0)  # of the page, which is in float32
        local = vertices - middle
        lightness = lightness_of(np.asarray(mesh.vertex_normals, np.float64))
        data = glb(
            local.astype(np.float32),
            np.asarray(mesh.faces, np.int32),
            shaded(colors_of(mesh.vertex_attributes["kind"]), lightness),
        )
        self._start()
        server = self._server
        begin_at(server, look_at_all(local))
        server.scene.add_glb("/surface", data, cast_shadow=False, receive_shadow=False)
        server.gui.add_html(key(MEANING))
        server.gui.add_html(paragraph(changes.report["alignment"]))
        rows = {place_of(region): f"{region.words}, {region.area_m2:.1f} m²" for region in regions[:_LISTED]}
        server.gui.add_html(table(rows) if rows else paragraph("Nothing changed."))


def place_of(region: Region) -> str:
    """Where a change is, world, m."""
    return "({:.1f}, {:.1f}, {:.1f}) m".format(*region.box.mean(axis=0))
