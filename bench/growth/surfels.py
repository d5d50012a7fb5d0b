# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time and memory of the ghost search and of the count of looks. The length of the street grows with the returns."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from radarsdf import FitConfig
from radarsdf._core import count_looks
from radarsdf.fitting.average import near_leaf_keys
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.noise import sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays, prepare

from bench.memory import memory_bytes
from bench.timing import timed

from .street import street

Result = TypeVar("Result")

COLUMNS = (
    ("returns", "returns", ","),
    ("ghosts_cpu_s", "ghosts: processor, s", ".2f"),
    ("ghosts_s", "wall, s", ".2f"),
    ("ghosts_mb", "MB", ".0f"),
    ("looks_cpu_s", "looks: processor, s", ".2f"),
    ("looks_s", "wall, s", ".2f"),
    ("looks_mb", "MB", ".0f"),
    ("ghosts", "ghosts", ","),
    ("leaf_cells", "leaf cells", ","),
)


def cases(*, quick: bool) -> list[dict[str, Any]]:
    """Arguments of `row`."""
    return [{"returns": count, "threads": 2} for count in ((10**5,) if quick else (10**5, 10**6, 10**7))]


def row(returns: int, threads: int) -> dict[str, Any]:
    """Processor time, wall time and growth of the peak memory, of the ghost search and of the count of looks.

    Raises
    ------
    RuntimeError
        If the numbers of ghosts or of cells that were looked at are implausible.
    """
    scans = street(returns)
    rays = prepare(scans.points, scans.poses)
    del scans
    config = FitConfig()
    is_ghost, ghosts = _measured("ghosts", lambda: _ghosts(rays, config, threads))
    kept = rays.select(~is_ghost)
    leaf_keys = near_leaf_keys(kept, config, threads)
    counts, looks = _measured(
        "looks",
        lambda: count_looks(
            leaf_keys, config.leaf_size_m, rays.points, rays.directions, rays.ranges_m, rays.scans, threads
        ),
    )
    # A tenth of the returns within 70 m are ghosts, and every cell is near a return.
    if not 0.02 * returns < is_ghost.sum() < 0.15 * returns or not (counts > 0).mean() > 0.9:
        msg = (
            f"{is_ghost.sum()} ghosts of {returns} returns, {(counts > 0).mean():.0%} of the cells looked at"
        )
        raise RuntimeError(msg)
    return {"ghosts": int(is_ghost.sum()), "leaf_cells": len(leaf_keys), **ghosts, **looks}


def _ghosts(rays: Rays, config: FitConfig, threads: int) -> NDArray[np.bool_]:
    surfels = Surfels.of(rays, config.leaf_size_m, threads)
    noise = sensor_noise(surfels, rays, config.returns)
    return find_ghosts(surfels, rays, noise, threads)[surfels.cells_at(rays.points, threads)]


def _measured(name: str, function: Callable[[], Result]) -> tuple[Result, dict[str, float]]:
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    before = memory_bytes("VmRSS")
    with timed() as taken:
        result = function()
    return result, {
        f"{name}_cpu_s": taken.cpu_s,
        f"{name}_s": taken.wall_s,
        f"{name}_mb": (memory_bytes("VmHWM") - before) / 1e6,
    }
