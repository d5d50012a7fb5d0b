"""Schedule of a fit, estimates of its memory and time, its skipped parts, and checks of its feasibility."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from radarsdf.arrays import ArrayLike, Bools
from radarsdf.checks import check, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import FEATURE_DIM, CellSet
from radarsdf.field.field import intensity_widths, sdf_widths, weights_of
from radarsdf.fitting.sampling import FREE_SAMPLES, NEAR_BAND_CELLS, NEAR_SAMPLES, near_and_labelled
from radarsdf.fitting.surface_returns import BAND_CELLS, TRUNCATION_CELLS
from radarsdf.memory import available_bytes
from radarsdf.returns.ghosts import FEWEST_SAMPLED
from radarsdf.returns.rays import Rays, prepare
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN
from radarsdf.threads import resolve_num_threads

# Passes of the sdf stage over the samples, within the limits below. If these conflict, the minimum number of iterations
# takes precedence over the maximum of passes and of samples. Measured with SOAP: 0.6 of Adam's iterations are as good to
# 0.1 points of F-score; half of the passes lose 0.2.
_SDF_PASSES = 0.6
_LEAST_SDF_ITERATIONS = 150  # with fewer, the surface of a small scene is unfinished
_ENOUGH_SDF_ITERATIONS = 180  # with fewer, the networks have not converged
_MOST_SDF_PASSES = 1.2  # with more over few returns, the field memorises their noise
_MOST_SAMPLES_PER_VERTEX = 20.0
# If the limit on samples allows more iterations than this, half of it. Measured on `hugin` and `oculii` with 600 scans and
# on eight `hugin` side by side: 0.0 to 0.1 points of F-score less in half the training.
_MANY_SDF_ITERATIONS = 300
# Beyond this, batches grow: one of the usual size covers little of so large a map.
_MOST_SDF_ITERATIONS = 5000
# Rows of features beyond which they and the state of their optimiser, 64 bytes, exceed the caches. Batches then consist of
# runs of neighbouring rays, which share rows. Measured: iterations at two million returns take 0.8 of the time. On `hugin`,
# where it gains nothing, F-scores fall by 0.04 points and intensities are 0.4 % worse.
_ROWS_IN_CACHES, _NEIGHBOURS = 500_000, 8

# Passes of the intensity network's training over the samples near the surface, joint iterations included, within the
# limits below. Measured with SOAP: 0.4 of Adam's iterations have the same error to 0.4 %.
_INTENSITY_PASSES = 0.65
_LEAST_INTENSITY_ITERATIONS = 500  # with fewer, it has not converged on a small scene
_MOST_INTENSITY_ITERATIONS = 1750
# Minimum after the joint iterations, during which the field still changes.
_LEAST_INTENSITY_STAGE = 300
# Beyond this, iterations of the sdf stage that train the surface alone are interspersed.
_MOST_JOINT_ITERATIONS = _MOST_INTENSITY_ITERATIONS - _LEAST_INTENSITY_STAGE

_HALF_DROPOUT_PASSES = 2.5  # uses of each sample at which dropout has half of the configured rate


@dataclass(frozen=True)
class Schedule:
    """Batch sizes and iterations of the sdf stage and the intensity stage. Joint iterations, of the first, count for both."""

    batch_size: int = 0  # samples in an iteration of the sdf stage
    neighbours: int = 1  # length of the runs of neighbouring rays in a batch
    sdf_iterations: int = 0
    passes: float = 0.0  # passes of the sdf stage over the samples
    joint_iterations: int = 0
    intensity_iterations: int = 0  # iterations that train the intensity network
    intensity_batch_size: int = 0
    dropout_scale: float = 0.0  # factor on the dropout

    @classmethod
    def of(cls, config: FitConfig, *, surface_returns: int, vertices: int, labelled: list[int]) -> "Schedule":
        """Compute the schedule. `labelled`: numbers of returns of each radar, ghosts included; empty without their network."""
        if not config.train:
            return cls()
        training = config.training
        samples = surface_returns * (NEAR_SAMPLES + FREE_SAMPLES)
        batch_size, iterations = training.batch_size, training.sdf_iterations
        if iterations is None:
            batch_size, iterations = _sdf_schedule(config, samples, vertices)
        neighbours = _NEIGHBOURS if min(vertices, surface_returns) > _ROWS_IN_CACHES else 1
        surface = (batch_size, neighbours, iterations, iterations * batch_size / samples)
        if not labelled:
            return cls(*surface)
        samples = sum(labelled) * NEAR_SAMPLES
        intensity_batch_size = training.intensity_batch_size
        joint_iterations, intensity_iterations = iterations, training.intensity_iterations
        if intensity_iterations is None:
            joint_iterations = min(iterations, max(1, round(config.effort * _MOST_JOINT_ITERATIONS)))
            intensity_batch_size = min(intensity_batch_size, samples)
            size, most = training.intensity_batch_size, _MOST_INTENSITY_ITERATIONS
            # Radars see a place from different sides: each of a rig gets the iterations of a fit of its returns alone.
            of_radars = [math.ceil(_INTENSITY_PASSES * (n * NEAR_SAMPLES) / size) for n in labelled if n]
            wanted = sum(min(max(own, _LEAST_INTENSITY_ITERATIONS), most) for own in of_radars)
            alone = max(wanted - joint_iterations, _LEAST_INTENSITY_STAGE)
            intensity_iterations = max(1, joint_iterations + round(config.effort * alone))
        if training.intensity_in_free_space:  # the samples are those of the sdf stage
            intensity_batch_size = batch_size
        # A frequently used sample is easily memorised. Measured: constant dropout for all scenes (0.7 and 0.2)
        # is as good on sparse ones, but costs 2 % on a dense one, which uses its samples twice.
        times_used = intensity_iterations * intensity_batch_size / samples
        dropout_scale = times_used / (times_used + _HALF_DROPOUT_PASSES)
        return cls(*surface, joint_iterations, intensity_iterations, intensity_batch_size, dropout_scale)

    @property
    def iterations(self) -> dict[str, int]:
        return {"sdf": self.sdf_iterations, "intensity": self.intensity_iterations}


def _sdf_schedule(config: FitConfig, samples: int, vertices: int) -> tuple[int, int]:
    # With few returns, a batch of more than one pass is redundant. Measured on 20 to 300 returns of four simulated
    # scenes: errors are as small, and 20 take a quarter of the time.
    batch_size = min(config.training.batch_size, samples)
    one_pass = samples / batch_size
    wanted = max(_SDF_PASSES * one_pass, min(_ENOUGH_SDF_ITERATIONS, _MOST_SDF_PASSES * one_pass))
    most = _MOST_SAMPLES_PER_VERTEX * vertices / batch_size
    wanted = min(wanted, max(min(most, _MANY_SDF_ITERATIONS), most / 2))
    iterations = max(1, round(config.effort * max(_LEAST_SDF_ITERATIONS, math.ceil(wanted))))
    if iterations <= _MOST_SDF_ITERATIONS:
        return batch_size, iterations
    return math.ceil(batch_size * iterations / _MOST_SDF_ITERATIONS), _MOST_SDF_ITERATIONS


# Seconds of one thread, measured on the machine named in BENCHMARK.md. The estimates of twenty fits were 0.65 to 1.24
# times their processor time; reproduce with `python -m bench.estimates durations`.
_S_PER_RETURN, _S_PER_CELL = 1.7e-6, 9.4e-7
_S_PER_ITERATION, _S_PER_MOVED_ROW = 9.3e-4, 7.5e-9
_S_PER_INPUT, _S_PER_MULTIPLICATION = 2.2e-9, 2.6e-11  # of a network, which all threads share

# Bytes, measured as peaks of fits with 1e4 to 3e6 returns of a street; reproduce with `python -m bench.estimates memory`.
_ALWAYS = 35e6  # loaded code, stacks and arenas of the threads
_PER_RETURN, _PER_RETURN_CLEANED = 30.0, 200.0
_PER_RETURN_OF_INTENSITY = 150.0
_PER_CELL, _PER_CELL_AVERAGED = 60.0, 230.0
_COPIES = 3  # numbers for each feature: value, state of Adam, last finite value

# Ratio of leaf cells to cells with returns, and of feature rows to leaf cells: in dense scans, and the addition in sparse
# ones. Measured on `hugin`, `oculii` and `wall`, with 4 to all scans and cells of 0.1 to 0.5 m: within a factor of 2.
_CELLS, _CELLS_AVERAGED = (1.4, 3.6), (1.9, 4.9)
_ROWS, _ROWS_AVERAGED = {"tri-quadtree": (0.7, 1.3), "octree": (2.3, 2.5)}, (1.7, 1.5)


@dataclass(frozen=True)
class Estimate:
    """Estimated memory and time of a fit."""

    peak_memory_bytes: int
    """Peak memory in addition to that of the process before. Within a factor of 2."""
    seconds: float
    """Wall-clock time. Within a factor of 2 on the machine of BENCHMARK.md."""
    returns: int
    """Number of returns between `min_range_m` and `max_range_m`."""
    leaf_cells: int
    """Number of leaf cells. Within a factor of 2."""
    vertices: int
    """Number of vertices of the cells. Within a factor of 2."""
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
    """Estimate memory and time of :func:`radarsdf.fit` from the numbers of returns and of cells with returns.

    Parameters
    ----------
    points : sequence of F arrays
        (N_i, 3) each: the returns of one scan, sensor frame, m.
    poses : array_like
        (F, 4, 4) T_world_sensor, m.
    intensities : sequence of F arrays, optional
        (N_i,) each, sensor units.
    config : FitConfig, optional
        Settings of the fit.

    Returns
    -------
    Estimate
        Memory in bytes, time in s, and the size of the map.

    Raises
    ------
    ValueError
        If scans or poses are invalid, or a return is too far away, as for :func:`radarsdf.fit`.

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


def estimate_rays(rays: Rays, config: FitConfig, inside: Bools | None = None) -> Estimate:
    """:func:`estimate` for rays of which those `inside`, (N,), are fitted; None for all."""
    threads = resolve_num_threads(config.num_threads)
    points = rays.points if inside is None else rays.points[inside]
    occupied = CellSet(config.leaf_size_m)
    occupied.insert(np.ascontiguousarray(points), threads)
    return _estimate(rays, config, len(points), len(occupied))


def _estimate(rays: Rays, config: FitConfig, returns: int, with_returns: int) -> Estimate:
    sparse = with_returns / returns
    of_dense, of_sparse = _CELLS if config.train else _CELLS_AVERAGED
    cells = round(with_returns * (of_dense + of_sparse * sparse**3))
    of_dense, of_sparse = _ROWS[config.encoding.kind] if config.train else _ROWS_AVERAGED
    rows = round(cells * (of_dense + of_sparse * sparse**6))
    with_network = rays.intensities is not None and config.trains_intensity
    labelled = [returns // rays.num_sensors] * rays.num_sensors if with_network else []
    schedule = Schedule.of(config, surface_returns=returns, vertices=rows, labelled=labelled)
    memory = _ALWAYS + returns * _PER_RETURN + cells * (_PER_CELL if config.train else _PER_CELL_AVERAGED)
    if config.train:
        # Gradients of all rows, unless only touched rows move; with normals two for each thread, and their sum.
        normals = with_network and config.networks.normals
        all_rows = 3 * resolve_num_threads(config.num_threads) if normals else 1
        gradients = 0 if config.moves_rows(with_network) else all_rows
        memory += 4 * rows * FEATURE_DIM * (_COPIES + gradients)
        memory += 4 * schedule.batch_size * sum(sdf_widths(config)) * (3 if normals else 1)
    if rays.intensities is not None:
        memory += returns * _PER_RETURN_OF_INTENSITY
    return Estimate(
        peak_memory_bytes=int(max(memory, len(rays) * _PER_RETURN_CLEANED)),
        seconds=seconds_of(config, schedule, len(rays), cells, rows),
        returns=returns,
        leaf_cells=cells,
        vertices=rows,
        iterations=schedule.iterations,
    )


def seconds_of(config: FitConfig, schedule: Schedule, returns: int, cells: int, rows: int) -> float:
    """Estimate the wall-clock time of a fit, s, from numbers of returns, leaf cells and feature rows."""
    seconds = _S_PER_RETURN * returns + _S_PER_CELL * cells
    if not config.train:
        return seconds
    iterations, with_network = schedule.sdf_iterations, schedule.intensity_iterations > 0
    later = max(0, schedule.intensity_iterations - schedule.joint_iterations)
    # A forward and a backward pass cost as much as three forward ones, and nine if the loss has normals.
    passes = 9 if config.networks.normals and with_network else 3
    of_field = passes * (iterations * schedule.batch_size + later * schedule.intensity_batch_size / 3)
    widths = sdf_widths(config)
    shared = of_field * (_S_PER_INPUT * widths[0] + _S_PER_MULTIPLICATION * weights_of(widths))
    if with_network:
        _, seen_jointly = near_and_labelled(config, schedule.batch_size)
        if config.training.intensity_in_free_space:
            seen_jointly = schedule.batch_size
        seen = schedule.joint_iterations * seen_jointly + later * schedule.intensity_batch_size
        shared += 3 * seen * _S_PER_MULTIPLICATION * weights_of(intensity_widths(config))
    moved = 0 if config.moves_rows(with_network) else rows * iterations
    threads = min(resolve_num_threads(config.num_threads), os.cpu_count() or 1)
    return seconds + _S_PER_ITERATION * (iterations + later) + _S_PER_MOVED_ROW * moved + shared / threads


def skipped_parts(
    config: FitConfig, schedule: Schedule, *, returns: int, cells: int, rows: int, with_intensity: bool
) -> list[tuple[str, float | None]]:
    """List the parts of the method that a fit skips, and the seconds saved; None if it takes no time of the fit."""

    def seconds(network: bool, **changes: Any) -> float:
        changed = config.override(**changes)
        scheduled = Schedule.of(changed, surface_returns=returns, vertices=rows, labelled=[returns] * network)
        return seconds_of(changed, scheduled, returns, cells, rows)

    network = with_intensity and config.trains_intensity
    now_s, surface_s = seconds(network), seconds(False, train=True)
    skipped: list[tuple[str, float | None]] = []
    if not config.train:
        what = "training of the surface: returns are averaged, and not moved onto planes"
        skipped.append((what, surface_s - now_s))
        if config.returns.drop_ghosts:
            why = f"none of {FEWEST_SAMPLED} or more sampled rays there crosses a surface"
            skipped.append((f"the search for ghosts in blocks of cells where {why}", None))
    if not config.returns.free_space:
        skipped.append(("free space, which grids and comparisons need (returns.free_space)", None))
    if not network:
        why = "intensities are in closed form" if with_intensity else "there are no intensities"
        skipped.append((f"the intensity network: {why}", seconds(True, train=True) - surface_s))
    if config.train and schedule.passes < 1 and config.training.sdf_iterations is None:
        whole = math.ceil(schedule.sdf_iterations / schedule.passes)
        saved_s = seconds(network, training={"sdf_iterations": whole}) - now_s
        skipped.append((f"{1 - schedule.passes:.0%} of the samples", saved_s))
    return skipped


def check_fit(rays: Rays, config: FitConfig, inside: Bools | None = None) -> None:
    """Raise a MemoryError if a fit needs more than `max_memory_bytes`, or than is available."""
    available = config.max_memory_bytes or available_bytes()
    # There are at most as many cells with returns as returns. If this bound fits, cells need not be counted.
    if available is None or _estimate(rays, config, len(rays), len(rays)).peak_memory_bytes <= available:
        return
    expected = estimate_rays(rays, config, inside)
    limit = f"{available / 1e9:.2f} GB available (max_memory_bytes)"
    remedy = "Use larger cells (leaf_size_m), or drop far returns (max_range_m)"
    wrong = f"the fit would need more than the {limit}: {expected}. {remedy}"
    check(expected.peak_memory_bytes <= available, wrong, MemoryError)


def check_extent(rays: Rays, config: FitConfig) -> None:
    """Raise a ValueError if a return lies beyond the range of cell keys, before the fit starts its work."""
    reach_m = config.metres(NEAR_BAND_CELLS if config.train else max(BAND_CELLS, TRUNCATION_CELLS))
    limit_m = MAX_CELLS_FROM_ORIGIN * config.leaf_size_m - reach_m
    if max(rays.points.max(initial=0), -rays.points.min(initial=0)) > limit_m:
        far = np.abs(rays.points).max(axis=1) > limit_m
        msg = (
            f"{far.sum()} of {len(far)} returns are not within a million cells of {config.leaf_size_m} m of the sensors' mean position: "
            "drop them (max_range_m), or use larger cells"
        )
        raise ValueError(msg)
