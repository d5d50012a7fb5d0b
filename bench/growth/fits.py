# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time and memory of whole fits, over returns, length of the scene, threads, and with or without intensities."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import radarsdf
import radarsdf.fitting.fit  # else the first fit would import it, in what is measured
from radarsdf import FitConfig, RadarMap

from bench.memory import memory_bytes
from bench.timing import timed

from .street import Street, street

_RETURNS = (10**4, 10**5, 10**6, 10**7)
_SIZES_M = (50.0, 500.0, 5000.0)
_SIZE_M = 500.0  # while the returns vary
_COUNT = 10**6  # while the size varies
_OFF_M = 0.2  # distance to the surface of the points at which the sign of the SDF is checked
_LEAST_RIGHT = 0.6

COLUMNS = (
    ("returns", "returns", ","),
    ("size_m", "length, m", ",.0f"),
    ("threads", "threads", "d"),
    ("intensities", "intensities", ""),
    ("wall_s", "wall, s", ".2f"),
    ("cpu_s", "processor, s", ".2f"),
    ("peak_mb", "peak, MB", ".0f"),
    ("before_mb", "before the fit, MB", ".0f"),
    ("prepare_s", "prepare, s", ".2f"),
    ("ghosts_s", "ghosts, s", ".2f"),
    ("occupied_cells_s", "cells, s", ".2f"),
    ("start_s", "start, s", ".2f"),
    ("training_s", "training, s", ".2f"),
    ("leaf_cells", "leaf cells", ","),
    ("map_mb", "map, MB", ".1f"),
    ("right", "correct signs", ".1%"),
    ("mae", "MAE, dB", ".2f"),
)


def cases(
    *, quick: bool, returns: list[int], sizes_m: list[float], threads: list[int], every: bool
) -> list[dict[str, Any]]:
    """Arguments of `row`: either returns or size varies, or with `every` all their combinations."""
    if quick:
        counts_and_sizes = {(returns[0] if returns else 10**4, sizes_m[0] if sizes_m else 50.0): None}
    elif every:
        counts_and_sizes = dict.fromkeys(
            (count, size_m) for count in returns or _RETURNS for size_m in sizes_m or _SIZES_M
        )
    else:
        counts_and_sizes = dict.fromkeys(
            [(count, _SIZE_M) for count in returns or _RETURNS]
            + [(_COUNT, size_m) for size_m in sizes_m or _SIZES_M]
        )
    return [
        {
            "returns": count,
            "size_m": size_m,
            "threads": number,
            "intensities": intensities,
            "quick": quick,
        }
        for count, size_m in counts_and_sizes
        for intensities in (False, True)
        for number in (threads or ([2] if quick else [1, 2]))
    ]


def row(*, returns: int, size_m: float, threads: int, intensities: bool, quick: bool) -> dict[str, Any]:
    """Time, memory and stages of one fit, and the errors of its map.

    Raises
    ------
    RuntimeError
        If returns are missing, or the map is not one of the street: a failed fit must not count as a fast one.
    """
    scans = street(returns, size_m)
    short = {"sdf_iterations": 60, "intensity_iterations": 120} if quick else {}
    config = FitConfig(num_threads=threads).override(training=short)
    before = memory_bytes("VmHWM")
    with timed() as taken:
        radar_map = radarsdf.fit(
            scans.points,
            scans.poses,
            scans.intensities if intensities else None,
            config=config,
            progress=False,
        )
    found = {
        **asdict(taken),
        "peak_mb": memory_bytes("VmHWM") / 1e6,
        "before_mb": before / 1e6,
    }
    report = radar_map.report
    if report["returns"] != returns:
        msg = f"{report['returns']} returns were fitted, not {returns}"
        raise RuntimeError(msg)
    return found | report | {"map_mb": radar_map.nbytes / 1e6} | _errors(radar_map, scans)


def _errors(radar_map: RadarMap, scans: Street) -> dict[str, float]:
    """Share of correct signs in front of and behind the true surface, and the error of the intensity on it.

    Raises
    ------
    RuntimeError
        If the signs are hardly better than chance, or the intensities worse than a constant.
    """
    hits, sensors = scans.hits.astype(np.float64), scans.hit_sensors.astype(np.float64)
    rays = hits - sensors
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # The points are moved along the normal: a ray can be almost parallel to the surface.
    normals = np.zeros_like(hits)
    on_ground = np.abs(hits[:, 2]) < 1e-2
    on_side = ~on_ground & (np.abs(np.abs(hits[:, 1]) - 25) < 1e-2)
    normals[on_ground, 2] = 1
    normals[on_side, 1] = -np.sign(hits[on_side, 1])
    normals[~on_ground & ~on_side, 0] = -np.sign(rays[~on_ground & ~on_side, 0])
    known = radar_map.observed(hits)
    front, back = (
        radar_map.sdf(hits[known] + side * _OFF_M * normals[known], extrapolate=True) for side in (1, -1)
    )
    right = float(((front > 0).mean() + (back < 0).mean()) / 2)
    if not right > _LEAST_RIGHT:
        msg = f"only {right:.0%} of the signs are correct, and 50% would be chance"
        raise RuntimeError(msg)
    errors = {"right": right}
    if radar_map.has_intensity:
        predicted = radar_map.intensity(hits[known], sensors[known], extrapolate=True)
        errors["mae"] = float(np.abs(predicted - scans.hit_intensities[known]).mean())
        spread = float(np.abs(scans.hit_intensities - np.median(scans.hit_intensities)).mean())
        if not errors["mae"] < spread:
            msg = f"the error of the intensity is {errors['mae']:.2f} dB, that of a constant {spread:.2f} dB"
            raise RuntimeError(msg)
    return errors
