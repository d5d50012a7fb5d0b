# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From scans with poses to a map: the steps of a fit, in order."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from radarsdf.budget.estimate import check_fit
from radarsdf.budget.extent import check_extent
from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.intensity_scale import IntensityScale
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.skipped import Skipped, skipped_parts
from radarsdf.fitting.start import STARTS, Start
from radarsdf.fitting.stopping import Diverged, Interrupted
from radarsdf.fitting.surface import SurfaceReturns
from radarsdf.fitting.training import Training
from radarsdf.io.sequence import Scans
from radarsdf.map import queries
from radarsdf.map.contents import MapContents
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Evidence, ReturnsOfCells
from radarsdf.returns.gaps import bridged
from radarsdf.returns.movers import Standing
from radarsdf.returns.rays import Rays, prepare
from radarsdf.returns.reflectance import Reflectance
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.surfels import Surfels
from radarsdf.threads import Workers

# Of rough scenes the network knows less than of smooth ones: its answer counts so much less there, and the closed form
# the more. Measured on five real drives, which are rough, and on simulated scenes, which are not.
_LESS_IN_ROUGH_SCENES = 0.5


def fit(
    points: Iterable[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    intensities: Iterable[ArrayLike] | None = None,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
) -> RadarMap:
    """Fits a signed distance field, and with intensities a reflectance map, to radar returns.

    Parameters
    ----------
    points : iterable of F arrays, or Scans
        (N_i, 3) each: the returns of one scan, sensor frame, m. An iterator is asked for one after another, and they
        are not kept, unless Doppler is given. Of :class:`radarsdf.io.Scans`, as they are, their poses, intensities and
        Doppler are used where none are given here.
    poses : array_like, optional
        (F, 4, 4) T_world_sensor, m, one for each scan. Only `Scans` can do without.
    intensities : iterable of F arrays, optional
        (N_i,) each, sensor units. Without them the map has no intensity network.
    doppler_mps : sequence of F arrays, optional
        (N_i,) each: speed of each return along its ray, m/s; NaN where it was not measured. With them, returns that
        move are left out; see ``config.returns.drop_movers``.
    config : FitConfig, optional
        Settings of the fit. ``FitConfig.paper()`` has the published ones.
    progress : bool, optional
        Whether to show a progress bar. By default only on a terminal.
    checkpoint : path-like, optional
        File for the state of the training. It is written every half minute, and when the training is
        interrupted or done. If it exists, a fit of the same scans with the same configuration and number of
        threads goes on from it, and ends with the same bits as one without a stop. It is not removed when the
        fit is done.

    Returns
    -------
    RadarMap
        Its ``report`` has the times and counts of the fit. The same input, seed and number of threads give
        the same bits. With another number of threads the samples are the same, but the rounding differs, and
        with intensities also the dropout.

    Raises
    ------
    ValueError
        If scans or poses are invalid (see :func:`radarsdf.returns.rays.prepare`), a return is too far away,
        or the `checkpoint` is damaged or from another fit.
    MemoryError
        If the memory by :func:`radarsdf.estimate` exceeds ``config.max_memory_bytes``, or what the system has
        left.
    Interrupted
        A KeyboardInterrupt, after Ctrl-C. Its ``radar_map`` is the map so far.
    Diverged
        A FloatingPointError, if a loss or a parameter is not finite. Its ``radar_map`` is the last finite
        map.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=4)
    >>> radar_map = radarsdf.fit(scans.points, scans.poses)  # and scans.intensities, for radar_map.intensity(...)
    >>> distance_m = radar_map.sdf(scans.poses[:, :3, 3])  # of the sensor's positions: all in free space
    >>> bool((distance_m > 0).all())
    True
    """
    config = FitConfig() if config is None else config
    clock = _Clock()
    radar_map = None
    try:
        points, poses, intensities, doppler_mps = _given(points, poses, intensities, doppler_mps)
        standing = Standing.of(points, intensities, doppler_mps, config.returns)
        rays = prepare(standing.points, poses, standing.intensities, **config.returns.preparation)
        check_extent(rays, config)
        check_fit(rays, config)
        saved = None if checkpoint is None else Checkpoint(checkpoint, rays, config)
        clock.lap("prepare_s")
        # A map that is made in inference mode could not give gradients later.
        with torch.inference_mode(mode=False), Workers(config.num_threads) as workers:
            surface = SurfaceReturns.of(rays, config, workers.num_threads)
            clock.lap("ghosts_s")
            start = STARTS[config.training.start](surface, config, workers.num_threads)
            returns = start.returns_of_cells()
            field = _open_cells(start.leaf_keys(), returns, rays, config, workers.num_threads)
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
            noise, rough_share, kept = surface.noise, surface.surfels.rough_share(), surface.rays
            origin, scale = rays.origin, IntensityScale.of(rays.intensities)
            sensor = Sensor.of_rays(rays, poses, noise)
            close = _closing(rays, surface, config, workers.num_threads)
            counts = {
                "returns": rays.num_given + standing.movers,
                "returns_used": len(kept),
                "ghosts": len(rays) - len(kept),
                "movers": standing.movers,
                "noise": dataclasses.asdict(noise),
            }
            # Of many returns, gigabytes that nobody needs any more: the training has its own copy of the rays.
            del surface, start, returns
            training = Training(
                field, kept, rays, scale if config.trains_intensity else None, config, workers
            )
            del rays, kept
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
                report=counts | _report(config, field, training, counts, standing, workers.num_threads),
            )
            radar_map = RadarMap(
                close(contents) if close is not None and not config.trains_intensity else contents
            )
            training.run(progress, saved)
            if close is not None and config.trains_intensity:
                radar_map = RadarMap(close(contents))
    except KeyboardInterrupt as interruption:
        raise Interrupted(radar_map) from interruption
    except Diverged as error:
        error.radar_map = radar_map
        raise
    finally:
        if radar_map is not None:
            clock.lap("training_s")
            radar_map.report.update(clock.laps, loss_history=training.history.to_report())
            radar_map.field.requires_grad_(False)
    return radar_map


def _given(
    points: Iterable[ArrayLike] | Scans,
    poses: ArrayLike | None,
    intensities: Iterable[ArrayLike] | None,
    doppler_mps: Sequence[ArrayLike] | None,
) -> tuple[Iterable[ArrayLike], ArrayLike, Iterable[ArrayLike] | None, Sequence[ArrayLike] | None]:
    """The same, with what is not given taken from the scans."""
    if isinstance(points, Scans):
        scans, points = points, points.points  # first: it reads all there is, in one pass
        poses = scans.poses if poses is None else poses
        intensities = scans.intensities if intensities is None else intensities
        doppler_mps = scans.doppler_mps if doppler_mps is None else doppler_mps
    if poses is None:
        msg = "poses are missing: T_world_sensor (4, 4) of each scan"
        raise ValueError(msg)
    return points, poses, intensities, doppler_mps


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
    if not all(parameter.isfinite().all() for parameter in field.parameters()):
        msg = "what the training starts from is not finite: training.sigma_cells may be too small"
        raise Diverged(msg)


def _closing(
    rays: Rays, surface: SurfaceReturns, config: FitConfig, num_threads: int
) -> Callable[[MapContents], MapContents] | None:
    """Adds intensities, or what their network leaves of them, in closed form to a map. None if they are not wanted."""
    if rays.intensities is None or not config.closes_intensity:
        return None
    return functools.partial(
        _with_closed_form,
        rays=rays,
        intensities=rays.intensities,
        surfels=surface.surfels,
        num_threads=num_threads,
    )


def _with_closed_form(
    contents: MapContents, *, rays: Rays, intensities: NDArray[np.float32], surfels: Surfels, num_threads: int
) -> MapContents:
    scale, config = contents.intensity_scale, contents.config
    assert scale is not None
    share, unit = 0.0, scale.to_unit(intensities)
    if config.trains_intensity:
        share = 1 - _LESS_IN_ROUGH_SCENES * queries.roughness(contents)
        sensors = torch.from_numpy(rays.points - rays.directions * rays.ranges_m[:, None])
        answers = queries.intensity(contents, torch.from_numpy(rays.points), sensors)
        unit -= np.float32(share) * scale.to_unit(answers.numpy())
    found = Reflectance.of(rays, unit, surfels, config.leaf_size_m, num_threads, share)
    return dataclasses.replace(contents, reflectance=found)


def _report(
    config: FitConfig,
    field: Field,
    training: Training,
    counts: dict[str, Any],
    standing: Standing,
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
        closed_form=standing.intensities is not None and not config.trains_intensity,
    )
    if standing.why_none is not None:
        skipped.insert(0, Skipped(f"leaving out what moves: {standing.why_none}", None))
    return {
        "leaf_cells": len(field.cells.table.leaf_keys()),
        "vertices": field.cells.table.num_rows,
        "iterations": training.iterations,
        "iterations_done": training.iterations_done,
        "losses": training.losses,
        "skipped": [part.words for part in skipped],
        "skipped_s": [part.seconds for part in skipped],
    }


class _Clock:
    """Wall-clock seconds of each step."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
