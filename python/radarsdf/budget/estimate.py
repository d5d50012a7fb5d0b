# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Estimates of the memory and time of a fit or a mesh, and errors if the memory is not enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf._core import FEATURE_DIM, CellSet, sample_cells, sample_rays
from radarsdf.budget.blocks import count_blocks, most_blocks
from radarsdf.budget.durations import SECONDS, shared, work_of
from radarsdf.budget.extent import check_extent
from radarsdf.budget.schedule import Schedule, seen_jointly
from radarsdf.checks import instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.widths import fourier_width, intensity_widths, parameters_of, sdf_widths
from radarsdf.returns.cells import lattice_of
from radarsdf.returns.rays import Rays, prepare
from radarsdf.threads import resolve_num_threads

# Bytes. Measured as peaks of fits of 1e4 to 3e6 returns of a street, over the memory of the process before
# the fit; `python -m bench.estimates memory` repeats it, and a test checks it.
_ALWAYS = 35e6  # code that the fit loads, stacks and arenas of the threads
_PER_RETURN = 30.0
_PER_INTENSITY = 20.0
_PER_RETURN_AGAIN = 110.0  # if the intensity stage uses other returns than the sdf stage
_PER_RETURN_OF_CLOSED_FORM = 150.0  # cells of intensities in closed form
_PER_RETURN_CHECKED = (
    200.0  # rays with and without ghosts, and the training's copy, for which the others make room
)
_PER_CELL = 215.0
_PER_BLOCK = 300.0  # of 8 × 8 × 8 leaf cells that rays passed
_PER_OCTREE_ROW = 30.0  # freed when the rows are numbered
_COPIES = 4  # of each parameter that learns: value, two moments of Adam, last finite value
_PER_ROW = 8.0  # if only the touched rows move: marks of Adam
_PER_VOXEL = 220.0
_PER_TRIANGLE = 320.0  # of a welded mesh and its normals: measured on hugin in tiles
# Of a view of a map: peaks of maps of 1e5 to 2e5 leaf cells.
_PER_CELL_TRACED = 300.0  # the surface that rays meet, made once for a map
_PER_PATCH_SEEN = 100.0
_PER_BEAM = 100.0
_PER_RETURN_SEEN = 50.0  # of all views that are kept

_SAMPLE = 50_000  # returns, about, whose cells are counted
_COLUMN = 16  # leaf cells: edge of the columns of space, of which some are sampled
_MOST_STEPS = 1000  # half cells walked along a ray. A longer way is walked in longer steps.
_MOST_POINTS = 1_600_000  # walked in all. Where the ways are long, fewer returns are sampled.


@dataclass(frozen=True)
class Estimate:
    """Memory and time that a fit will take."""

    peak_memory_bytes: int
    """Peak above the memory that the process has before. Within a factor of 1.5 on scans like those of the
    measurement."""
    seconds: float
    """Wall-clock time. Within a factor of 2 on the quiet machine of the measurement. Of another machine, only
    the number of processors is taken into account."""
    returns: int
    """Number of returns between `min_range_m` and `max_range_m`."""
    leaf_cells: int
    """Number of leaf cells, with those of ghosts and without those that bridge gaps. A fit of sparse scans
    has up to a third more."""
    vertices: int
    """Number of vertices, which is the number of rows of features. Estimated like the leaf cells."""
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
    """:func:`estimate` for scans that are already rays, of which a map is learnt from those `inside`, (N,). None: all."""
    threads = resolve_num_threads(config.num_threads)
    learnt = rays if inside is None else rays.select(inside)
    cells, rows = _count_cells(learnt, config)
    schedule = _schedule(learnt, rows, config)
    work = work_of(
        config,
        schedule,
        returns=len(rays),
        cells=cells,
        rows=rows,
        with_intensity=_trains_intensity(rays, config),
    )
    return Estimate(
        peak_memory_bytes=_fit_bytes(
            learnt, len(rays), cells, rows, count_blocks(rays, learnt, config), config
        ),
        seconds=sum(SECONDS[kind] * amount for kind, amount in shared(work, threads).items()),
        returns=len(learnt),
        leaf_cells=cells,
        vertices=rows,
        iterations=schedule.iterations,
    )


def _schedule(rays: Rays, rows: int, config: FitConfig) -> Schedule:
    count, with_intensity = len(rays), _trains_intensity(rays, config)
    return Schedule.of(
        config, surface_returns=count, returns=count, vertices=rows, with_intensity=with_intensity
    )


def _trains_intensity(rays: Rays, config: FitConfig) -> bool:
    return rays.intensities is not None and config.trains_intensity


def _fit_bytes(rays: Rays, num_checked: int, cells: int, rows: int, blocks: int, config: FitConfig) -> int:
    """Of a map that is learnt from `rays`, the only ones of `num_checked` whose returns are inside.

    `blocks`: that rays passed.
    """
    count, with_intensity = len(rays), _trains_intensity(rays, config)
    schedule, moves_rows = _schedule(rays, rows, config), config.moves_rows(with_intensity)
    memory = _ALWAYS + count * _PER_RETURN + cells * _PER_CELL + blocks * _PER_BLOCK
    memory += 4 * rows * FEATURE_DIM * _copies(config, schedule, with_intensity=with_intensity)
    networks = parameters_of(sdf_widths(config))
    if with_intensity:
        networks += parameters_of(intensity_widths(config))
    memory += 4 * networks * (_COPIES + resolve_num_threads(config.num_threads))
    learns_features = schedule.sdf_iterations > 0
    memory += moves_rows * learns_features * rows * _PER_ROW
    samples = learns_features * schedule.batch_size
    seen = 0
    if schedule.intensity_iterations:
        seen = schedule.intensity_batch_size
        if config.training.joint and samples:
            seen = max(seen, seen_jointly(config, samples))
    memory += _batch_bytes(config, max(samples, seen), seen)
    if with_intensity:
        memory += count * (_PER_INTENSITY + config.returns.drop_ghosts * _PER_RETURN_AGAIN)
    if rays.intensities is not None and config.closes_intensity:
        memory += count * _PER_RETURN_OF_CLOSED_FORM
    passing = num_checked * _PER_RETURN_CHECKED
    if config.encoding.kind == "octree":
        passing = max(passing, _ALWAYS + cells * _PER_CELL + rows * _PER_OCTREE_ROW)
    return int(max(memory, passing))


def _copies(config: FitConfig, schedule: Schedule, *, with_intensity: bool) -> int:
    """How many numbers there are for each of the features, at the peak."""
    if config.moves_rows(with_intensity):  # pages of zeros take no memory until a step writes to them
        return _COPIES if schedule.sdf_iterations else 1
    if not schedule.sdf_iterations:
        return 3  # itself and two moments
    if config.differentiates_in_core(with_intensity):
        return _COPIES + 1
    # Each thread has a gradient of all rows. Through normals the loss sees them twice: two gradients, and their sum.
    gradients = 3 if with_intensity and config.networks.normals else 1
    return _COPIES + gradients * resolve_num_threads(config.num_threads)


def check_fit(rays: Rays, config: FitConfig, inside: NDArray[np.bool_] | None = None) -> None:
    """Raises a MemoryError if a fit needs more than `max_memory_bytes`, or than the system has left.

    `inside`: as of :func:`estimate_rays`.
    """
    available = _limit(config.max_memory_bytes)
    # Upper bounds: cells that the near band of a ray can cross, and rows of features of a cell. If a fit of
    # so many is small enough, the cells need not be counted, which takes time.
    cells = len(rays) * (3 * math.ceil(2 * config.near_band_m / config.leaf_size_m) + 3)
    corners = 12 if config.encoding.kind == "tri-quadtree" else 8
    if (
        available is None
        or _fit_bytes(
            rays,
            len(rays),
            cells,
            cells * corners * config.encoding.num_levels,
            most_blocks(rays, config),
            config,
        )
        <= available
    ):
        return
    expected = estimate_rays(rays, config, inside)
    if expected.peak_memory_bytes > available:
        msg = (
            f"the fit would take about {expected.peak_memory_bytes / 1e9:.2f} GB for {expected.leaf_cells} leaf cells "
            f"and {expected.returns} returns, of {available / 1e9:.2f}: use larger cells (leaf_size_m), drop far "
            "returns (max_range_m), or set max_memory_bytes if the estimate is too high"
        )
        raise MemoryError(msg)


def check_mesh(voxels: int, voxel_size: float, max_memory_bytes: int | None) -> None:
    """Raises a MemoryError if so many voxels of `voxel_size`, m, need more memory than there is."""
    _check(f"voxels of {voxel_size} m", voxels * _PER_VOXEL, max_memory_bytes, "use larger ones")


def check_triangles(count: int, max_memory_bytes: int | None) -> None:
    """Raises a MemoryError if the mesh of a map in tiles has more triangles than memory holds."""
    way_out = "take a part, by a box, or write it tile by tile (radarsdf tiles mesh)"
    _check(f"a mesh of {count} triangles", count * _PER_TRIANGLE, max_memory_bytes, way_out)


def check_views(
    max_memory_bytes: int | None, *, cells: int = 0, patches: int = 0, beams: int = 0, returns: float = 0
) -> None:
    """Raises a MemoryError if views of a map need more memory than there is.

    `cells`: leaf cells of a map whose surface has yet to be made for views; `patches` of that surface; `beams` of one
    view; `returns` of all views that are kept.
    """
    needed = (
        cells * _PER_CELL_TRACED + patches * _PER_PATCH_SEEN + beams * _PER_BEAM + returns * _PER_RETURN_SEEN
    )
    way_out = "ask for fewer poses or returns, or make the map of a part of the scans"
    _check("these views", needed, max_memory_bytes, way_out)


def _check(what: str, needed_bytes: float, max_memory_bytes: int | None, way_out: str) -> None:
    available = _limit(max_memory_bytes)
    if available is not None and needed_bytes > available:
        msg = f"{what} would take about {needed_bytes / 1e9:.2f} GB, of {available / 1e9:.2f}: {way_out}"
        raise MemoryError(msg)


def _limit(max_memory_bytes: int | None) -> int | None:
    return available_bytes() if max_memory_bytes is None else max_memory_bytes


def available_bytes(root: Path = Path("/")) -> int | None:
    """Memory that this process can still get, bytes: the least of what system and control groups have left.

    None if it cannot be found out, as on systems other than Linux. `root` is the root of the file system, for
    tests.
    """
    found = []
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        found.append(next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable")))
        groups = (root / "proc/self/cgroup").read_text().splitlines()
    except (OSError, StopIteration):
        groups = []
    top = root / "sys/fs/cgroup"
    folders = [(top, "memory.max", "memory.current")]
    for line in groups:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            folders.append((top / path.lstrip("/"), "memory.max", "memory.current"))
        elif "memory" in controllers.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes")
            folders += [(top / "memory" / path.lstrip("/"), *names), (top / "memory", *names)]
    for folder, limit, usage in folders:
        try:
            left = int((folder / limit).read_text()) - int((folder / usage).read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        except (OSError, ValueError):  # there is no such group, or its limit is "max"
            continue
        found.append(
            max(0, left + int(stat.get("inactive_file", 0)))
        )  # cached files, which the system can drop
    return min(found) if found else None


def _batch_bytes(config: FitConfig, samples: int, seen: int) -> float:
    """Bytes of a batch in encodings, hidden layers and their gradients. The intensity network has `seen` samples of it."""
    encoding = config.encoding.num_levels * FEATURE_DIM + fourier_width(config)
    numbers = samples * (encoding + sum(config.networks.sdf_hidden))
    numbers += seen * (encoding + sum(config.networks.intensity_hidden))
    return 4.0 * numbers * (3 if config.networks.normals else 1)  # normals need gradients of gradients


def _count_cells(rays: Rays, config: FitConfig) -> tuple[int, int]:
    """Numbers of leaf cells and rows of features, estimated from a sample of columns of space."""
    all_axes = (0, 1, 2)
    planes = [(0, 1), (0, 2), (1, 2)] if config.encoding.kind == "tri-quadtree" else [all_axes]
    cells = round(sum(_distinct(rays, config, all_axes, [0], corners=False)))
    rows = sum(
        sum(_distinct(rays, config, axes, list(range(config.encoding.num_levels)), corners=True))
        for axes in planes
    )
    return cells, round(rows)


def _distinct(
    rays: Rays, config: FitConfig, axes: tuple[int, ...], levels: list[int], *, corners: bool
) -> list[float]:
    """Number of occupied cells of each level, or of their corners, that differ in the coordinates `axes`."""
    band_m, leaf_size_m = config.near_band_m, config.leaf_size_m
    wanted = max(1, math.ceil(4 * band_m / leaf_size_m))  # steps of half a cell, as a fit walks them
    steps = min(wanted, _MOST_STEPS)
    looks = 2 * math.ceil(steps / (2 * _COLUMN)) + 1  # at least one in each column that a ray passes
    share = min(1.0, _SAMPLE / len(rays))
    if share * len(rays) * steps > _MOST_POINTS:  # a ray is in the sample if one of its columns is
        share *= _MOST_POINTS / (len(rays) * share * steps * looks)
    used = rays
    if share < 1:
        points, directions = np.ascontiguousarray(rays.points), np.ascontiguousarray(rays.directions)
        offsets_m = np.linspace(-band_m, band_m, looks).astype(np.float32)
        threads = resolve_num_threads(config.num_threads)
        used = rays.select(
            sample_rays(points, directions, offsets_m, axes, leaf_size_m, _COLUMN, share, threads)
        )
    cells = CellSet(leaf_size_m)
    for points in used.along(np.linspace(-band_m, band_m, steps + 1)) if len(used) else ():
        points[:, [axis for axis in range(3) if axis not in axes]] = 0
        cells.insert(points, config.num_threads)
    lattice = lattice_of(cells.sorted_keys(config.num_threads))[:, list(axes)]
    counts: list[float] = []
    for level in levels:
        found = _unique_rows(lattice >> level)
        if corners:
            steps_to = np.stack(np.meshgrid(*[[0, 1]] * len(axes), indexing="ij"), -1).reshape(-1, len(axes))
            found = _unique_rows((found[:, None, :] + steps_to).reshape(-1, len(axes)))
        # Count by the column of each cell or corner itself. Those of a return in the sample may be in another
        # column.
        found = np.ascontiguousarray(found << level)
        counts.append(int(sample_cells(found, _COLUMN, share).sum()) / share)
    # Steps that are too long miss cells: as if there were so many times more.
    return [count * wanted / steps for count in counts]


def _unique_rows(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different rows. np.unique is much slower, because it compares rows as bytes."""
    ordered = rows[np.lexsort(rows.T)]
    new = np.ones(len(ordered), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    different: NDArray[np.int64] = ordered[new]
    return different
