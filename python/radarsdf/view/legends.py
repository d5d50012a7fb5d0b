# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the colours and the marks of the page mean, as HTML."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

from radarsdf.view.quantities import Classes, Colors, Quantity

_STOPS = 9
_BLOCK = '<div style="margin:0.4em 0.8em;font-size:0.85em;line-height:1.4">{}</div>'
_ENDS = (
    '<div style="display:flex;justify-content:space-between;font-variant-numeric:tabular-nums">'
    "<span>{low:.3g}</span><span>{high:.3g}</span></div>"
)
_MARK = (
    '<div style="display:flex;align-items:center;gap:0.5em"><i style="flex:none;width:{width};height:{height};'
    'background:{color};{shape}"></i><span>{text}</span></div>'
)
_DIAMOND = "transform:rotate(45deg);margin:0 0.15em"


def legend(quantity: Quantity) -> str:
    """The scale of a quantity, with its ends and its unit."""
    scale = quantity.scale
    if isinstance(scale, Colors):
        return _BLOCK.format(
            f"<div>{quantity.label}</div>{_bar(scale)}{_ENDS.format(low=scale.low, high=scale.high)}"
        )
    return _BLOCK.format("".join(_patches(scale)))


def marks(
    measured: Colors | tuple[int, int, int], predicted: tuple[int, int, int], path: tuple[int, int, int]
) -> str:
    """How measured and predicted returns and the path of the sensor are drawn. `measured`: a scale, or one colour."""
    if isinstance(measured, Colors):
        color = f"linear-gradient(135deg,{_stops(measured)})"
        text = f"measured, by intensity {measured.low:.3g} to {measured.high:.3g}"
    else:
        color, text = _rgb(measured), "measured"
    return _BLOCK.format(
        _MARK.format(width="0.8em", height="0.8em", color=color, shape="border-radius:50%", text=text)
        + _MARK.format(width="0.5em", height="0.5em", color=_rgb(predicted), shape=_DIAMOND, text="predicted")
        + _MARK.format(width="0.8em", height="0.2em", color=_rgb(path), shape="", text="path of the sensor")
    )


def key(colors: Mapping[str, tuple[int, int, int]]) -> str:
    """What fixed colours mean."""
    return _BLOCK.format("".join(_patch(name, color) for name, color in colors.items()))


def paragraph(text: str) -> str:
    """A text."""
    return _BLOCK.format(escape(text))


def table(rows: Mapping[str, str]) -> str:
    """Names and values, one below the other."""
    cells = (f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows.items())
    return _BLOCK.format(f'<table style="border-spacing:0.6em 0">{"".join(cells)}</table>')


def _patches(classes: Classes) -> list[str]:
    return [
        _patch(name, color)
        for name, color in zip(reversed(classes.names), reversed(classes.colors), strict=True)
    ]


def _patch(name: str, color: tuple[int, int, int]) -> str:
    return _MARK.format(
        width="0.8em", height="0.8em", color=_rgb(color), shape="border-radius:0.2em", text=escape(name)
    )


def _bar(scale: Colors) -> str:
    return f'<div style="height:0.8em;border-radius:0.2em;background:linear-gradient(to right,{_stops(scale)})"></div>'


def _stops(scale: Colors) -> str:
    return ",".join(map(_rgb, scale(np.linspace(scale.low, scale.high, _STOPS)).tolist()))


def _rgb(color: tuple[int, int, int]) -> str:
    return "rgb({},{},{})".format(*color)
