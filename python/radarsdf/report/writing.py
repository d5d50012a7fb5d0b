"""Write reports from the templates in `templates/`, which hold all prose. Jinja escapes every value."""

from __future__ import annotations

import base64
import functools
import math
import time
from collections.abc import Sequence
from typing import Any

import jinja2
import numpy as np

from radarsdf.changes.changes import CHANGED, NAMES, Changes, Region, colors_of
from radarsdf.checks import AnyPath
from radarsdf.config.fit_config import FitConfig, flat_settings
from radarsdf.config.toml import to_toml
from radarsdf.extras import require
from radarsdf.io.files import write_whole
from radarsdf.report import sections
from radarsdf.report.sections import MAX_VERTICES, Subject, scene, views
from radarsdf.view.pages import MEANING, centre_of
from radarsdf.view.surface import css_color, thinned


def require_extras() -> None:
    """Raise an ImportError with the install command if matplotlib or viser is missing."""
    require("matplotlib", "viser", what="a report needs")


def write_report(path: AnyPath, subject: Subject) -> int:
    """Write a self-contained HTML page about a map atomically, and return its size, bytes. Needs matplotlib and viser."""
    require_extras()
    report = subject.radar_map.report
    settings, defaults = (flat_settings(of.to_dict()) for of in (subject.radar_map.config, FitConfig()))
    return _write_page(
        path,
        "report.html",
        subject=subject,
        report=report,
        fit_s=sum(value for name, value in report.items() if name.endswith("_s") and name != "skipped_s"),
        poses=sections.pose_values(report.get("poses")),
        surface=sections.surface_values(subject),
        errors=sections.error_values(subject),
        uncertainty=sections.uncertainty_values(subject),
        intensity=sections.intensity_values(subject),
        changed=[(n, value, defaults[n]) for n, value in settings.items() if value != defaults[n]],
        toml=to_toml(subject.radar_map.config),
    )


def write_changes_report(
    path: AnyPath, changes: Changes, names: tuple[str, str], edge_m: float, regions: Sequence[Region]
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
    values = {"report": changes.report, "regions": regions, "kinds": [NAMES[kind] for kind in CHANGED]}
    return _write_page(path, "changes.html", names=names, surface=surface, key=MEANING, **values)


def _write_page(path: AnyPath, template: str, **values: Any) -> int:
    """Fill a template and write the page atomically. Returns the size of the file, bytes."""
    made = time.strftime("%Y-%m-%d %H:%M")
    data = _environment().get_template(template).render(made=made, **values).encode()
    write_whole(path, data)
    return len(data)


def fixed(value: float, digits: int, unit: str = "") -> str:
    """Format a number with a fixed number of decimals and its unit."""
    return f"{value:,.{digits}f}" + (unit if unit in ("", "°") else "\N{NO-BREAK SPACE}" + unit)


def percent(share: float) -> str:
    return fixed(100 * share, 1, "%")


def data_uri(image: bytes) -> str:
    kind = "png" if image.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode('ascii')}"


@functools.cache
def _environment() -> jinja2.Environment:
    options: dict[str, Any] = {
        "trim_blocks": True,
        "lstrip_blocks": True,
        "undefined": jinja2.StrictUndefined,
    }
    loader, extensions = jinja2.PackageLoader("radarsdf.report"), ["jinja2.ext.do"]
    environment = jinja2.Environment(loader=loader, autoescape=True, extensions=extensions, **options)
    filters = (centre_of, css_color, data_uri, fixed, math.degrees, percent)
    environment.filters |= {own.__name__: own for own in filters}
    return environment
