"""Pictures of the surface, and the 3D scene."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np

from radarsdf.arrays import Array, Bytes, Floats
from radarsdf.map.colors import NEUTRAL
from radarsdf.map.threshold import Threshold
from radarsdf.render.picture import eye_around, middle_of, render
from radarsdf.report.subject import Subject
from radarsdf.view.serving import framing_pose, free_port, set_initial_camera, start_server, stop_server
from radarsdf.view.surface import Scale, glb

_WIDTH, _HEIGHT = 1040, 650  # pixels
_SCENE_ASPECT = 8 / 5  # aspect ratio of its frame on any screen, see the style in page.html
_STEPS_PER_M = 1024  # vertices are rounded to multiples of 1 m / 1024: fewer digits save a sixth of the file
_SENSOR_COLOR = (0, 114, 178)
# The icon holds the only address of another machine in viser's page, though only as the name of an XML namespace.
_ICON = re.compile(r'<link\s+rel="icon".*?/>', re.DOTALL)
_FIRST_SIDE = (25.0, 36.0)
SIDES = {
    "One long side": _FIRST_SIDE,
    "Steeply from above": (0.0, 70.0),  # not straight down: walls would be lines
}
"""Azimuth and elevation of each view by name, degrees."""


def surface_values(subject: Subject) -> dict[str, Any] | None:
    """Values of the surface section, or None if there is no surface."""
    mesh, spacing_m = subject.shown
    if len(mesh.faces) == 0:
        return None
    colors, legend = colored(mesh, mesh.vertex_attributes.get("intensity"), "intensity, sensor units")
    origin = subject.radar_map.origin
    sensors = None if subject.scans is None else subject.scans.sensor_poses[:, :3, 3] - origin
    return {
        "scene": scene(np.asarray(mesh.vertices, np.float64) - origin, mesh.faces, colors, sensors),
        "sensors": sensors is not None,
        "legend": legend,
        "views": views(mesh, colors),
        "viewpoint": subject.viewpoint,
        "threshold": Threshold.of_mesh(subject.mesh.metadata),
        "triangles": len(subject.mesh.faces),
        "shown_triangles": len(mesh.faces),
        "spacing_m": spacing_m,
        "voxel_size_m": subject.voxel_size_m,
    }


def colored(
    mesh: Any, values: Array | None, label: str, scale: Scale | None = None
) -> tuple[Bytes, dict[str, Any] | None]:
    """Map values (V,) of the vertices to colours (V, 3), with a legend. NaN is grey, as is everything without values."""
    if values is None or not np.isfinite(values).any():
        return np.full((len(mesh.vertices), 3), NEUTRAL, np.uint8), None
    scale = scale or Scale.of(values)
    return scale(values), {"label": label, "scale": scale}


def colored_picture(mesh: Any, values: Array, label: str, scale: Scale) -> dict[str, Any]:
    """Render a mesh coloured by values (V,) of its vertices, and describe the colours."""
    colors, legend = colored(mesh, values, label, scale)
    return {"picture": picture(mesh, colors), "legend": legend}


def views(mesh: Any, colors: Bytes) -> dict[str, bytes]:
    """Render a mesh from each of :data:`SIDES`, by name."""
    return {name: picture(mesh, colors, *side) for name, side in SIDES.items()}


def picture(mesh: Any, colors: Bytes, turn_deg: float = 25.0, rise_deg: float = 36.0) -> bytes:
    """Render a mesh with vertex colours (V, 3), seen from :func:`eye_around`, as JPEG."""
    from PIL import Image  # noqa: PLC0415 - comes with matplotlib, an extra

    eye = eye_around(np.asarray(mesh.vertices, np.float64), turn_deg, rise_deg)
    pixels = render(mesh, colors, width=_WIDTH, height=_HEIGHT, viewpoint=eye)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="jpeg", quality=82, optimize=True)
    return file.getvalue()


def scene(vertices: Floats, faces: Array, colors: Bytes, sensors: Floats | None = None) -> str:
    """Export a self-contained HTML page that shows a mesh in 3D, made by viser.

    `vertices` (V, 3) and `sensors` (F, 3), drawn as points, are in m near the origin, since the page computes in
    float32. viser exports the scene of a server, which listens on this machine for less than a second. The addresses of
    other machines in its program are never used; the report's content security policy forbids fetching them.
    """
    everything = vertices if sensors is None else np.concatenate([vertices, sensors])
    to_eye = eye_around(vertices, *_FIRST_SIDE) - middle_of(vertices)[0]
    pose = framing_pose(everything, to_eye, _SCENE_ASPECT)
    host = "127.0.0.1"
    server: Any = start_server(host, free_port(host, 0))
    try:
        data = glb(np.round(vertices * _STEPS_PER_M) / _STEPS_PER_M, faces, colors)
        server.scene.add_glb("/surface", data, cast_shadow=False, receive_shadow=False)
        if sensors is not None:
            size = 0.008 * float(np.linalg.norm(pose.position - pose.look_at))
            style = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            server.scene.add_point_cloud("/sensor", sensors.astype(np.float32), _SENSOR_COLOR, **style)
        set_initial_camera(server, pose)
        document: str = server.get_scene_serializer().as_html()
    finally:
        stop_server(server)
    return _ICON.sub("", document)
