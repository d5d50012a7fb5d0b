"""The report on changes between two maps."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np

from radarsdf.changes.changes import CHANGED, NAMES, Changes, Region, colors_of
from radarsdf.report.page import fixed, require_extras, write_page
from radarsdf.report.subject import MAX_VERTICES
from radarsdf.report.surface import scene, views
from radarsdf.view.pages import MEANING, centre_of
from radarsdf.view.surface import thinned

_MAX_LISTED = 50


def write_changes_report(
    path: str | PathLike[str],
    changes: Changes,
    names: tuple[str, str],
    edge_m: float,
    regions: Sequence[Region],
) -> int:
    """Write a self-contained HTML page about changes atomically, and return its size, bytes.

    `names`: of the earlier and the later map. `edge_m`: vertex spacing of their surfaces. `regions`: the changes to
    list, largest first. Raises an ImportError if matplotlib or viser is missing, an OSError if the file cannot be written.
    """
    require_extras()
    mesh: Any = thinned(changes.mesh(), MAX_VERTICES, edge_m)[0]
    surface = None
    if len(mesh.faces):
        colors = colors_of(mesh.vertex_attributes["kind"])
        vertices = np.asarray(mesh.vertices, np.float64)
        local = vertices - vertices.mean(axis=0)
        surface = {"scene": scene(local, mesh.faces, colors), "views": views(mesh, colors)}
    rows = []
    for number, region in enumerate(regions[:_MAX_LISTED], 1):
        size = "{:.1f} × {:.1f} × {:.1f}".format(*(region.box[1] - region.box[0]))
        numbers = fixed(region.area_m2, 2), fixed(region.probability, 2)
        rows.append((number, region.words, centre_of(region), size, *numbers))
    values = {"report": changes.report, "regions": regions, "rows": rows, "max_listed": _MAX_LISTED}
    kinds = [NAMES[kind] for kind in CHANGED]
    return write_page(path, "changes.html", names=names, surface=surface, key=MEANING, kinds=kinds, **values)
