# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From scans with poses to a map: what a fit does, in order."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from radarsdf._core import CellSet
from radarsdf.config import FitConfig
from radarsdf.field import Field
from radarsdf.gaps import bridged
from radarsdf.map import IntensityScale, RadarMap
from radarsdf.scans import Rays, prepare
from radarsdf.surfels import Surfels, support_of
from radarsdf.threads import Workers
from radarsdf.training import Training

_global_generator = threading.Lock()


def fit(
    points: Sequence[ArrayLike],
    poses: ArrayLike,
    intensities: Sequence[ArrayLike] | None = None,
    *,
    config: FitConfig | None = None,
    progress: bool | None = None,
) -> RadarMap:
    """Fits a signed distance field, and with intensities a reflectance field, to radar returns.

    Parameters
    ----------
    points : sequence of F arrays
        (N_i, 3) each: the returns of one scan, sensor frame, m.
    poses : array_like
        (F, 4, 4) T_world_sensor, one for each scan.
    intensities : sequence of F arrays, optional
        (N_i,) each, in the sensor's own units. Without them nothing of the reflectance side is built or run.
    config : FitConfig, optional
        Every choice of the fit; ``FitConfig.paper()`` is the published configuration.
    progress : bool, optional
        Whether to show a progress bar; by default only on a terminal.

    Returns
    -------
    RadarMap
        With the times and counts of the fit in its ``report``. The same input, seed and number of threads give the
        same bits.

    Raises
    ------
    ValueError
        For scans or poses that cannot be what they should be; see :func:`radarsdf.scans.prepare`.
    FloatingPointError
        If a loss stops being finite.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=4)
    >>> radar_map = radarsdf.fit(scans.points, scans.poses, scans.intensities)
    >>> distance_m = radar_map.sdf(scans.poses[:, :3, 3])  # of the sensor's positions: all in free space
    >>> bool((distance_m > 0).all())
    True
    """
    config = FitConfig() if config is None else config
    clock = _Clock()
    rays = prepare(
        points,
        poses,
        intensities,
        min_range_m=config.min_range_m,
        max_range_m=config.max_range_m,
        accumulate_frames=config.accumulate_frames,
    )
    clock.lap("prepare_s")
    with Workers(config.num_threads) as workers:
        surface = rays
        if config.drop_ghosts:
            is_ghost = Surfels.of(rays, workers.num_threads).ghosts(rays, workers.num_threads)
            surface = rays.select(~is_ghost)
            clock.lap("ghosts_s")
        field = _new_field(surface, config, workers.num_threads)
        clock.lap("occupied_cells_s")
        scale = IntensityScale.of(rays.intensities)
        training = Training(field, surface, rays, scale, config, workers)
        training.run(progress)
        clock.lap("training_s")
        support = support_of(
            surface.points, field.cells.table.leaf_keys(), config.leaf_size_m, workers.num_threads
        )
        clock.lap("support_s")
    field.requires_grad_(False)
    report = {
        "returns": sum(len(np.asarray(scan)) for scan in points),
        "returns_used": len(surface),
        "ghosts": len(rays) - len(surface),
        "leaf_cells": len(field.cells.table.leaf_keys()),
        "vertices": field.cells.table.num_rows,
        "iterations": training.iterations,
        "losses": training.losses,
        **clock.laps,
    }
    return RadarMap(
        field=field,
        origin=rays.origin,
        intensity_scale=scale,
        config=config,
        report=report,
        support=support,
    )


def occupied_leaf_keys(rays: Rays, config: FitConfig, num_threads: int) -> NDArray[np.uint64]:
    """Leaf cells that a near-surface sample can fall into: Morton keys, ascending.

    The line of samples round each return is walked in steps of half a cell instead of being left to chance, so that
    the map does not depend on the seed.
    """
    steps = math.ceil(2 * config.near_band_m / (config.leaf_size_m / 2))
    cells = CellSet(config.leaf_size_m)
    for chunk in rays.along(np.linspace(-config.near_band_m, config.near_band_m, steps + 1)):
        cells.insert(chunk, num_threads)
    return cells.sorted_keys(num_threads)


def _new_field(rays: Rays, config: FitConfig, num_threads: int) -> Field:
    leaf_keys = bridged(
        occupied_leaf_keys(rays, config, num_threads),
        rays,
        config.leaf_size_m,
        config.bridge_cells,
        num_threads,
    )
    # The layers of torch.nn draw from the global generator, of which fits in several threads take turns.
    with _global_generator, torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        field = Field(leaf_keys, config, with_intensity=rays.intensities is not None, num_threads=num_threads)
        field.cells.initialise(config.feature_std)
    return field


class _Clock:
    """Wall seconds between laps."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
