# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The panels of a viewer's page: legends, texts, sliders and check boxes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from html import escape
from typing import Any

import numpy as np

from radarsdf.view.quantities import Color, Colors, Quantity
from radarsdf.view.scene import (
    MEASURED_COLOR,
    PATH_COLOR,
    PREDICTED_COLOR,
    SLID_S,
    Canvas,
    Painter,
    ScanClouds,
)
from radarsdf.view.surface import ShownSurface

_STEPS = 100  # of a slider


class Controls:
    """The controls. A narrow screen shows their second panel folded, so that little covers the map.

    `measured`: the scale of measured intensities, if there are any. `scans`: their number.
    """

    def __init__(
        self,
        server: Any,
        surface: ShownSurface,
        quantities: Mapping[str, Quantity],
        measured: Colors | None,
        scans: int = 0,
    ) -> None:
        gui = server.gui
        self._quantities = quantities
        self._legend = gui.add_html(legend(next(iter(quantities.values()))))
        self._quantity = gui.add_dropdown("colour by", tuple(quantities), hint="what the surface shows")
        self._click = gui.add_html(
            paragraph("Click on the surface to query the map. Drag the sensor by its arrows.")
        )
        self._reset = gui.add_button("Reset view")
        gui.main_panel.dock_right()
        panel = gui.add_panel()
        panel.dock_below(gui.main_panel)
        with panel.add_tab("controls"):
            with gui.add_folder("surface"):
                largest_m = float(surface.uncertainty_m.max())
                step_m = 10.0 ** math.floor(math.log10(max(largest_m, 1e-6) / _STEPS))
                end_m = math.ceil(largest_m / step_m) * step_m
                self._surface = gui.add_checkbox("show", True)
                self._uncertainty = gui.add_slider(
                    "uncertainty ≤ m", 0.0, end_m, step_m, end_m, hint="hides what is more uncertain"
                )
                hint = f"hides what is less probable; the mesh is {surface.threshold}"
                self._confidence = gui.add_slider("confidence ≥", 0.0, 1.0, 1 / _STEPS, 0.0, hint=hint)
            if scans:
                with gui.add_folder("scans"):
                    gui.add_html(marks(measured or MEASURED_COLOR))
                    self._scan = gui.add_slider("scan", 0, max(scans - 1, 1), 1, 0, disabled=scans == 1)
                    self._scan_text = gui.add_markdown("")
                    self._layers = {
                        "measured": gui.add_checkbox("measured", True),
                        "predicted": gui.add_checkbox(
                            "predicted", True, hint="returns that the map predicts for this scan"
                        ),
                        "all": gui.add_checkbox("all scans", False),
                    }
                    self._path = gui.add_checkbox("trajectory", True)

    def state(self) -> dict[str, Any]:
        """The fields of :class:`State` that the controls set."""
        return {
            "max_uncertainty_m": float(self._uncertainty.value),
            "min_confidence": float(self._confidence.value),
            "quantity": str(self._quantity.value),
        }

    def connect(
        self,
        painter: Painter,
        canvas: Canvas,
        clouds: ScanClouds | None,
        go_to_scan: Callable[[int], None],
        reset_view: Callable[[Any], object],
    ) -> None:
        """Connect the controls with what they change. `reset_view` gets the client that asked for it."""

        # Coroutines, because viser would run functions in several threads, in any order.
        async def on_limit(_: Any) -> None:
            painter.change(**self.state(), coarse=False, settle_s=SLID_S)

        async def on_quantity(_: Any) -> None:
            self._legend.content = legend(self._quantities[self._quantity.value])
            painter.change(**self.state(), coarse=False, settle_s=0.0)

        async def on_surface(_: Any) -> None:
            canvas.node.visible = self._surface.value

        async def on_reset(event: Any) -> None:
            reset_view(event.client)

        self._uncertainty.on_update(on_limit)
        self._confidence.on_update(on_limit)
        self._quantity.on_update(on_quantity)
        self._surface.on_update(on_surface)
        self._reset.on_click(on_reset)
        if clouds is None:
            return

        async def on_scan(_: Any) -> None:
            go_to_scan(int(self._scan.value))

        async def on_path(_: Any) -> None:
            clouds.path.visible = self._path.value

        def on_layer(event: Any) -> None:  # in a thread: all scans take a while
            for name, box in self._layers.items():
                if box is event.target:
                    clouds.set_visible(name, visible=box.value)

        self._scan.on_update(on_scan)
        self._path.on_update(on_path)
        for box in self._layers.values():
            box.on_update(on_layer)

    def describe_scan(self, text: str) -> None:
        """Show a text about the scan."""
        self._scan_text.content = text

    def describe_click(self, rows: Mapping[str, str]) -> None:
        """Show names and values of the point that was clicked."""
        self._click.content = table(rows)


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
