# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The report of what changed between two maps."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np

from radarsdf.changes.changes import CHANGED, NAMES, Changes, Region, colors_of
from radarsdf.render.picture import middle_of
from radarsdf.report.page import require_extras, write_page
from radarsdf.report.subject import MAX_VERTICES
from radarsdf.report.surface import jpeg, scene, views
from radarsdf.view.pages import MEANING, centre_of
from radarsdf.view.surface import thinned

_MAX_LISTED = 50
_MAX_PICTURED = 6
_MARGIN_M = 2.5  # around a pictured change
_RISE = 0.8  # of the viewpoint of a picture, over its horizontal distance


def write_changes_report(
    path: str | PathLike[str],
    changes: Changes,
    names: tuple[str, str],
    edge_m: float,
    regions: Sequence[Region],
) -> int:
    """Write a self-contained HTML page about what changed, whole or not at all, and return its size, bytes.

    `names`: of the earlier and the later map. `edge_m`: vertex spacing of their surfaces. `regions`: the changes to
    list, largest first. Raises an ImportError if matplotlib or viser is missing, an OSError if the file cannot be written.
    """
    require_extras()
    mesh: Any = thinned(changes.mesh(), MAX_VERTICES, edge_m)[0]
    surface = None
    if len(mesh.faces):
        colors = colors_of(mesh.vertex_attributes["kind"])
        vertices = np.asarray(mesh.vertices, np.float64)
        surface = {
            "scene": scene(vertices - vertices.mean(axis=0), mesh.faces, colors),
            "views": views(mesh, colors),
        }
    return write_page(
        path,
        "changes.html",
        names=names,
        report=changes.report,
        surface=surface,
        key=MEANING,
        pictures=_pictures(mesh, regions[:_MAX_PICTURED]),
        regions=regions,
        kinds=[NAMES[kind] for kind in CHANGED],
        max_listed=_MAX_LISTED,
    )


def _pictures(mesh: Any, regions: Sequence[Region]) -> dict[str, bytes]:
    """Close-ups of changes by their captions."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    kinds = mesh.vertex_attributes["kind"] if len(faces) else np.zeros(0, np.int8)
    numbers = {name: number for number, name in NAMES.items()}
    pictures = {}
    for number, region in enumerate(regions, 1):
        low, high = region.box[0] - _MARGIN_M, region.box[1] + _MARGIN_M
        inside = ((vertices >= low) & (vertices <= high)).all(axis=1)
        near = np.flatnonzero(inside[faces].all(axis=1))
        if len(near) == 0:  # a part of the surface that thinning removed
            continue
        part = mesh.submesh([near], append=True, repair=False)
        changed = near[(kinds[faces[near]] == numbers[region.kind]).any(axis=1)]
        # From the side that the change faces: behind it there may be a wall.
        facing = (mesh.face_normals[changed] * mesh.area_faces[changed, None]).sum(axis=0)
        facing[2] = 0.0
        to_eye = facing / max(float(np.linalg.norm(facing)), 1e-9) + [0.0, 0.0, _RISE]
        middle, size_m = middle_of(np.asarray(part.vertices, np.float64))
        viewpoint = middle + 2 * size_m * to_eye / np.linalg.norm(to_eye)
        caption = f"{number}: {region.words}, {region.area_m2:.1f} m², at {centre_of(region)}"
        pictures[caption] = jpeg(part, colors_of(kinds[np.unique(faces[near])]), viewpoint)
    return pictures
