# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The plots of `BENCHMARK.md`: curves with their names beside them, on white, which dark and light pages both show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from radarsdf.render.figures import new_figure

from .results import Results, Row, digest
from .tables import by_scene

ERROR_OVER_TIME, GROWTH = "docs/error_over_time.png", "docs/growth.png"
PLOTS = (ERROR_OVER_TIME, GROWTH)

_OURS = {"radarsdf": "tab:red", "radarsdf, intensities": "tab:purple"}
_OTHERS, _PEERS = "tab:red", "tab:blue"
_DPI = 100
_COLOURS = 48
_MAX_BYTES = 80_000
# Where a name may stand beside its point, in points of the page: the first place that is free is taken.
_PLACES = (
    (5, 4, "left"), (5, -10, "left"), (-5, 4, "right"), (-5, -10, "right"), (0, 10, "center"), (0, -16, "center"),
    (5, 15, "left"), (-5, 15, "right"), (5, -21, "left"), (-5, -21, "right"), (5, 26, "left"), (5, -32, "left"),
)  # fmt: skip


def draw(results: Results, root: Path) -> None:
    """Write the plots of `results` into the folder `root`, with the digest of the results in each.

    Raises
    ------
    ValueError
        If a file is larger than 80 kB.
    """
    rows = {name: part.get("rows", []) for name, part in results["experiments"].items()}
    for name, figure in (
        (ERROR_OVER_TIME, _error_over_time(rows.get("curve", []))),
        (GROWTH, _growth(rows.get("growth", []))),
    ):
        _save(figure, root / name, digest(results))
        if (size := (root / name).stat().st_size) > _MAX_BYTES:
            msg = f"{name} has {size:,} bytes, and may have {_MAX_BYTES:,}"
            raise ValueError(msg)


def _save(figure: Any, path: Path, mark: str) -> None:
    """As a PNG file of few colours, a third as large as one of all; `mark` is in its text, uncompressed."""
    from PIL import Image, PngImagePlugin  # noqa: PLC0415 - comes with matplotlib

    figure.canvas.draw()
    text = PngImagePlugin.PngInfo()
    text.add_text("Description", f"bench.report {mark}")
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    image.quantize(_COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
        path, optimize=True, pnginfo=text
    )


def _figure(rows: int) -> tuple[Any, Any]:
    """With two panels in each row."""
    figure = new_figure(figsize=(9.2, 3.8 * rows), dpi=_DPI, layout="constrained", facecolor="white")
    return figure, figure.subplots(rows, 2, squeeze=False)


def _error_over_time(rows: Sequence[Row]) -> Any:
    """For each scene the error of the surface, and that of the intensity, over seconds."""
    scenes = by_scene([row for row in rows if row.get("seconds") is not None])
    figure, axes = _figure(max(1, len(scenes)))
    for (left, right), (scene, own) in zip(axes, scenes.items(), strict=False):
        surface = [(row, 100 - 100 * row["f_score_all"]) for row in own if row.get("f_score_all") is not None]
        _panel(left, surface, f"{scene}: surface", "100 % − F-all, %")
        intensity = [(row, row["mae"]) for row in own if row.get("mae") is not None]
        _panel(right, intensity, f"{scene}: intensity", "MAE, dB")
        floor = next((row["noise_floor"] for row in own if row.get("noise_floor") is not None), None)
        if floor is not None:
            right.axhline(floor, color="gray", linestyle="--", linewidth=1)
            right.annotate(
                "floor", (0.01, floor), xycoords=("axes fraction", "data"), xytext=(0, 3),
                textcoords="offset points", fontsize=8, color="gray",
            )  # fmt: skip
    _finish(axes)
    return figure


def _panel(ax: Any, points: Sequence[tuple[Row, float]], title: str, label: str) -> None:
    """Lines of our methods over their training, points of the others, each with its name."""
    ax.set(title=title, xscale="log", xlabel="time, s", ylabel=label)
    if label.endswith("%"):
        ax.set_yscale("log")
    named = []
    for kind, color in _OURS.items():
        line = _medians([(row, y) for row, y in points if row["kind"] == kind])
        if line:
            ax.plot([x for _, x, _ in line], [y for _, _, y in line], "o-", color=color, markersize=4)
            named.append((kind, *line[-1][1:], color))
    for name, x, y in _medians([(row, y) for row, y in points if row["kind"] == "peer"]):
        color = _OTHERS if name.startswith("radarsdf") else _PEERS
        ax.plot([x], [y], "s", color=color, markersize=4)
        named.append((name, x, y, color))
    _plain_ticks(ax)
    ax.margins(0.16)
    _name(ax, named)


def _medians(points: Sequence[tuple[Row, float]]) -> list[tuple[str, float, float]]:
    """Of each method its name, and the medians of seconds and value over its repetitions; in the order of seconds."""
    methods: dict[str, list[tuple[float, float]]] = {}
    for row, value in points:
        methods.setdefault(row["method"], []).append((row["seconds"], value))
    found = [(name, median(x for x, _ in own), median(y for _, y in own)) for name, own in methods.items()]
    return sorted(found, key=lambda item: item[1])


def _growth(rows: Sequence[Row]) -> Any:
    """Seconds and peak memory over the number of returns."""
    rows = [row for row in rows if row.get("wall_s") is not None]
    figure, axes = _figure(1)
    panels = (("wall_s", "time", "time, s", 1.0), ("peak_mb", "memory", "memory, GB", 1e-3))
    for ax, (key, title, label, factor) in zip(axes[0], panels, strict=True):
        ax.set(title=title, xscale="log", yscale="log", xlabel="returns", ylabel=label)
        named = []
        for both, color in ((False, "tab:red"), (True, "tab:purple")):
            line = sorted((row["returns"], factor * row[key]) for row in rows if row["intensities"] is both)
            if line:
                ax.plot([x for x, _ in line], [y for _, y in line], "o-", color=color, markersize=4)
                named.append((f"{'with' if both else 'without'} intensities", *line[len(line) // 2], color))
        _plain_ticks(ax)
        ax.margins(0.1)
        _name(ax, named)
    _finish(axes)
    return figure


def _plain_ticks(ax: Any) -> None:
    """Numbers as people write them, 0.5 and 30, in place of powers of ten; returns stay powers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter  # noqa: PLC0415

    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() != "log" or axis.get_label_text() == "returns":
            continue
        axis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=20))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _name(ax: Any, named: Sequence[tuple[str, float, float, str]]) -> None:
    """Write each name beside its point, where no other name and no line is."""
    renderer = ax.figure.canvas.get_renderer()
    ax.figure.canvas.draw()
    taken: list[Any] = []
    drawn = np.concatenate(
        [_along(ax.transData.transform(line.get_xydata())) for line in ax.lines] or [[(0, 0)]]
    )
    for name, x, y, color in named:
        candidates = []
        for i, (dx, dy, side) in enumerate(_PLACES):
            text = ax.annotate(
                name, (x, y), xytext=(dx, dy), textcoords="offset points", ha=side, fontsize=8, color=color
            )
            box = text.get_window_extent(renderer)
            outside = box.x0 < ax.bbox.x0 or box.x1 > ax.bbox.x1 or box.y0 < ax.bbox.y0 or box.y1 > ax.bbox.y1
            crossed = ((drawn > (box.x0, box.y0)) & (drawn < (box.x1, box.y1))).all(axis=1).any()
            cost = 2 * sum(box.overlaps(other) for other in taken) + int(crossed) + 3 * int(outside)
            candidates.append((cost, i, text, box))
        best = min(candidates, key=lambda item: item[:2])
        for *_, text, _box in candidates:
            if text is not best[2]:
                text.remove()
        taken.append(best[3])


def _along(corners: Any) -> Any:
    """Points so close together along a line that no name fits between them, (N, 2) from corners (M, 2)."""
    steps = np.linspace(0, 1, 64)[:, None, None]
    between = corners[None, :-1] * (1 - steps) + corners[None, 1:] * steps
    return np.concatenate([corners, between.reshape(-1, 2)])


def _finish(axes: Any) -> None:
    for ax in axes.flat:
        if not ax.has_data():
            ax.set_axis_off()
            ax.text(0.5, 0.5, "not measured", ha="center", transform=ax.transAxes)
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
