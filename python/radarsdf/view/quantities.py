"""Quantities that can colour the surface, and legends as HTML."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from radarsdf.arrays import Array, Bytes, Ints
from radarsdf.map.colors import intensity_colors
from radarsdf.map.map import Map
from radarsdf.view.surface import ShownSurface

Color = tuple[int, int, int]
Position = tuple[float, float, float]

_SAMPLES = 30_000  # vertices from which the intensity limits are estimated


@dataclass(frozen=True)
class Scale:
    """A fixed scale of sRGB colours from `low` to `high`; NaN is grey."""

    low: float
    high: float

    @classmethod
    def of(cls, values: Array) -> Scale:
        """Build from the 2nd and the 98th percentile of values (N,)."""
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, [2, 98]) if len(known) else (0.0, 1.0)
        return cls(float(low), float(high))

    def __call__(self, values: Array) -> Bytes:
        """(N, 3) sRGB of values (N,)."""
        return intensity_colors(values, self.low, self.high)[:, :3]

    @property
    def css(self) -> str:
        """The colours from low to high, as CSS."""
        return ",".join(map(css_color, intensity_colors(np.linspace(0, 1, 9), 0, 1)[:, :3].tolist()))


@dataclass(frozen=True)
class Quantity:
    label: str  # name and unit
    values: Callable[[Ints, Position], Array]  # (N,) of vertices (N,), for a sensor at a position
    scale: Scale
    of_sensor: bool = False  # whether it depends on the sensor position

    def colors(self, rows: Ints, sensor: Position) -> Bytes:
        """(N, 3) sRGB of vertices (N,)."""
        return self.scale(self.values(rows, sensor))


def quantities_of(radar_map: Map, surface: ShownSurface, sensor: Position) -> dict[str, Quantity]:
    """Quantities by name, the default first. The intensity scale is that for the first `sensor` position."""
    vertices, found = surface.vertices, {}

    def intensity(rows: Ints, sensor: Position) -> Array:
        return radar_map.intensity(vertices[rows], np.array(sensor))

    if radar_map.has_intensity:
        some = np.arange(0, len(vertices), max(1, len(vertices) // _SAMPLES))
        scale = Scale.of(intensity(some, sensor))
        found["intensity"] = Quantity("predicted intensity, sensor units", intensity, scale, of_sensor=True)
    of_vertices: dict[str, tuple[str, Array]] = {
        "uncertainty": ("uncertainty (standard error), m", surface.uncertainty_m),
        "confidence": ("confidence (probability)", surface.confidence),
        "height": ("height, m", vertices[:, 2]),
    }
    for name, (label, values) in of_vertices.items():
        scale = Scale(0.0, 1.0) if name == "confidence" else Scale.of(values)
        found[name] = Quantity(label, lambda rows, _, values=values: values[rows], scale)  # type: ignore[misc]
    return found


def legend(quantity: Quantity) -> str:
    scale = quantity.scale
    bar = f"height:0.8em;border-radius:0.2em;background:linear-gradient(to right,{scale.css})"
    ends = "display:flex;justify-content:space-between;font-variant-numeric:tabular-nums"
    limits = f"<span>{scale.low:.3g}</span><span>{scale.high:.3g}</span>"
    return _block(f'<div>{quantity.label}</div><div style="{bar}"></div><div style="{ends}">{limits}</div>')


def key(colors: Mapping[str, Color | Scale]) -> str:
    """Format the meaning of colours and scales as HTML."""
    rows = []
    for name, color in colors.items():
        limits = ""
        if isinstance(color, Scale):
            background = f"linear-gradient(135deg,{color.css})"
            limits = f", {color.low:.3g} to {color.high:.3g}"
        else:
            background = css_color(color)
        mark = f"flex:none;width:0.8em;height:0.8em;border-radius:0.2em;background:{background}"
        words = f'<i style="{mark}"></i><span>{escape(name)}{limits}</span>'
        rows.append(f'<div style="display:flex;align-items:center;gap:0.5em">{words}</div>')
    return _block("".join(rows))


def paragraph(text: str) -> str:
    return _block(escape(text))


def table(rows: Mapping[str, str]) -> str:
    cells = (f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows.items())
    return _block(f'<table style="border-spacing:0.6em 0">{"".join(cells)}</table>')


def _block(html: str) -> str:
    return f'<div style="margin:0.4em 0.8em;font-size:0.85em;line-height:1.4">{html}</div>'


def css_color(color: Sequence[int]) -> str:
    return "rgb({} {} {})".format(*color)
