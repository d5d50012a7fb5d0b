# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The section of the surface: to be turned round, and from three sides."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.map.colors import NEUTRAL, intensity_colors
from radarsdf.map.threshold import Threshold
from radarsdf.render.picture import eye_around, middle_of, render
from radarsdf.report.page import Section, color_bar, frame, grid, image, note, paragraph
from radarsdf.report.scene import scene_page
from radarsdf.report.subject import Subject
from radarsdf.view.framing import Look, look_at_all

_WIDTH, _HEIGHT = 1040, 650  # pixels
_FRAME_ASPECT = 8 / 5  # of the frame of the 3D scene on any screen, as in the page's style
_JPEG_QUALITY = 82
SIDES = {
    "One long side": (25.0, 36.0),
    "The other long side": (205.0, 36.0),
    "Steeply from above": (0.0, 70.0),  # not straight: walls would be lines
}
"""Names of the sides, and turn and rise of each, degrees."""
HINT = (
    "Drag to turn it, scroll or pinch to come nearer, drag with the right button or two fingers to move it."
)
"""Below a scene."""


def surface_section(subject: Subject) -> Section:
    """The surface that is shown, coloured by intensity if the map has any."""
    mesh, spacing_m = subject.shown
    anchor, title = "surface", "Surface"
    if len(mesh.faces) == 0:
        return Section(anchor, title, [paragraph("The map has no surface here.")])
    values = mesh.vertex_attributes.get("intensity")
    colors, legend = colored(values, "intensity, sensor units")
    where = "(" + ", ".join(f"{x:.1f}" for x in subject.viewpoint) + ") m"
    painted = (
        f"coloured by the intensity predicted for a sensor at {where}" if values is not None else "in grey"
    )
    body = [
        frame(_scene(subject, colors), "The surface in three dimensions"),
        legend,
        note(HINT + (" Blue points are positions of the sensor." if subject.scans is not None else "")),
        from_all_sides(mesh, colors, f"The surface, {painted}."),
        paragraph(f"The surface is {painted}. Frame: world, with z up."),
        paragraph(f"It is {Threshold.of_mesh(subject.mesh.metadata)}."),
    ]
    if spacing_m != subject.voxel_size_m:
        body.append(
            note(
                f"Shown are {len(mesh.faces):,} triangles, with corners about {spacing_m:.3g} m apart. With the voxels of "
                f"{subject.voxel_size_m:g} m that all numbers of this page are of, there are "
                f"{len(subject.mesh.faces):,}: too many for a page that opens fast."
            )
        )
    return Section(anchor, title, body)


def colored(
    values: NDArray[Any] | None, label: str, limits: tuple[float, float] | None = None
) -> tuple[NDArray[np.uint8], str]:
    """Colours (V, 3) of values (V,) of vertices, and a legend in HTML. NaN is grey.

    `limits` None: the 2nd and the 98th percentile. `values` None: all are grey, and there is no legend.
    """
    if values is None or not np.isfinite(values).any():
        return np.full((0 if values is None else len(values), 3), NEUTRAL, np.uint8), ""
    low, high = np.nanpercentile(values, [2, 98]) if limits is None else limits
    steps = intensity_colors(np.linspace(0, 1, 9), 0, 1)[:, :3]
    bar = color_bar([(int(r), int(g), int(b)) for r, g, b in steps], f"{low:.3g}", f"{high:.3g}", label)
    return intensity_colors(values, float(low), float(high))[:, :3], bar


def from_all_sides(mesh: Any, colors: NDArray[np.uint8], text: str) -> str:
    """Pictures of a mesh from :data:`SIDES`; `text` says what they show."""
    return grid(
        *(image(picture(mesh, colors, side), f"{text} View: {side.lower()}.", f"{side}.") for side in SIDES)
    )


def first_look(points: NDArray[np.float64], vertices: NDArray[np.float64]) -> Look:
    """At all `points` (N, 3), from where the first picture of a mesh with these vertices (V, 3) is taken."""
    to_eye = eye_around(vertices, *SIDES["One long side"]) - middle_of(vertices)[0]
    return look_at_all(points, to_eye, _FRAME_ASPECT)


def picture(
    mesh: Any,
    colors: NDArray[np.uint8],
    side: str = "One long side",
    to_eye: NDArray[np.float64] | None = None,
) -> bytes:
    """A picture of a mesh as a JPEG file. Colours (V, 3) of its vertices; none, (0, 3): grey. `to_eye` (3,): from where, not a side."""
    from PIL import Image  # noqa: PLC0415 - comes with matplotlib, an extra

    vertices = np.asarray(mesh.vertices, np.float64)
    if to_eye is None:
        viewpoint = eye_around(vertices, *SIDES[side])
    else:
        middle, size_m = middle_of(vertices)
        viewpoint = middle + 2 * size_m * to_eye / np.linalg.norm(to_eye)
    pixels = render(mesh, colors if len(colors) else None, width=_WIDTH, height=_HEIGHT, viewpoint=viewpoint)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="jpeg", quality=_JPEG_QUALITY, optimize=True)
    return file.getvalue()


def _scene(subject: Subject, colors: NDArray[np.uint8]) -> str:
    mesh, _ = subject.shown
    origin = subject.radar_map.origin
    vertices = np.asarray(mesh.vertices, np.float64) - origin
    sensors = None if subject.scans is None else subject.scans.poses[:, :3, 3] - origin
    everything = vertices if sensors is None else np.concatenate([vertices, sensors])
    return scene_page(
        vertices,
        np.asarray(mesh.faces, np.int32),
        colors if len(colors) else np.full((len(vertices), 3), NEUTRAL, np.uint8),
        sensors,
        first_look(everything, vertices),
    )
