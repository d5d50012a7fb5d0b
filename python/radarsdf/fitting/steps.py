"""Steps of a fit, from rays to a map."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from radarsdf._core import KeptMemory
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.neural_field import NeuralField
from radarsdf.fitting.average import SurfaceReturns, average_surface, closed_form, occupied_cells
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.estimate import check_extent, check_fit, skipped_parts
from radarsdf.fitting.schedule import Schedule
from radarsdf.fitting.train import Diverged, Interrupted, Training
from radarsdf.map.contents import Deferred, MapContents
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Evidence, ReturnsOfCells, VisibilityCounts
from radarsdf.returns.free_space import FreeSpace
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import Rays
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.sums import ScanSums
from radarsdf.returns.view_statistics import ViewStatistics
from radarsdf.threads import ThreadPool


@dataclass(frozen=True)
class FitInput:
    """Input of a fit. Fields that are None are computed from the rays."""

    rays: Rays  # all rays, scan by scan
    scale: IntensityScale | None  # scale of their intensities
    poses: ArrayLike | None = None  # (F, 4, 4) T_world_sensor of the scans, used to estimate the `sensor`
    moving: int = 0  # number of moving returns left out
    why_none_moving: str | None = None  # see :class:`radarsdf.returns.moving.MovingReturns`
    inside: NDArray[np.bool_] | None = None
    """(N,) mask of the returns to fit, in whole leaf cells. The other rays only mark free space. None: all."""
    clutter_ratio: float | None = None  # share of the returns not on a thin surface
    returns_per_cell: float | None = None  # mean number of returns in the cells of surfels
    sensor: Sensor | None = None
    box_cells: NDArray[np.int64] | None = None
    """(2, 3) box [lower, upper) of free-space crossings to store, leaf cells from the origin. None: no limit."""
    sums: ScanSums | None = None  # sums over the scans of the rays, if updated incrementally
    visibility: VisibilityCounts | None = None  # visibility counts, if updated incrementally


def fit_rays(
    read: Callable[[], FitInput],
    config: FitConfig,
    *,
    progress: bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
) -> RadarMap:
    """Fit a map to the input that `read` returns. See :func:`radarsdf.fit`, also for errors."""
    try:
        # A map created in inference mode could not compute gradients later.
        with torch.inference_mode(mode=False), KeptMemory(), ThreadPool(config.num_threads) as pool:
            contents, stop = _fit(read, config, progress, checkpoint, pool)
    except KeyboardInterrupt as interruption:
        raise Interrupted(None) from interruption
    radar_map = RadarMap(contents)
    if isinstance(stop, Diverged):
        stop.radar_map = radar_map
        raise stop
    if stop is not None:
        raise Interrupted(radar_map) from stop
    return radar_map


def _fit(
    read: Callable[[], FitInput],
    config: FitConfig,
    progress: bool | None,
    checkpoint: str | PathLike[str] | None,
    pool: ThreadPool,
) -> tuple[MapContents, KeyboardInterrupt | Diverged | None]:
    """Return the contents of the map, and the reason for an early end of the training, if any."""
    num_threads, clock = pool.num_threads, [time.perf_counter()]
    seconds: dict[str, float] = {}

    def lap(step: str) -> None:
        clock.append(time.perf_counter())
        seconds[step] = clock[-1] - clock[-2]

    given = read()
    check_extent(given.rays, config)
    check_fit(given.rays, config, given.inside)
    saved = None if checkpoint is None else Checkpoint(checkpoint, given.rays, given.scale, config)
    lap("prepare_s")

    surface = SurfaceReturns.of(given.rays, config, num_threads, given.inside, given.sums)
    learnt = given.rays if given.inside is None else given.rays.select(given.inside)
    lap("ghosts_s")

    leaf_keys, returns = occupied_cells(surface, config, num_threads)
    with_network = config.trains_intensity and learnt.intensities is not None
    field: Field
    if surface.means is None:
        field = NeuralField(leaf_keys, config, with_intensity=with_network, num_threads=num_threads)
        field.initialise(torch.Generator("cpu").manual_seed(config.seed))
    else:
        field = average_surface(leaf_keys, surface.means, returns, surface.surfels, config, num_threads)
    lap("occupied_cells_s")

    sizes = {"surface_returns": surface.count, "returns": len(learnt), "vertices": field.table.num_rows}
    schedule = Schedule.of(config, with_intensity=with_network, **sizes)
    report = _report(given, learnt, surface, field, schedule, config)
    contents = _contents(given, learnt, surface, leaf_keys, returns, field, report, config, num_threads)
    lap("start_s")

    scale = given.scale if config.trains_intensity else None
    closes = learnt.intensities is not None and config.closes_intensity
    of_intensity = (learnt, surface.surfels) if closes else None
    surface_rays = surface.rays
    del given, surface, returns, leaf_keys  # frees most of the memory for the training
    stop: KeyboardInterrupt | Diverged | None = None
    if isinstance(field, NeuralField):
        training = Training(field, surface_rays, learnt, scale, schedule, config, pool)
        del surface_rays, learnt  # the training has a copy
        if saved is not None:
            saved.resume(training)
        try:
            training.run(progress, saved)
        except (KeyboardInterrupt, Diverged) as early:
            stop = early
        report.update(training.report())
        del training  # frees rays and moments, which the closed form does not need
        # The residuals of a diverged network are arbitrary.
    if of_intensity is not None and not (isinstance(stop, Diverged) and config.trains_intensity):
        field.reflectance = closed_form(contents, *of_intensity, num_threads)
    field.requires_grad_(False)
    lap("training_s")
    report.update(seconds)
    return contents, stop


def _contents(
    given: FitInput,
    learnt: Rays,
    surface: SurfaceReturns,
    leaf_keys: NDArray[np.uint64],
    returns: ReturnsOfCells,
    field: Field,
    report: dict[str, Any],
    config: FitConfig,
    num_threads: int,
) -> MapContents:
    """Return the contents of the map, with the untrained field."""
    rays, scale, surfels, leaf_m = given.rays, given.scale, surface.surfels, config.leaf_size_m
    sensor, clutter_ratio, returns_per_cell = given.sensor, given.clutter_ratio, given.returns_per_cell
    if sensor is None:
        assert given.poses is not None
        sensor = Sensor.of_rays(rays, given.poses, surface.noise)
    noise, true, box_cells = surface.noise, surface.true, given.box_cells

    def free_space() -> FreeSpace:
        return FreeSpace.of(
            rays if true is None else rays.select(true), noise, leaf_m, box_cells, num_threads
        )

    def view_statistics() -> ViewStatistics:
        known = learnt.with_intensity
        if scale is None or not known.any():
            return ViewStatistics.none()
        chosen = learnt if known.all() else learnt.select(known)
        assert chosen.intensities is not None
        return ViewStatistics.of(chosen, scale.to_unit(chosen.intensities), leaf_m)

    # Only grids, comparisons and files ask for these, which took a third of a fit. The map keeps the rays until then.
    deferred = config.returns.free_space
    return MapContents(
        field=field,
        origin=rays.origin,
        intensity_scale=scale,
        config=config,
        evidence=Evidence.of(returns, rays, leaf_keys, leaf_m, num_threads, given.visibility),
        free_space=Deferred(free_space) if deferred else FreeSpace.none,
        view_statistics=Deferred(view_statistics) if deferred else ViewStatistics.none,
        clutter_ratio=surfels.clutter_ratio() if clutter_ratio is None else clutter_ratio,
        returns_per_cell=surfels.returns_per_cell() if returns_per_cell is None else returns_per_cell,
        sensor=sensor,
        report=report,
    )


def _report(
    given: FitInput,
    learnt: Rays,
    surface: SurfaceReturns,
    field: Field,
    schedule: Schedule,
    config: FitConfig,
) -> dict[str, Any]:
    """Return the report of the map before the training."""
    cells, rows, with_intensity = len(field.table.leaf_keys()), field.table.num_rows, given.scale is not None
    sizes = {"returns": len(learnt), "cells": cells, "rows": rows}
    skipped: list[tuple[str, float | None]] = []
    if given.why_none_moving is not None:
        skipped.append((f"leaving out what moves: {given.why_none_moving}", None))
    skipped += skipped_parts(config, schedule, with_intensity=with_intensity, **sizes)
    outliers = 0 if learnt.intensities is None else len(learnt) - int(learnt.with_intensity.sum())
    return {
        "scans": len(given.rays.up_of_scan),
        "returns": given.rays.num_given + given.moving,
        "returns_used": surface.count,
        "ghosts": len(learnt) - surface.count,
        "moving": given.moving,
        "intensity_outliers": outliers,
        "noise": dataclasses.asdict(surface.noise),
        "leaf_cells": cells,
        "vertices": rows,
        "skipped": [words for words, _ in skipped],
        "skipped_s": [seconds for _, seconds in skipped],
        "iterations": schedule.iterations,
        "iterations_done": {"sdf": 0, "intensity": 0},
        "losses": {},
        "loss_history": {},
    }
