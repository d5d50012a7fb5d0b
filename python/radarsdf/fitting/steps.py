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
from numpy.typing import NDArray

from radarsdf.budget.estimate import check_fit
from radarsdf.budget.extent import check_extent
from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.intensity_scale import IntensityScale
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.closed_form import ClosedForm
from radarsdf.fitting.skipped import Skipped, skipped_parts
from radarsdf.fitting.start import STARTS, Start
from radarsdf.fitting.stopping import Diverged, Interrupted
from radarsdf.fitting.surface import SurfaceReturns
from radarsdf.fitting.training import Training
from radarsdf.map.contents import MapContents
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Evidence, ReturnsOfCells
from radarsdf.returns.gaps import bridged
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.sensor import Sensor
from radarsdf.threads import Workers


@dataclass
class FitInput:
    """What a fit starts from."""

    rays: Rays | None
    """All rays, scan by scan. A fit takes them away, so that they are in memory no longer than it needs them."""
    scale: IntensityScale | None
    """Of their intensities."""
    sensor_of: Callable[[Rays, SensorNoise], Sensor]
    """The radar, once its noise is known."""
    movers: int = 0
    """Number of returns that were left out because they move."""
    why_no_movers: str | None = None
    """See :class:`radarsdf.returns.movers.Movers`."""
    inside: NDArray[np.bool_] | None = None
    """(N,) returns that the map is learnt from, whole leaf cells of them. The other rays only tell what they passed. None:
    all."""
    rough_share: float | None = None
    """Share of the returns that lie on no thin surface. None: of these returns."""


def fit_rays(
    given: FitInput,
    config: FitConfig,
    *,
    progress: bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
    clock: Clock | None = None,
) -> RadarMap:
    """Fits a map. See :func:`radarsdf.fit`, also for errors; `clock` has counted the time since the beginning."""
    clock = Clock() if clock is None else clock
    rays, inside, given.rays = given.rays, given.inside, None
    assert rays is not None
    radar_map = None
    try:
        check_extent(rays, config)
        check_fit(rays, config, inside)
        saved = None if checkpoint is None else Checkpoint(checkpoint, rays, given.scale, config)
        clock.lap("prepare_s")
        # A map that is made in inference mode could not give gradients later.
        with torch.inference_mode(mode=False), Workers(config.num_threads) as workers:
            surface = SurfaceReturns.of(rays, config, workers.num_threads, inside)
            learnt = rays if inside is None else rays.select(inside)
            clock.lap("ghosts_s")
            start = STARTS[config.training.start](surface, config, workers.num_threads)
            returns = start.returns_of_cells()
            field = _open_cells(start.leaf_keys(), returns, learnt, config, workers.num_threads)
            clock.lap("occupied_cells_s")
            _initialise(field, start, config)
            evidence = Evidence.of(
                returns,
                rays,
                field.cells.table.leaf_keys(),
                config.leaf_size_m,
                workers.num_threads,
            )
            clock.lap("start_s")
            rough_share = surface.surfels.rough_share() if given.rough_share is None else given.rough_share
            noise, kept, origin, scale = surface.noise, surface.rays, rays.origin, given.scale
            sensor = given.sensor_of(rays, noise)
            closed_form = ClosedForm(learnt, inside, surface, config, workers.num_threads)
            counts = {
                "scans": len(rays.up_of_scan),
                "returns": rays.num_given + given.movers,
                "returns_used": len(kept),
                "ghosts": len(learnt) - len(kept),
                "movers": given.movers,
                "wild_intensities": 0
                if learnt.intensities is None
                else len(learnt) - int(learnt.with_intensity.sum()),
                "noise": dataclasses.asdict(noise),
            }
            # Of many returns, gigabytes that nobody needs any more: the training has its own copy of the rays.
            del surface, start, returns, rays
            training = Training(
                field, kept, learnt, scale if config.trains_intensity else None, config, workers
            )
            del learnt, kept
            history = training.history
            if saved is not None:
                saved.resume(training)
            # The map is made before the training, which changes its field: Interrupted and Diverged can hand
            # it over.
            contents = MapContents(
                field=field,
                origin=origin,
                intensity_scale=scale,
                reflectance=None,
                config=config,
                evidence=evidence,
                rough_share=rough_share,
                sensor=sensor,
                report=counts | _report(config, field, training, counts, given, workers.num_threads),
            )
            contents = closed_form.added(contents, trained=False)
            radar_map = RadarMap(contents)
            training.run(progress, saved)
            del training  # its copy of the rays takes 32 bytes a return
            radar_map = RadarMap(closed_form.added(contents, trained=True))
    except KeyboardInterrupt as interruption:
        raise Interrupted(radar_map) from interruption
    except Diverged as error:
        error.radar_map = radar_map
        raise
    finally:
        if radar_map is not None:
            clock.lap("training_s")
            radar_map.report.update(clock.laps, loss_history=history.to_report())
            radar_map.field.requires_grad_(False)
    return radar_map


def _open_cells(
    leaf_keys: NDArray[np.uint64], returns: ReturnsOfCells, rays: Rays, config: FitConfig, num_threads: int
) -> Field:
    """The field on the leaf cells in which a surface can lie, and on those that bridge gaps between them."""
    leaf_keys = bridged(leaf_keys, returns.keys, returns.counts, config.encoding.bridge_cells, num_threads)
    with_intensity = rays.intensities is not None and config.trains_intensity
    return Field(leaf_keys, config, with_intensity=with_intensity, num_threads=num_threads)


def _initialise(field: Field, start: Start, config: FitConfig) -> None:
    """Sets the parameters that the training starts from. Raises Diverged if one is not finite."""
    start.initialise(field, torch.Generator("cpu").manual_seed(config.seed))
    # A sum is finite only if all that it adds up is. To ask each takes ten times as long.
    if not all(parameter.detach().sum().isfinite() for parameter in field.parameters()):
        msg = "what the training starts from is not finite: training.sigma_cells may be too small"
        raise Diverged(msg)


def _report(
    config: FitConfig,
    field: Field,
    training: Training,
    counts: dict[str, Any],
    given: FitInput,
    threads: int,
) -> dict[str, Any]:
    """What the map's report says of cells and training. The training goes on to fill what counts it."""
    skipped = skipped_parts(
        config,
        training.schedule,
        returns=counts["returns_used"] + counts["ghosts"],
        cells=len(field.cells.table.leaf_keys()),
        rows=field.cells.table.num_rows,
        with_intensity=field.intensity_network is not None,
        threads=threads,
        closed_form=given.scale is not None and not config.trains_intensity,
    )
    if given.why_no_movers is not None:
        skipped.insert(0, Skipped(f"leaving out what moves: {given.why_no_movers}", None))
    return {
        "leaf_cells": len(field.cells.table.leaf_keys()),
        "vertices": field.cells.table.num_rows,
        "iterations": training.iterations,
        "iterations_done": training.iterations_done,
        "losses": training.losses,
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
