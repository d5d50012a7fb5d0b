# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Plots as PNG files. They are drawn without a display, and no setting of matplotlib is changed."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.render.figures import new_figure, png_of

_Floats = NDArray[np.float64]

FIRST, SECOND = "#0072b2", "#d55e00"
"""Two colours that also colour-blind people tell apart."""
_SIZE_INCHES, _DPI = (4.4, 3.3), 180  # so that letters are legible when a phone shrinks the plot to its width


def _axes(rows: int = 1) -> tuple[Any, Any]:
    """A figure, and its axes one above the other: an array of `rows`."""
    width, height = _SIZE_INCHES
    size = width, height * (1 + 0.35 * (rows - 1))
    figure = new_figure(figsize=size, dpi=_DPI, layout="constrained", facecolor="white")
    shares = [2, 1][:rows]
    return figure, figure.subplots(rows, 1, sharex=True, squeeze=False, height_ratios=shares)[:, 0]


def _png(figure: Any) -> bytes:
    for ax in figure.axes:
        if ax.get_label() != "<colorbar>":
            ax.grid(alpha=0.3)
            ax.spines[["top", "right"]].set_visible(False)
    return png_of(figure, metadata={"Software": None})


def losses(history: Mapping[str, Mapping[str, Sequence[float]]]) -> bytes:
    """Each loss over the seconds of the training. `history` is that of the fit's report."""
    figure, axes = _axes()
    (ax,) = axes
    for (name, spans), color in zip(history.items(), (FIRST, SECOND), strict=False):
        ax.plot(spans["seconds"], spans["losses"], color=color, linewidth=1.5, label=name)
    ax.set(xlabel="time of training, s", ylabel="loss", yscale="log")
    ax.set_xlim(left=0)
    ax.legend(frameon=False)
    return _png(figure)


def histogram(values: _Floats, *, label: str, most: float) -> bytes:
    """Shares of values (N,) of the surface from 0 to `most`, in percent; the last bin has all that are larger."""
    figure, (ax,) = _axes()
    weights = np.full(len(values), 100 / len(values))
    ax.hist(np.minimum(values, most), np.linspace(0, most, 41), weights=weights, color=FIRST)
    ax.set(xlabel=label, ylabel="share of the surface, %", xlim=(0, most))
    ax.locator_params(axis="x", nbins=6)
    return _png(figure)


def cumulative(series: Mapping[str, _Floats], *, label: str, most: float, mark: float) -> bytes:
    """Share of the values below each number from 0 to `most`, with a line at `mark`."""
    figure, (ax,) = _axes()
    x = np.linspace(0, most, 201)
    for (name, values), color in zip(series.items(), (FIRST, SECOND), strict=False):
        ax.plot(x, 100 * np.searchsorted(np.sort(values), x) / len(values), color=color, label=name)
    ax.axvline(mark, color="gray", linestyle="--", linewidth=1)
    ax.set(xlabel=label, ylabel="share below, %", xlim=(0, most), ylim=(0, 100))
    ax.legend(frameon=False, loc="lower right")
    return _png(figure)


def reliability(predicted: Sequence[float], measured: Sequence[float]) -> bytes:
    """Errors over the uncertainties that were predicted for them, in bins, m."""
    figure, (ax,) = _axes()
    most = 1.1 * max(*predicted, *measured)
    ax.plot([0, most], [0, most], color="gray", linestyle="--", linewidth=1, label="perfect")
    ax.plot(predicted, measured, "o-", color=FIRST, markersize=4, label="this map")
    ax.set(xlabel="uncertainty, m", ylabel="error, root mean square, m", xlim=(0, most), ylim=(0, most))
    ax.legend(frameon=False, loc="upper left")
    return _png(figure)


def measured_predicted(measured: _Floats, predicted: _Floats, unit: str) -> bytes:
    """Density of predicted over measured values, both (N,), with the diagonal."""
    from matplotlib.colors import LogNorm  # noqa: PLC0415 - an extra

    figure, (ax,) = _axes()
    low, high = np.percentile(np.concatenate([measured, predicted]), [0.2, 99.8])
    high = max(high, low + 1e-6)
    *_, drawn = ax.hist2d(
        measured, predicted, bins=60, range=[[low, high]] * 2, cmap="viridis", norm=LogNorm(), cmin=1
    )
    ax.plot([low, high], [low, high], color=SECOND, linewidth=1.5, label="equal")
    ax.set(xlabel=f"measured, {unit}", ylabel=f"predicted, {unit}", xlim=(low, high), ylim=(low, high))
    ax.legend(frameon=False, loc="upper left")
    figure.colorbar(drawn, label="returns", pad=0.02)
    return _png(figure)


def by_bins(
    edges: _Floats, values: _Floats, measured: _Floats, predicted: _Floats, *, label: str, unit: str
) -> bytes:
    """Medians of measured and predicted values (N,) in bins of other `values` (N,), and the mean error below.

    The band holds the middle two thirds of the measured values. Bins of fewer than 20 are left out.
    """
    figure, (above, below) = _axes(2)
    rows = []
    for low, high in itertools.pairwise(edges):
        own = (values >= low) & (values < high)
        if own.sum() >= 20:
            m, p = measured[own], predicted[own]
            quartiles = np.percentile(m, [17, 50, 83])
            rows.append([(low + high) / 2, *quartiles, np.median(p), np.abs(p - m).mean(), high - low])
    if rows:
        x, bottom, middle, top, median, error, width = np.array(rows).T
        above.fill_between(x, bottom, top, color=FIRST, alpha=0.2, linewidth=0)
        above.plot(x, middle, "o-", color=FIRST, markersize=3, label="measured")
        above.plot(x, median, "s--", color=SECOND, markersize=3, label="predicted")
        above.legend(frameon=False)
        below.bar(x, error, 0.9 * width, color="gray")
    above.set(ylabel=f"median, {unit}")
    below.set(xlabel=label, ylabel="mean error", xlim=(edges[0], edges[-1]))
    return _png(figure)


def trajectory(before: _Floats | None, after: _Floats) -> bytes:
    """Positions (N, 3) from above, and their height over the way. `before`: the same scans where they were."""
    figure = new_figure(figsize=(4.4, 5.2), dpi=_DPI, layout="constrained", facecolor="white")
    above, height = figure.subplots(2, 1, height_ratios=[3, 1])
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(after, axis=0), axis=1))])
    ways = [("after", after, FIRST, 1.5)]
    if before is not None:
        ways.insert(0, ("before", before, SECOND, 2.5))
    for name, way, color, width in ways:
        above.plot(way[:, 0], way[:, 1], color=color, linewidth=width, label=name)
        above.plot(*way[0, :2], "o", color=color, markersize=4)
        height.plot(along_m, way[:, 2], color=color, linewidth=width)
    above.set(xlabel="x, m", ylabel="y, m")
    above.set_aspect("equal", adjustable="datalim")
    height.set(xlabel="along the way, m", ylabel="z, m")
    if before is not None:
        above.legend(frameon=False)
    return _png(figure)


def along_scans(scans: NDArray[Any], values: Mapping[str, _Floats]) -> bytes:
    """Values (N,) by what they are, each with axes of its own, over the numbers of scans (N,)."""
    figure = new_figure(figsize=(4.4, 5.2), dpi=_DPI, layout="constrained", facecolor="white")
    axes = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (name, shown), color in zip(axes, values.items(), (FIRST, SECOND), strict=False):
        ax.plot(scans, shown, color=color, linewidth=1.5)
        ax.set(ylabel=name)
        ax.set_ylim(bottom=0)
    axes[-1].set(xlabel="scan")
    return _png(figure)
