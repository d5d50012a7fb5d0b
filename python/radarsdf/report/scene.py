# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The surface to be turned round: a page of its own, made by viser, for a frame of the report."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.view.framing import Look
from radarsdf.view.glb import glb
from radarsdf.view.page import begin_at
from radarsdf.view.serving import free_port, start_server, stop_server

_HOST = "127.0.0.1"
_PER_M = 1024  # steps of the vertices in a metre: numbers with fewer digits need a sixth less of the file
_SENSOR_COLOR = (0, 114, 178)
_POINT_SHARE = 0.008  # size of a point, as a share of the distance of the view
# Decoration, and the only address of another machine in the text of viser's page, though only as a name of XML.
_ICON = re.compile(r'<link\s+rel="icon".*?/>', re.DOTALL)


def scene_page(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    colors: NDArray[np.uint8],
    sensors: NDArray[np.float64] | None,
    look: Look,
) -> str:
    """HTML of a page that shows a mesh. It holds all that it needs.

    Parameters
    ----------
    vertices, faces, colors
        (V, 3) m in a frame near the origin, since they are drawn in float32; (F, 3); (V, 3) sRGB.
    sensors
        (F, 3) positions of the sensor in the same frame, which are drawn as points.
    look
        Where the view begins.

    Notes
    -----
    viser makes the page from the scene of a server. The server listens on this machine only, for less than a second.
    In viser's compressed program there are addresses of other machines, of its authors and of a decoder that this scene
    does not need. None is fetched, and the report's policy would forbid it.
    """
    server: Any = start_server(_HOST, free_port(_HOST, 0, exactly=True))
    try:
        rounded = np.round(vertices * _PER_M) / _PER_M
        server.scene.add_glb("/surface", glb(rounded, faces, colors), cast_shadow=False, receive_shadow=False)
        if sensors is not None:
            server.scene.add_point_cloud(
                "/sensor",
                sensors.astype(np.float32),
                _SENSOR_COLOR,
                point_size=_POINT_SHARE * float(np.linalg.norm(look.position - look.look_at)),
                point_shape="circle",
                precision="float32",
            )
        begin_at(server, look)
        document: str = server.get_scene_serializer().as_html()
    finally:
        stop_server(server)
    return _ICON.sub("", document)
