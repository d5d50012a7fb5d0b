# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Memory and time of a fit before it begins, what it skips, and errors where it cannot be done."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf._core import FEATURE_DIM, CellSet
from radarsdf.checks import instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.presets import PAPER
from radarsdf.field.neural_field import (
    SDF_HIDDEN,
    fourier_width,
    intensity_widths,
    parameters_of,
    sdf_widths,
    weights_of,
)
from radarsdf.fitting.average import BAND_CELLS, TRUNCATION_CELLS
from radarsdf.fitting.sampling import NEAR_BAND_CELLS, seen_jointly
from radarsdf.fitting.schedule import Schedule
from radarsdf.memory import limit_bytes
from radarsdf.returns.rays import Rays, prepare
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN
from radarsdf.threads import resolve_num_threads

# Seconds on one thread, measured on the machine that BENCHMARK.md names: `python -m bench.estimates durations`
# measures fits and prints them. The estimates of twenty fits were 0.65 to 1.24 times their processor time.
SECONDS = {
    "return": 1.7e-06,
    "cell": 9.4e-07,
    "moved row": 7.5e-09,
    "iteration": 9.3e-4,
    "encoded number": 2.2e-9,
    "multiplication": 2.6e-11,
}
_SECONDS_OF_FREE_SPACE = 1e-6  # a return
_SHARED = ("encoded number", "multiplication")  # done by all threads; one thread does the other kinds

# Bytes. Measured as peaks of fits of 1e4 to 3e6 returns of a street, over the memory of the process before
# the fit; `python -m bench.estimates memory` repeats it.
_ALWAYS = 35e6  # code that the fit loads, stacks and arenas of the threads
_PER_RETURN = 30.0
_PER_INTENSITY = 20.0
_PER_RETURN_AGAIN = 110.0  # if the intensity stage uses other returns than the sdf stage
_PER_RETURN_OF_CLOSED_FORM = 150.0  # cells of intensities in closed form
_PER_RETURN_CLEANED = (
    200.0  # rays with and without ghosts, and the training's copy, for which the others make room
)
_PER_CELL = 215.0
_PER_CELL_AVERAGED = 30.0  # corners of the cell, and distances there
_PER_BLOCK = 300.0  # of 8 × 8 × 8 leaf cells that rays crossed
_COPIES = 4  # of each parameter that learns: value, two moments of Adam, last finite value
_PER_ROW = 8.0  # if only the touched rows move: marks of Adam

# Cells of a map for each cell with returns, where these have many returns each, and more where they have few: cells of
# dense surfaces share what is near. Measured on `hugin`, `oculii` and `wall`, of 4 to all scans, with cells of 0.1 to 0.5 m:
# within a factor of 1.5.
_CELLS, _CELLS_SPARSE = 1.4, 3.6
_AVERAGED = 1.35  # times as many in stage 1, whose band is wider
# Rows for each of these cells, likewise: within a factor of 2.
_ROWS = {"tri-quadtree": (0.7, 1.3), "octree": (2.3, 2.5)}
_ROWS_AVERAGED = (1.7, 1.5)
_BLOCKS = 0.05


@dataclass(frozen=True)
class Estimate:
    """Memory and time that a fit will take."""

    peak_memory_bytes: int
    """Peak above the memory that the process has before. Within a factor of 2 on scans like those of the
    measurement."""
    seconds: float
    """Wall-clock time. Within a factor of 2 on the quiet machine of the measurement. Of another machine, only
    the number of processors is taken into account."""
    returns: int
    """Number of returns between `min_range_m` and `max_range_m`."""
    leaf_cells: int
    """Number of leaf cells. Within a factor of 2."""
    vertices: int
    """Number of vertices, which is the number of rows of features. Within a factor of 2."""
    iterations: dict[str, int]
    """Iterations of the stages `sdf` and `intensity`. Joint iterations count for both."""

    def __str__(self) -> str:
        return (
            f"{self.returns} returns, about {self.leaf_cells} leaf cells and {self.vertices} vertices, "
            f"{self.iterations['sdf']} + {self.iterations['intensity']} iterations: "
            f"about {self.peak_memory_bytes / 1e9:.2f} GB and {self.seconds:.0f} s"
        )


def estimate(
    points: Sequence[ArrayLike],
    poses: ArrayLike,
    intensities: Sequence[ArrayLike] | None = None,
    *,
    config: FitConfig | None = None,
) -> Estimate:
    """Estimates memory and time of :func:`radarsdf.fit` with the same arguments, much faster than a fit.

    Parameters
    ----------
    points, poses, intensities, config
        As for :func:`radarsdf.fit`.

    Returns
    -------
    Estimate
        Memory in bytes, time in s, and the size of the map.

    Raises
    ------
    ValueError
        If scans or poses are invalid, see :func:`radarsdf.returns.rays.prepare`.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=4)
    >>> estimate = radarsdf.estimate(scans.points, scans.poses)
    >>> 10e6 < estimate.peak_memory_bytes < 1e9
    True
    """
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    rays = prepare(points, poses, intensities, **config.preparation)
    check_extent(rays, config)
    return estimate_rays(rays, config)


def estimate_rays(rays: Rays, config: FitConfig, inside: NDArray[np.bool_] | None = None) -> Estimate:
    """:func:`estimate` for rays, of which a map is made of those `inside`, (N,). None: all."""
    learnt, threads = rays if inside is None else rays.select(inside), resolve_num_threads(config.num_threads)
    occupied = CellSet(config.leaf_size_m)
    occupied.insert(np.ascontiguousarray(learnt.points), threads)
    return _estimate(learnt, len(rays), len(occupied.sorted_keys(threads)), config)


def _estimate(learnt: Rays, num_rays: int, with_returns: int, config: FitConfig) -> Estimate:
    """Of a map that is made of the returns `learnt`, of so many rays. `with_returns`: leaf cells that hold them."""
    threads = resolve_num_threads(config.num_threads)
    cells, rows = _sizes(len(learnt), with_returns, config)
    with_network = learnt.intensities is not None and config.trains_intensity
    schedule = Schedule.of(
        config, surface_returns=len(learnt), returns=len(learnt), vertices=rows, with_intensity=with_network
    )
    return Estimate(
        peak_memory_bytes=_fit_bytes(learnt, num_rays, cells, rows, schedule, config),
        seconds=seconds_of(config, schedule, num_rays, cells, rows, with_network, threads),
        returns=len(learnt),
        leaf_cells=cells,
        vertices=rows,
        iterations=schedule.iterations,
    )


def _sizes(returns: int, with_returns: int, config: FitConfig) -> tuple[int, int]:
    """Numbers of leaf cells and of rows of features, or of corners, of a map. `with_returns`: leaf cells that hold returns."""
    sparse = with_returns / returns
    cells = with_returns * (_CELLS + _CELLS_SPARSE * sparse**3) * (1 if config.train else _AVERAGED)
    of_cell, of_sparse = _ROWS[config.encoding.kind] if config.train else _ROWS_AVERAGED
    return round(cells), round(cells * (of_cell + of_sparse * sparse**6))


def _fit_bytes(
    learnt: Rays, num_rays: int, cells: int, rows: int, schedule: Schedule, config: FitConfig
) -> int:
    count, with_intensity = len(learnt), learnt.intensities is not None
    memory = _ALWAYS + count * _PER_RETURN + cells * _PER_CELL
    if config.returns.passages:
        memory += cells * _BLOCKS * _PER_BLOCK
    if with_intensity and config.closes_intensity:
        memory += count * _PER_RETURN_OF_CLOSED_FORM
    memory += _training_bytes(count, rows, schedule, config) if config.train else cells * _PER_CELL_AVERAGED
    return int(max(memory, num_rays * _PER_RETURN_CLEANED))


def _training_bytes(count: int, rows: int, schedule: Schedule, config: FitConfig) -> float:
    threads = resolve_num_threads(config.num_threads)
    networks, with_intensity = parameters_of(sdf_widths(config)), schedule.intensity_iterations > 0
    memory = 0.0
    if with_intensity:
        networks += parameters_of(intensity_widths(config))
        memory += count * (_PER_INTENSITY + config.returns.drop_ghosts * _PER_RETURN_AGAIN)
    memory += 4 * networks * (_COPIES + threads)
    normals = with_intensity and config.networks.normals
    gradients = 0  # of all rows, in a batch
    if not config.moves_rows(with_intensity):
        # Each thread has one. Through normals the loss sees the features twice: two gradients, and their sum.
        gradients = 3 * threads if normals else 1
    memory += 4 * rows * FEATURE_DIM * (_COPIES + gradients) + rows * _PER_ROW
    # A batch in encodings, hidden layers and their gradients; normals need gradients of gradients.
    encoding = config.encoding.num_levels * FEATURE_DIM + fourier_width(config)
    numbers = schedule.batch_size * (encoding + sum(SDF_HIDDEN))
    numbers += schedule.intensity_batch_size * (encoding + sum(config.networks.intensity_hidden))
    return memory + 4 * numbers * (3 if normals else 1)


def seconds_of(
    config: FitConfig,
    schedule: Schedule,
    returns: int,
    cells: int,
    rows: int,
    with_intensity: bool,
    threads: int,
) -> float:
    """Wall-clock seconds of a fit. `with_intensity`: with an intensity network."""
    work = work_of(config, schedule, returns=returns, cells=cells, rows=rows, with_intensity=with_intensity)
    threads = min(threads, processors())  # more threads than processors do not help
    return sum(SECONDS[kind] * amount / (threads if kind in _SHARED else 1) for kind, amount in work.items())


def work_of(
    config: FitConfig, schedule: Schedule, *, returns: int, cells: int, rows: int, with_intensity: bool
) -> dict[str, float]:
    """Amount of each kind of work in :data:`SECONDS` for a fit, all threads together.

    `returns`, `cells`, `rows`: numbers of returns, leaf cells and rows of features.
    """
    work = dict.fromkeys(SECONDS, 0.0) | {"return": float(returns), "cell": float(cells)}
    if not config.train:
        return work
    training, normals = config.training, config.networks.normals
    iterations = schedule.sdf_iterations
    joint = iterations if with_intensity and training.joint else 0
    later = max(0, schedule.intensity_iterations - joint)
    of_both = seen_jointly(config, schedule.batch_size)
    # Units: a forward pass of a sample. Forward and backward take 3. Normals take a backward pass of their
    # own, and their gradient two more: 9 in all, or 3 if the field is frozen.
    passes, frozen_passes = (9, 3) if normals and with_intensity else (3, 1)
    evaluations = passes * iterations * schedule.batch_size
    evaluations += frozen_passes * later * schedule.intensity_batch_size
    sdf, intensity = weights_of(sdf_widths(config)), weights_of(intensity_widths(config))
    multiplied = sdf * evaluations + intensity * 3 * (joint * of_both + later * schedule.intensity_batch_size)
    return work | {
        "moved row": float(rows * iterations * (not config.moves_rows(with_intensity))),
        "iteration": float(iterations + later),
        "encoded number": float(sdf_widths(config)[0] * evaluations),
        "multiplication": float(multiplied),
    }


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def skipped_parts(
    config: FitConfig,
    schedule: Schedule,
    *,
    returns: int,
    cells: int,
    rows: int,
    with_intensity: bool,
    threads: int,
) -> list[tuple[str, float | None]]:
    """Parts of the method that a fit does not run, with the reason, and the seconds that this saves by :data:`SECONDS`."""

    def seconds(config: FitConfig, schedule: Schedule, with_network: bool) -> float:
        return seconds_of(config, schedule, returns, cells, rows, with_network, threads)

    def scheduled(config: FitConfig, with_network: bool) -> Schedule:
        return Schedule.of(
            config, surface_returns=returns, returns=returns, vertices=rows, with_intensity=with_network
        )

    with_network = with_intensity and config.trains_intensity
    ours_s = seconds(config, schedule, with_network)
    skipped: list[tuple[str, float | None]] = []
    if not config.train:
        trained = config.override(train=True)
        s = seconds(trained, scheduled(trained, False), False) - ours_s
        skipped.append(("training of the surface: it is averaged", s))
    if not config.returns.passages:
        words = "free space and mean intensities by view, which grids and comparisons need: returns.passages is off"
        skipped.append((words, _SECONDS_OF_FREE_SPACE * returns))
    if not with_network:
        why = "intensities are in closed form" if with_intensity else "there are no intensities"
        trained = config.override(train=True)
        surface_s, both_s = (
            seconds(trained, scheduled(trained, with_it), with_it) for with_it in (False, True)
        )
        skipped.append((f"the intensity network: {why}", both_s - surface_s))
    else:
        for name, setting in (("normals", "normals"), ("geometry feature", "geometry_feature_dim")):
            if not getattr(config.networks, setting):
                used = config.override(networks={setting: PAPER["networks"][setting]})
                words = f"the {name}, which the intensity network does not use"
                skipped.append((words, seconds(used, schedule, with_network) - ours_s))
    if config.train and schedule.passes < 1 and config.training.sdf_iterations is None:
        why = "the others were enough" if config.effort >= 1 else f"effort is {config.effort:g}"
        whole = math.ceil(schedule.sdf_iterations / schedule.passes)
        used = config.override(training={"sdf_iterations": whole})
        words = f"{1 - schedule.passes:.0%} of the samples: {why}"
        skipped.append((words, seconds(used, scheduled(used, with_network), with_network) - ours_s))
    if config.train and config.moves_rows(with_network):
        words = "in each iteration, updates of features that its samples did not use"
        skipped.append((words, SECONDS["moved row"] * rows * schedule.sdf_iterations))
    return skipped


def check_fit(rays: Rays, config: FitConfig, inside: NDArray[np.bool_] | None = None) -> None:
    """Raises a MemoryError if a fit needs more than `max_memory_bytes`, or than the system has left.

    `inside`: as of :func:`estimate_rays`.
    """
    available = limit_bytes(config.max_memory_bytes)
    # No more cells hold returns than there are returns. If so many are small enough, they need not be counted.
    if available is None or _estimate(rays, len(rays), len(rays), config).peak_memory_bytes <= available:
        return
    expected = estimate_rays(rays, config, inside)
    if expected.peak_memory_bytes > available:
        msg = (
            f"the fit would take about {expected.peak_memory_bytes / 1e9:.2f} GB for {expected.leaf_cells} leaf cells "
            f"and {expected.returns} returns, of {available / 1e9:.2f}: use larger cells (leaf_size_m), drop far "
            "returns (max_range_m), or set max_memory_bytes if the estimate is too high"
        )
        raise MemoryError(msg)


def check_extent(rays: Rays, config: FitConfig) -> None:
    """Raises a ValueError if a return lies where there are no cells: one outlier must not be met in the middle of the work."""
    limit_m = MAX_CELLS_FROM_ORIGIN * config.leaf_size_m
    reach_m = config.metres(NEAR_BAND_CELLS if config.train else max(BAND_CELLS, TRUNCATION_CELLS))
    if np.abs(rays.points).max() + reach_m > limit_m:
        distance_m = np.abs(rays.points).max(axis=1) + reach_m
        outside = int((distance_m > limit_m).sum())
        msg = (
            f"{outside} of {len(rays)} returns are not within a million cells of {config.leaf_size_m} m of the sensors' mean "
            f"position, the furthest {distance_m.max():.3g} m away: drop them (max_range_m), use larger cells, or split "
            "scans so far apart"
        )
        raise ValueError(msg)
