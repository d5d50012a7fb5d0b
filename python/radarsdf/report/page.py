"""Write pages from the templates in `templates/`, which hold all prose. Jinja escapes every value."""

from __future__ import annotations

import base64
import functools
import math
import time
from typing import Any

import jinja2

from radarsdf.checks import AnyPath
from radarsdf.extras import require
from radarsdf.io.files import write_whole
from radarsdf.view.pages import centre_of
from radarsdf.view.surface import css_color

_NBSP = "\N{NO-BREAK SPACE}"


def require_extras() -> None:
    """Raise an ImportError with the install command if matplotlib or viser is missing."""
    require("matplotlib", "viser", what="a report needs")


def write_page(path: AnyPath, template: str, **values: Any) -> int:
    """Fill a template and write the page atomically. Returns the size of the file, bytes."""
    made = time.strftime("%Y-%m-%d %H:%M")
    data = _environment().get_template(template).render(made=made, **values).encode()
    write_whole(path, data)
    return len(data)


def fixed(value: float, digits: int, unit: str = "") -> str:
    """Format a number with a fixed number of decimals and its unit."""
    return f"{value:,.{digits}f}" + (unit if unit in ("", "°") else _NBSP + unit)


def percent(share: float) -> str:
    return fixed(100 * share, 1, "%")


def data_uri(image: bytes) -> str:
    kind = "png" if image.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode('ascii')}"


@functools.cache
def _environment() -> jinja2.Environment:
    loader = jinja2.PackageLoader("radarsdf.report")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.undefined = jinja2.StrictUndefined
    environment.filters |= {own.__name__: own for own in (css_color, data_uri, fixed, math.degrees, percent)}
    environment.filters["centre"] = centre_of
    environment.filters["with_two_digits"] = lambda row: (row[0], *(fixed(value, 2) for value in row[1]))
    return environment
