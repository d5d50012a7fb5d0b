# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From rays to a map: the steps of a fit, in order."""

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

from radarsdf.budget.estimate import check_fit
from radarsdf.budget.extent import check_extent
from radarsdf.budget.schedule import Schedule
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.closed_form import ClosedForm
from radarsdf.fitting.skipped import Skipped, skipped_parts
from radarsdf.fitting.start import STARTS, Start
from radarsdf.fitting.stopping import Diverged, Interrupted
from radarsdf.fitting.surface import SurfaceReturns
from radarsdf.fitting.training import Training
from radarsdf.map.contents import MapContents
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Evidence, Looks, ReturnsOfCells, bridged
from radarsdf.returns.free_space import Passages
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import Rays
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.sums import ScanSums
from radarsdf.returns.view_statistics import Echoes
from radarsdf.threads import Workers


@dataclass(frozen=True)
class FitInput:
    """What a fit starts from."""

    rays: Rays
    """All rays, scan by scan."""
    scale: IntensityScale | None
    """Of their intensities."""
    poses: ArrayLike | None = None
    """(F, 4, 4) T_world_sensor of the scans. Only asked if there is no `sensor`."""
    movers: int = 0
    """Number of returns that were left out because they move."""
    why_no_movers: str | None = None
    """See :class:`radarsdf.returns.moving.Movers`."""
    inside: NDArray[np.bool_] | None = None
    """(N,) returns that the map is learnt from, whole leaf cells of them. The other rays only tell what they passed. None:
    all."""
    rough_share: float | None = None
    """Share of the returns that lie on no thin surface. None: of these returns."""
    returns_per_cell: float | None = None
    """Mean number of returns in the cells of surfels. None: of these returns."""
    sensor: Sensor | None = None
    """The radar. None: as these rays and poses show it."""
    box_cells: NDArray[np.int64] | None = None
    """(2, 3) leaf cells from the origin of the rays; what they passed outside [lower, upper) is not kept. None: all is."""
    sums: ScanSums | None = None
    """Over the scans of the rays, if they were kept up scan by scan. None: made here, of all at once."""
    looks: Looks | None = None
    """Likewise."""


def fit_rays(
    read: Callable[[], FitInput],
    config: FitConfig,
    *,
    progress: bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
) -> RadarMap:
    """Fits a map to what `read` gives. See :func:`radarsdf.fit`, also for errors.

    `read` is called here, so that nobody else holds the rays: they are let go before the training.
    """
    clock = Clock()
    try:
        # A map that is made in inference mode could not give gradients later.
        with torch.inference_mode(mode=False), Workers(config.num_threads) as workers:
            trained = _train(read, config, progress, checkpoint, clock, workers)
            contents = trained.contents
            # What a network that diverged leaves of the intensities can be anything.
            diverged = isinstance(trained.stop, Diverged) and config.trains_intensity
            if trained.closed_form is not None and not diverged:
                contents = trained.closed_form.added_to(contents, workers.num_threads)
    except KeyboardInterrupt as interruption:
        raise Interrupted(None) from interruption
    clock.lap("training_s")
    contents.report.update(clock.laps)
    contents.field.requires_grad_(False)
    radar_map = RadarMap(contents)
    if isinstance(trained.stop, Diverged):
        trained.stop.radar_map = radar_map
        raise trained.stop
    if trained.stop is not None:
        raise Interrupted(radar_map) from trained.stop
    return radar_map


@dataclass(frozen=True)
class _Known:
    """What is known without training, and what the training learns the rest from."""

    contents: MapContents
    """The map, with the field that the training starts from."""
    closed_form: ClosedForm | None
    """What intensities in closed form are found from."""
    surface: Rays
    """Returns that the surface is learnt from."""
    returns: Rays
    """Returns that intensities are learnt from: ghosts too."""
    schedule: Schedule
    """Of the training."""
    checkpoint: Checkpoint | None
    """Of the training."""


@dataclass(frozen=True)
class _Trained:
    """What is left of a training."""

    contents: MapContents
    """The map, but for intensities in closed form."""
    closed_form: ClosedForm | None
    """What they are found from."""
    stop: KeyboardInterrupt | Diverged | None
    """Why it ended early."""


def _train(
    read: Callable[[], FitInput],
    config: FitConfig,
    progress: bool | None,
    checkpoint: str | PathLike[str] | None,
    clock: Clock,
    workers: Workers,
) -> _Trained:
    """All but intensities in closed form. The training has a copy of its rays, 32 bytes a return, which is let go here."""
    contents, closed_form, training, saved = _begin(read, config, checkpoint, clock, workers)
    stop: KeyboardInterrupt | Diverged | None = None
    try:
        training.run(progress, saved)
    except (KeyboardInterrupt, Diverged) as early:
        stop = early
    contents.report.update(training.report())
    return _Trained(contents, closed_form, stop)


def _begin(
    read: Callable[[], FitInput],
    config: FitConfig,
    checkpoint: str | PathLike[str] | None,
    clock: Clock,
    workers: Workers,
) -> tuple[MapContents, ClosedForm | None, Training, Checkpoint | None]:
    """All before the first iteration. The rays that the training has a copy of are let go here."""
    known = _learn_directly(read, config, checkpoint, clock, workers.num_threads)
    training = Training(
        known.contents.field,
        known.surface,
        known.returns,
        known.contents.intensity_scale if config.trains_intensity else None,
        known.schedule,
        config,
        workers,
    )
    if known.checkpoint is not None:
        known.checkpoint.resume(training)
    return known.contents, known.closed_form, training, known.checkpoint


def _learn_directly(
    read: Callable[[], FitInput],
    config: FitConfig,
    checkpoint: str | PathLike[str] | None,
    clock: Clock,
    num_threads: int,
) -> _Known:
    """What the returns tell without training: noise, ghosts, cells, the field at first, evidence, and the radar."""
    given = read()
    rays, inside, scale = given.rays, given.inside, given.scale
    check_extent(rays, config)
    check_fit(rays, config, inside)
    saved = None if checkpoint is None else Checkpoint(checkpoint, rays, scale, config)
    clock.lap("prepare_s")
    surface = SurfaceReturns.of(rays, config, num_threads, inside, given.sums)
    learnt = rays if inside is None else rays.select(inside)
    clock.lap("ghosts_s")
    start = STARTS[config.training.start](surface, config, num_threads)
    returns = start.returns_of_cells()
    field = _open_cells(start.leaf_keys(), returns, learnt, config, num_threads)
    leaf_keys = field.cells.table.leaf_keys()
    clock.lap("occupied_cells_s")
    _initialise(field, start, config)
    evidence = Evidence.of(returns, rays, leaf_keys, config.leaf_size_m, num_threads, given.looks)
    passages = _passages(given, surface, config, num_threads)
    echoes = _echoes(learnt, scale, config)
    clock.lap("start_s")
    schedule = Schedule.of(
        config,
        surface_returns=len(surface.rays),
        returns=len(learnt),
        vertices=field.cells.table.num_rows,
        with_intensity=scale is not None and config.trains_intensity,
    )
    sensor, rough_share = given.sensor, given.rough_share
    if sensor is None:
        assert given.poses is not None
        sensor = Sensor.of_rays(rays, given.poses, surface.noise)
    if rough_share is None:
        rough_share = surface.surfels.rough_share()
    returns_per_cell = given.returns_per_cell
    if returns_per_cell is None:
        returns_per_cell = surface.surfels.returns_per_cell()
    contents = MapContents(
        field=field,
        origin=rays.origin,
        intensity_scale=scale,
        reflectance=None,
        config=config,
        evidence=evidence,
        passages=passages,
        echoes=echoes,
        rough_share=rough_share,
        returns_per_cell=returns_per_cell,
        sensor=sensor,
        report=_report(given, learnt, surface, field, schedule, config, num_threads),
    )
    closed_form = ClosedForm.of(learnt, surface, config)
    return _Known(contents, closed_form, surface.rays, learnt, schedule, saved)


def _open_cells(
    leaf_keys: NDArray[np.uint64], returns: ReturnsOfCells, rays: Rays, config: FitConfig, num_threads: int
) -> Field:
    """The field on the leaf cells in which a surface can lie, and on those that bridge gaps between them."""
    leaf_keys = bridged(leaf_keys, returns.keys, returns.counts, config.encoding.bridge_cells, num_threads)
    with_intensity = rays.intensities is not None and config.trains_intensity
    return Field(leaf_keys, config, with_intensity=with_intensity, num_threads=num_threads)


def _passages(given: FitInput, surface: SurfaceReturns, config: FitConfig, num_threads: int) -> Passages:
    """What the rays passed, of those that end at no ghost."""
    if not config.returns.passages:
        return Passages.none()
    rays = given.rays if surface.true is None else given.rays.select(surface.true)
    return Passages.of(rays, surface.noise, config.leaf_size_m, given.box_cells, num_threads)


def _echoes(rays: Rays, scale: IntensityScale | None, config: FitConfig) -> Echoes:
    """How strong the returns were, for comparisons, which need passages, too."""
    known = rays.with_intensity
    if not config.returns.passages or scale is None or not known.any():
        return Echoes.none()
    chosen = rays if known.all() else rays.select(known)
    assert chosen.intensities is not None
    return Echoes.of(chosen, scale.to_unit(chosen.intensities), config.leaf_size_m)


def _initialise(field: Field, start: Start, config: FitConfig) -> None:
    """Sets the parameters that the training starts from. Raises Diverged if one is not finite."""
    start.initialise(field, torch.Generator("cpu").manual_seed(config.seed))
    # A sum is finite only if all that it adds up is. To ask each takes ten times as long.
    if not all(parameter.detach().sum().isfinite() for parameter in field.parameters()):
        msg = "what the training starts from is not finite: training.sigma_cells may be too small"
        raise Diverged(msg)


def _report(
    given: FitInput,
    learnt: Rays,
    surface: SurfaceReturns,
    field: Field,
    schedule: Schedule,
    config: FitConfig,
    num_threads: int,
) -> dict[str, Any]:
    """What the map's report says before the training."""
    cells = field.cells.table
    skipped = skipped_parts(
        config,
        schedule,
        returns=len(learnt),
        cells=len(cells.leaf_keys()),
        rows=cells.num_rows,
        with_intensity=field.intensity_network is not None,
        threads=num_threads,
        closed_form=given.scale is not None and not config.trains_intensity,
    )
    if given.why_no_movers is not None:
        skipped.insert(0, Skipped(f"leaving out what moves: {given.why_no_movers}", None))
    wild = 0 if learnt.intensities is None else len(learnt) - int(learnt.with_intensity.sum())
    return {
        "scans": len(given.rays.up_of_scan),
        "returns": given.rays.num_given + given.movers,
        "returns_used": len(surface.rays),
        "ghosts": len(learnt) - len(surface.rays),
        "movers": given.movers,
        "wild_intensities": wild,
        "noise": dataclasses.asdict(surface.noise),
        "leaf_cells": len(cells.leaf_keys()),
        "vertices": cells.num_rows,
        "skipped": [part.words for part in skipped],
        "skipped_s": [part.seconds for part in skipped],
    }


class Clock:
    """Wall-clock seconds of each step."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
