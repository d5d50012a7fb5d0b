# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Metrics as lines of text."""

from __future__ import annotations

from typing import cast

from .intensity import IntensityMetrics
from .surface import SurfaceMetrics


def _number(value: float | None, unit: str, factor: float = 1.0, digits: int = 2) -> str:
    return "undefined" if value is None else f"{value * factor:.{digits}f}{unit}"


def _percent(ratio: float) -> str:
    return _number(ratio, " %", 100)


def format_metrics(metrics: SurfaceMetrics | IntensityMetrics) -> str:
    """Write metrics as a few aligned lines of text.

    Parameters
    ----------
    metrics : SurfaceMetrics or IntensityMetrics
        Result of `surface_metrics` or `intensity_metrics`.

    Returns
    -------
    str
        Lines without a trailing newline. Surface errors are in centimetres and ratios in percent, as in the paper's
        tables; intensity errors are in sensor units.

    Examples
    --------
    >>> from radarsdf.evaluation import intensity_metrics
    >>> print(format_metrics(intensity_metrics([60.0, 70.0], [61.0, 68.0])))
    intensity error  mean 1.50  median 1.50  (2 returns, radarsdf-intensity-1)
    """
    if "mae" in metrics:
        i = cast("IntensityMetrics", metrics)
        count = f"({i['num_returns']} returns, {i['protocol']})"
        return f"intensity error  mean {i['mae']:.2f}  median {i['medae']:.2f}  {count}"
    s = metrics
    accuracy = _number(s["accuracy_error_m"], " cm", 100)
    shape, mean = _number(s["gamma_shape"], ""), _number(s["gamma_mean"], " rad", digits=3)
    variance = _number(s["gamma_variance"], " rad²", digits=3)
    of = f"{s['num_mesh_samples']} mesh samples and {s['num_ground_truth']} ground-truth points"
    rows = {
        "accuracy": f"error {accuracy}  ratio {_percent(s['accuracy_ratio'])}"
        f"  outliers beyond {s['outlier_m']:g} m {_percent(s['outlier_ratio'])}",
        "completion": f"error {_number(s['completion_error_m'], ' cm', 100)}"
        f"  ratio {_percent(s['completion_ratio'])}",
        "F-score": f"{_percent(s['f_score'])}  with nothing discarded {_percent(s['f_score_all'])}"
        f" (precision {_percent(s['precision'])})",
        "angles": f"gamma shape {shape}  mean {mean}  variance {variance}",
        "protocol": f"{s['protocol']}  threshold {s['threshold_m']:g} m  {of} ({s['ground_truth_sha256'][:12]})",
    }
    return "\n".join(f"{name:<12}{text}" for name, text in rows.items())
