"""Plots of the report, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.render.figures import new_figure, png_of

_FIRST, _SECOND = "#0072b2", "#d55e00"  # distinguishable by colour-blind readers


def _subplots() -> tuple[Any, Any]:
    """Create a figure with axes, small enough for text to stay legible on a phone."""
    figure = new_figure(figsize=(4.4, 3.3), dpi=180, layout="constrained", facecolor="white")
    return figure, figure.subplots()


def _png(figure: Any) -> bytes:
    for ax in figure.axes:
        if ax.get_label() != "<colorbar>":
            ax.grid(alpha=0.3)
            ax.spines[["top", "right"]].set_visible(False)
    return png_of(figure, metadata={"Software": None})


def reliability(predicted_m: Sequence[float], measured_m: Sequence[float]) -> bytes:
    """Plot RMS error over predicted uncertainty, in bins."""
    figure, ax = _subplots()
    most = 1.1 * max(*predicted_m, *measured_m)
    ax.plot([0, most], [0, most], color="gray", linestyle="--", linewidth=1, label="ideal")
    ax.plot(predicted_m, measured_m, "o-", color=_FIRST, markersize=4, label="this map")
    ax.set(xlabel="predicted uncertainty, m", ylabel="RMS error, m", xlim=(0, most), ylim=(0, most))
    ax.legend(frameon=False, loc="upper left")
    return _png(figure)


def predicted_over_measured(measured: Floats, predicted: Floats) -> bytes:
    """Plot the density of predicted over measured intensities (N,), with the diagonal."""
    from matplotlib.colors import LogNorm  # noqa: PLC0415 - an extra

    figure, ax = _subplots()
    low, high = np.percentile(np.concatenate([measured, predicted]), [0.2, 99.8])
    high = max(high, low + 1e-6)
    bins = np.linspace(low, high, 61)
    *_, drawn = ax.hist2d(measured, predicted, bins, cmap="viridis", norm=LogNorm(), cmin=1)
    ax.plot([low, high], [low, high], color=_SECOND, linewidth=1.5, label="equal")
    ax.set(xlabel="measured intensity", ylabel="predicted intensity", xlim=(low, high), ylim=(low, high))
    ax.legend(frameon=False, loc="upper left")
    figure.colorbar(drawn, label="returns", pad=0.02)
    return _png(figure)


def trajectory(before: Floats | None, after: Floats) -> bytes:
    """Plot positions (N, 3) from above. `before`: input positions of the same scans."""
    figure, above = _subplots()
    paths = [("after", after, _FIRST, 1.5)]
    if before is not None:
        paths.insert(0, ("before", before, _SECOND, 2.5))
    for name, path, color, width in paths:
        above.plot(path[:, 0], path[:, 1], color=color, linewidth=width, label=name)
        above.plot(*path[0, :2], "o", color=color, markersize=4)
    above.set(xlabel="x, m", ylabel="y, m")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(frameon=False)
    return _png(figure)
