# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A page about what changed between two maps."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np

from radarsdf.changes.changes import CHANGED, NAMES, Changes, Region, colors_of
from radarsdf.report.extras import require_extras
from radarsdf.report.page import (
    Section,
    Sentence,
    color_key,
    frame,
    grid,
    image,
    items,
    note,
    paragraph,
    table,
    write_page,
)
from radarsdf.report.scene import scene_page
from radarsdf.report.subject import MOST_VERTICES
from radarsdf.report.surface import HINT, first_look, from_all_sides, picture
from radarsdf.view.changed import MEANING, place_of
from radarsdf.view.thinning import thinned

_LISTED = 50  # changes, the largest first
_PICTURED = 6
_AROUND_M = 2.5  # what is shown round a change
_RISE = 0.8  # of the eye, over its distance along the ground
_NUMBERS = {name: number for number, name in NAMES.items()}
_IN_WORDS = {
    "appeared": "is on the later surface alone: rays of the earlier drive passed the place",
    "gone": "is on the earlier surface alone: rays of the later drive passed the place",
    "moved": "is elsewhere along its normal",
    "repainted": "is where it was, but its returns are stronger or weaker",
}


def write_changes_report(
    path: str | PathLike[str],
    changes: Changes,
    names: tuple[str, str],
    edge_m: float,
    regions: Sequence[Region],
) -> int:
    """Write a page about what changed, whole or not at all. It holds all that it shows.

    Parameters
    ----------
    path : path-like
        The HTML file. An old file is replaced once the new one is complete.
    changes : Changes
        What :func:`radarsdf.compare` found.
    names : tuple
        Of the earlier and the later map.
    edge_m : float
        How far apart the vertices of their surfaces are, m.
    regions : sequence of Region
        Changes that are listed, the largest first.

    Returns
    -------
    int
        Size of the file, bytes.

    Raises
    ------
    ImportError
        If matplotlib or viser is missing.
    OSError
        If the file cannot be written.
    """
    require_extras()
    mesh: Any = thinned(changes.mesh(), MOST_VERTICES, edge_m)[0]
    facts = [("Compared", f"{changes.report['compared_m2']:,.0f} m²")]
    facts += [(name.capitalize(), f"{area:,.1f} m²") for name, area in changes.report["areas_m2"].items()]
    sections = [_conclusion(changes, regions), _surface(mesh), _list(regions)]
    if regions and len(mesh.faces):
        sections.insert(2, _pictures(mesh, regions))
    return write_page(path, f"{names[0]} and {names[1]}: what changed", "compare", facts, sections)


def _conclusion(changes: Changes, regions: Sequence[Region]) -> Section:
    """What changed, in words."""
    found = [Sentence("note", "Frames", changes.report["alignment"])]
    areas_m2 = changes.report["areas_m2"]
    for kind in (NAMES[kind] for kind in CHANGED):
        own = [region for region in regions if region.kind == kind]
        if not own:
            continue
        places = "one place" if len(own) == 1 else f"{len(own)} places"
        text = f"{areas_m2[kind]:.1f} m² in {places}, the largest round {place_of(own[0])}. It {_IN_WORDS[kind]}."
        found.append(Sentence("warning", kind.capitalize(), text))
    if len(found) == 1:
        found.append(Sentence("good", "Changes", "No place changed that is large enough to be listed."))
    found.append(Sentence("note", "Reflectance", changes.report["reflectance"]))
    seen = "What the other drive did not look at is unseen, not gone."
    return Section("conclusion", "Conclusion", [items([*found, Sentence("note", "Unseen", seen)])])


def _surface(mesh: Any) -> Section:
    """All of it, to be turned round, and from three sides."""
    if len(mesh.faces) == 0:
        return Section("surface", "Surface", [paragraph("There is no surface here.")])
    vertices, colors = np.asarray(mesh.vertices, np.float64), colors_of(mesh.vertex_attributes["kind"])
    local = vertices - vertices.mean(axis=0)
    scene = scene_page(local, np.asarray(mesh.faces, np.int32), colors, None, first_look(local, local))
    body = [
        frame(scene, "What changed, in three dimensions"),
        color_key(MEANING),
        note(HINT),
        from_all_sides(mesh, colors, "What changed."),
        paragraph(
            "The later surface, and of the earlier one what is gone or moved. Frame: world of the earlier map, with z up."
        ),
    ]
    return Section("surface", "Surface", body)


def _pictures(mesh: Any, regions: Sequence[Region]) -> Section:
    """The largest changes from nearby."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    colors = colors_of(mesh.vertex_attributes["kind"])
    found = []
    for number, region in enumerate(regions[:_PICTURED], 1):
        inside = ((vertices >= region.box[0] - _AROUND_M) & (vertices <= region.box[1] + _AROUND_M)).all(
            axis=1
        )
        chosen = np.flatnonzero(inside[faces].all(axis=1))
        if len(chosen) == 0:  # a part of a surface that was thinned away
            continue
        part = mesh.submesh([chosen], append=True, repair=False)
        rows = np.unique(faces[chosen])
        kinds = mesh.vertex_attributes["kind"][faces[chosen]]
        own = (kinds == _NUMBERS[region.kind]).any(axis=1)
        facing = np.einsum("ni,n->i", mesh.face_normals[chosen][own], mesh.area_faces[chosen][own])
        facing[2] = 0.0
        # From the side that the change shows: behind it may be a wall.
        to_eye = facing / max(float(np.linalg.norm(facing)), 1e-9) + [0.0, 0.0, _RISE]
        text = f"{number}: {region.words}, {region.area_m2:.1f} m², round {place_of(region)}"
        found.append(image(picture(part, colors[rows], to_eye=to_eye), text, text))
    return Section("places", "The largest changes", [color_key(MEANING), grid(*found)])


def _list(regions: Sequence[Region]) -> Section:
    """A table of changes."""
    if not regions:
        return Section("changes", "Changes", [paragraph("Nothing changed.")])
    rows = [
        (
            str(number),
            region.words,
            place_of(region),
            " × ".join(f"{length:.1f}" for length in np.ptp(region.box, axis=0)),
            f"{region.area_m2:.2f}",
            f"{region.probability:.2f}",
        )
        for number, region in enumerate(regions[:_LISTED], 1)
    ]
    header = ["", "change", "middle, world", "size, m", "area, m²", "probability"]
    body = [table("Changes that hang together, the largest first", header, rows)]
    if len(regions) > _LISTED:
        body.append(note(f"{len(regions) - _LISTED} smaller ones are not listed."))
    return Section("changes", "Changes", body)
