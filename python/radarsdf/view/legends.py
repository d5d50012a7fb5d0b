# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Legends and texts of a page's panels, as HTML."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

from radarsdf.view.quantities import Color, Colors, Quantity
from radarsdf.view.scene import PATH_COLOR, PREDICTED_COLOR


def legend(quantity: Quantity) -> str:
    """The colour scale of a quantity as HTML."""
    scale = quantity.scale
    if not isinstance(scale, Colors):
        return key(dict(reversed(list(zip(scale.names, scale.colors, strict=True)))))
    bar = f"height:0.8em;border-radius:0.2em;background:linear-gradient(to right,{_stops(scale)})"
    ends = "display:flex;justify-content:space-between;font-variant-numeric:tabular-nums"
    return _block(
        f'<div>{quantity.label}</div><div style="{bar}"></div>'
        f'<div style="{ends}"><span>{scale.low:.3g}</span><span>{scale.high:.3g}</span></div>'
    )


def marks(measured: Colors | Color) -> str:
    """How measured and predicted returns and the sensor's path are drawn, as HTML. `measured`: a scale, or one colour."""
    color, text = "", "measured"
    if isinstance(measured, Colors):
        color = f"linear-gradient(135deg,{_stops(measured)})"
        text += f", by intensity {measured.low:.3g} to {measured.high:.3g}"
    else:
        color = _css(measured)
    return _block(
        _mark(text, color, "border-radius:50%")
        + _mark(
            "predicted", _css(PREDICTED_COLOR), "transform:rotate(45deg);margin:0 0.15em", "0.5em", "0.5em"
        )
        + _mark("path of the sensor", _css(PATH_COLOR), height="0.2em")
    )


def key(colors: Mapping[str, Color]) -> str:
    """The meaning of fixed colours as HTML."""
    return _block("".join(_mark(name, _css(color), "border-radius:0.2em") for name, color in colors.items()))


def paragraph(text: str) -> str:
    """A text as HTML."""
    return _block(escape(text))


def table(rows: Mapping[str, str]) -> str:
    """Names and values as HTML."""
    cells = (f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows.items())
    return _block(f'<table style="border-spacing:0.6em 0">{"".join(cells)}</table>')


def _block(html: str) -> str:
    return f'<div style="margin:0.4em 0.8em;font-size:0.85em;line-height:1.4">{html}</div>'


def _mark(text: str, background: str, style: str = "", width: str = "0.8em", height: str = "0.8em") -> str:
    return (
        '<div style="display:flex;align-items:center;gap:0.5em">'
        f'<i style="flex:none;width:{width};height:{height};background:{background};{style}"></i>'
        f"<span>{escape(text)}</span></div>"
    )


def _stops(scale: Colors) -> str:
    return ",".join(map(_css, scale(np.linspace(scale.low, scale.high, 9)).tolist()))


def _css(color: Color) -> str:
    return "rgb({},{},{})".format(*color)
