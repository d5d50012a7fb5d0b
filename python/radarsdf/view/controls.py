# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Sliders, check boxes and texts of the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from radarsdf.view.canvas import Colors, SurfaceCanvas
from radarsdf.view.painter import SLID_S, Painter
from radarsdf.view.surface import Surface
from radarsdf.view.walk import Walk

_STEPS = 100
_LEGEND = """<div style="margin:0.4em 0.8em;font-size:0.85em">
<div style="height:0.8em;border-radius:0.2em;background:linear-gradient(to right,{stops})"></div>
<div style="display:flex;justify-content:space-between"><span>{low:.1f}</span><span>predicted intensity</span>
<span>{high:.1f}</span></div></div>"""


class Controls:
    """The panel of the page.

    Parameters
    ----------
    server
        The viser server.
    surface
        What is shown: it gives the range of the sliders.
    colors
        The scale of the intensities, if there are any.
    scans
        The number of scans to walk through.
    """

    def __init__(self, server: Any, surface: Surface, colors: Colors | None, scans: int = 0) -> None:
        gui = server.gui
        if colors is not None:
            gui.add_html(_legend(colors))
            gui.add_markdown("Drag the sensor by its arrows. Click on the surface.")
        self._click = gui.add_markdown("")
        with gui.add_folder("surface"):
            self._surface = gui.add_checkbox("show", True)
            step_m, largest_m = _range(float(surface.uncertainty_m.max()))
            self._uncertainty = gui.add_slider(
                "uncertainty ≤ m", 0.0, largest_m, step_m, largest_m, hint="hides what is more uncertain"
            )
            self._confidence = gui.add_slider(
                "confidence ≥", 0.0, 1.0, 1 / _STEPS, 0.0, hint="hides what is less probable"
            )
        self._layers: dict[str, Any] = {}
        if scans == 0:
            return
        with gui.add_folder("scans"):
            self._scan = gui.add_slider("scan", 0, max(scans - 1, 1), 1, 0, disabled=scans == 1)
            self._scan_text = gui.add_markdown("")
            self._layers["measured"] = gui.add_checkbox("measured", True, hint="round points")
            self._layers["predicted"] = gui.add_checkbox(
                "predicted", True, hint="diamonds: what the map expects the sensor to get from there"
            )
            self._layers["all"] = gui.add_checkbox("all scans", False)
            self._path = gui.add_checkbox("trajectory", True)

    @property
    def max_uncertainty_m(self) -> float:
        """Value of the slider."""
        return float(self._uncertainty.value)

    @property
    def min_confidence(self) -> float:
        """Value of the slider."""
        return float(self._confidence.value)

    def connect(
        self, painter: Painter, canvas: SurfaceCanvas, walk: Walk | None, go_to_scan: Callable[[int], None]
    ) -> None:
        """Let the controls control. Called once."""

        # Coroutines, because viser would run functions in several threads, in any order.
        async def on_limit(_: Any) -> None:
            painter.wish(
                max_uncertainty_m=self.max_uncertainty_m,
                min_confidence=self.min_confidence,
                coarse=False,
                settle_s=SLID_S,
            )

        async def on_surface(_: Any) -> None:
            canvas.node.visible = self._surface.value

        self._uncertainty.on_update(on_limit)
        self._confidence.on_update(on_limit)
        self._surface.on_update(on_surface)
        if walk is None:
            return

        async def on_scan(_: Any) -> None:
            go_to_scan(int(self._scan.value))

        async def on_path(_: Any) -> None:
            walk.path.visible = self._path.value

        def on_layer(event: Any) -> None:  # in a thread: all scans take a while
            for name, box in self._layers.items():
                if box is event.target:
                    walk.set_visible(name, visible=box.value)

        self._scan.on_update(on_scan)
        self._path.on_update(on_path)
        for box in self._layers.values():
            box.on_update(on_layer)

    def say_of_scan(self, text: str) -> None:
        """Say something of the scan that is shown."""
        self._scan_text.content = text

    def say_of_click(self, rows: Mapping[str, str]) -> None:
        """Show names and values of what was clicked."""
        lines = (f"| {name} | {value} |" for name, value in rows.items())
        self._click.content = "\n".join(["| clicked | |", "|---|---|", *lines])


def _range(largest: float) -> tuple[float, float]:
    """Step and end of a slider from 0 to the largest value."""
    step = 10.0 ** math.floor(math.log10(max(largest, 1e-6) / _STEPS))
    return step, math.ceil(largest / step) * step


def _legend(colors: Colors) -> str:
    """A bar with the colours of the scale, as HTML."""
    shown = colors(np.linspace(colors.low, colors.high, 9))
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in shown.tolist())
    return _LEGEND.format(stops=stops, low=colors.low, high=colors.high)
