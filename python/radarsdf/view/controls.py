# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Sliders, check boxes and texts of the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from radarsdf.view.canvas import SurfaceCanvas
from radarsdf.view.legends import legend, marks, paragraph, table
from radarsdf.view.painter import SLID_S, Painter
from radarsdf.view.quantities import Colors, Quantity
from radarsdf.view.surface import ShownSurface
from radarsdf.view.walk import MEASURED_COLOR, PATH_COLOR, PREDICTED_COLOR, Walk

_STEPS = 100
_HINT = "Click on the surface to ask the map. Drag the sensor by its arrows."


class Controls:
    """The panels of the page, beside the map: the legend and what was clicked, and the controls of surface and scans.

    On a narrow screen the page shows the controls folded, so that little stands before the map.

    Parameters
    ----------
    server
        The viser server.
    surface
        What is shown: it gives the range of the sliders.
    quantities
        What the surface can be coloured by. The first is chosen.
    measured
        The scale of the intensities that were measured, if there are any.
    scans
        The number of scans to walk through.
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
        self._quantity = gui.add_dropdown("colour by", tuple(quantities), hint="what is shown of the surface")
        self._click = gui.add_html(paragraph(_HINT))
        self._reset = gui.add_button("Reset view")
        gui.main_panel.dock_right()
        panel = gui.add_panel()
        panel.dock_below(gui.main_panel)
        with panel.add_tab("controls"):
            with gui.add_folder("surface"):
                self._fill_surface(gui, surface)
            if scans:
                with gui.add_folder("scans"):
                    self._fill_scans(gui, measured, scans)

    def _fill_surface(self, gui: Any, surface: ShownSurface) -> None:
        self._surface = gui.add_checkbox("show", True)
        step_m, largest_m = _range(float(surface.uncertainty_m.max()))
        self._uncertainty = gui.add_slider(
            "uncertainty ≤ m", 0.0, largest_m, step_m, largest_m, hint="hides what is more uncertain"
        )
        self._confidence = gui.add_slider(
            "confidence ≥",
            0.0,
            1.0,
            1 / _STEPS,
            0.0,
            hint=f"hides what is less probable; the mesh is {surface.threshold}",
        )

    def _fill_scans(self, gui: Any, measured: Colors | None, scans: int) -> None:
        self._layers: dict[str, Any] = {}
        gui.add_html(marks(measured or MEASURED_COLOR, PREDICTED_COLOR, PATH_COLOR))
        self._scan = gui.add_slider("scan", 0, max(scans - 1, 1), 1, 0, disabled=scans == 1)
        self._scan_text = gui.add_markdown("")
        self._layers["measured"] = gui.add_checkbox("measured", True)
        self._layers["predicted"] = gui.add_checkbox(
            "predicted", True, hint="what the map expects the sensor to get from there"
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

    @property
    def quantity(self) -> str:
        """Name of what the surface is coloured by."""
        return str(self._quantity.value)

    def connect(
        self,
        painter: Painter,
        canvas: SurfaceCanvas,
        walk: Walk | None,
        go_to_scan: Callable[[int], None],
        look_again: Callable[[Any], object],
    ) -> None:
        """Let the controls control. Called once. `look_again`: resets the view of a client."""

        # Coroutines, because viser would run functions in several threads, in any order.
        async def on_limit(_: Any) -> None:
            painter.wish(
                max_uncertainty_m=self.max_uncertainty_m,
                min_confidence=self.min_confidence,
                coarse=False,
                settle_s=SLID_S,
            )

        async def on_quantity(_: Any) -> None:
            self._legend.content = legend(self._quantities[self.quantity])
            painter.wish(quantity=self.quantity, coarse=False, settle_s=0.0)

        async def on_surface(_: Any) -> None:
            canvas.node.visible = self._surface.value

        async def on_reset(event: Any) -> None:
            look_again(event.client)

        self._uncertainty.on_update(on_limit)
        self._confidence.on_update(on_limit)
        self._quantity.on_update(on_quantity)
        self._surface.on_update(on_surface)
        self._reset.on_click(on_reset)
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
        self._click.content = table(rows)


def _range(largest: float) -> tuple[float, float]:
    """Step and end of a slider from 0 to the largest value."""
    step = 10.0 ** math.floor(math.log10(max(largest, 1e-6) / _STEPS))
    return step, math.ceil(largest / step) * step
