"""Time and memory of fits, of their stages, and of pose refinement. Each row is measured in a new process, on Linux."""

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import radarsdf
import radarsdf.fitting.fit
import radarsdf.poses.refine  # like fitting.fit: else the first call would import it, in what is measured
from radarsdf import FitConfig, RadarMap
from radarsdf._core import count_visibility
from radarsdf.fitting.surface_returns import near_leaf_keys
from radarsdf.poses.rigid import steps, turned_by
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.noise import sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare

from bench.growth.street import Street, street
from bench.measure import in_new_process, measured, memory_bytes, timed
from bench.paper.poses import walked
from bench.runner import Column, Row, figure, groups

_OFF_M = 0.2  # distance from the surface of the points at which the sign of the SDF is checked
_LEAST_RIGHT = 0.6

FIT_COLUMNS = {
    "wall_s": Column("time, s"),
    "cpu_s": Column("CPU, s"),
    "peak_mb": Column("peak, MB", digits=0),
    "before_mb": Column("before the fit, MB", digits=0),
    "prepare_s": Column("prepare, s"),
    "ghosts_s": Column("ghosts, s"),
    "occupied_cells_s": Column("cells, s"),
    "start_s": Column("start, s"),
    "training_s": Column("training, s"),
    "leaf_cells": Column("leaf cells", digits=0),
    "map_mb": Column("map, MB", digits=1),
    "right": Column("correct signs, %", 100, 1),
    "mae": Column("MAE, dB"),
}


def fits(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per number of returns, length of the street and number of threads, without and with intensities."""
    returns, sizes_m = ([10**4], [50.0]) if options.quick else (options.returns, options.sizes)
    for count, size_m, threads in itertools.product(returns, sizes_m, options.threads):
        for intensities in (False, True):
            case = {"returns": count, "size_m": size_m, "threads": threads, "intensities": intensities}
            yield case | in_new_process("bench.growth.fits:fit_row", *case.values(), options.quick)


def fit_row(returns: int, size_m: float, threads: int, intensities: bool, quick: bool) -> Row:
    """Time, memory and stages of one fit, and the errors of its map.

    Raises
    ------
    RuntimeError
        If returns are missing, or the map is not one of the street: a failed fit must not count as a fast one.
    """
    scans = street(returns, size_m)
    short = {"sdf_iterations": 60, "intensity_iterations": 120} if quick else {}
    config = FitConfig(num_threads=threads).override(training=short)
    before_mb = memory_bytes("VmHWM") / 1e6
    values = scans.intensities if intensities else None
    with timed() as taken:
        radar_map = radarsdf.fit(scans.points, scans.poses, values, config=config, progress=False)
    row: Row = {"wall_s": taken.wall_s, "cpu_s": taken.cpu_s}
    row |= {"peak_mb": memory_bytes("VmHWM") / 1e6, "before_mb": before_mb}
    report = radar_map.report
    if report["returns"] != returns:
        msg = f"{report['returns']} returns were fitted, not {returns}"
        raise RuntimeError(msg)
    row |= {key: report.get(key) for key in FIT_COLUMNS if key in report}
    return row | {"map_mb": radar_map.nbytes / 1e6} | map_errors(radar_map, scans)


def map_errors(radar_map: RadarMap, scans: Street) -> dict[str, float]:
    """Share of correct signs in front of and behind the true surface, and the error of the intensity on it.

    Raises
    ------
    RuntimeError
        If the signs are hardly better than chance, or the intensities worse than a constant.
    """
    hits, sensors = scans.hits.astype(np.float64), scans.hit_sensors.astype(np.float64)
    rays = hits - sensors
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # Points are offset along the normal, since a ray can be almost parallel to the surface.
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


def draw_fits(rows: list[Row], path: Path) -> None:
    """Plot seconds and peak memory over the number of returns."""
    with figure(path, columns=2, size=(4.6, 3.8)) as (axes,):
        for ax, (key, label, factor) in zip(
            axes, (("wall_s", "time, s", 1), ("peak_mb", "memory, GB", 1e-3)), strict=True
        ):
            for (size_m, threads, both), own in groups(rows, "size_m", "threads", "intensities").items():
                points = sorted((row["returns"], factor * row[key]) for row in own)
                name = f"{size_m:g} m, {threads} threads, {'with' if both else 'without'} intensities"
                ax.loglog(*zip(*points, strict=True), "o-", ms=4, label=name)
            ax.set(xlabel="returns", ylabel=label)


SURFEL_COLUMNS = {
    "ghosts_cpu_s": Column("ghosts: CPU, s"),
    "ghosts_wall_s": Column("time, s"),
    "ghosts_grown_mb": Column("MB", digits=0),
    "visibility_cpu_s": Column("visibility counts: CPU, s"),
    "visibility_wall_s": Column("time, s "),
    "visibility_grown_mb": Column("MB ", digits=0),
    "ghosts": Column("ghosts", digits=0),
    "leaf_cells": Column("leaf cells", digits=0),
}


def surfels(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per number of returns: ghost search and visibility counts. The street grows with the returns."""
    for count, threads in itertools.product([10**5] if options.quick else options.returns, options.threads):
        yield {"returns": count, "threads": threads} | in_new_process(
            "bench.growth.fits:surfel_row", count, threads
        )


def surfel_row(returns: int, threads: int) -> Row:
    """Time and growth of the peak memory of the ghost search and of the visibility counts.

    Raises
    ------
    RuntimeError
        If the number of ghosts or of observed cells is implausible.
    """
    scans = street(returns)
    rays = prepare(scans.points, scans.poses)
    del scans
    config = FitConfig()
    with measured() as of_ghosts:
        surfels = Surfels.of(rays, config.leaf_size_m, threads)
        noise = sensor_noise(surfels, rays, config.returns)
        cells = surfels.cells_at(rays.points, threads)
        is_ghost = find_ghosts(surfels, rays, cells, noise, threads)[cells]
    leaf_keys = near_leaf_keys(rays.select(~is_ghost), config, threads)
    columns = rays.points, rays.directions, rays.ranges_m, rays.scans
    with measured() as of_visibility:
        counts = count_visibility(leaf_keys, config.leaf_size_m, *columns, threads)
    # A tenth of the returns within 70 m are ghosts, and every cell is near a return.
    if not 0.02 * returns < is_ghost.sum() < 0.15 * returns or not (counts > 0).mean() > 0.9:
        msg = f"{is_ghost.sum()} ghosts of {returns} returns, {(counts > 0).mean():.0%} of the cells seen"
        raise RuntimeError(msg)
    row: Row = {"ghosts": int(is_ghost.sum()), "leaf_cells": len(leaf_keys)}
    for name, taken in (("ghosts", of_ghosts), ("visibility", of_visibility)):
        row |= {f"{name}_{key}": value for key, value in asdict(taken).items()}
    return row


_APART_M = 500.0  # distance between copies, which have no returns in common
_WALK = 0.02, 0.1  # m and degrees per step
POSE_COLUMNS = {
    "returns": Column("returns", digits=0),
    "wall_s": Column("time, s"),
    "cpu_s": Column("CPU, s"),
    "grown_mb": Column("growth, MB", digits=0),
    "rounds": Column("rounds", digits=0),
    "given_deg": Column("step error before, °", digits=3),
    "found_deg": Column("step error refined, °", digits=3),
}


def poses(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per number of scans: `refine_poses` of a drive, and of concatenated copies of it."""
    for count, threads in itertools.product((40,) if options.quick else (120, 1200, 9960), options.threads):
        yield {"scans": count, "threads": threads} | in_new_process(
            "bench.growth.fits:pose_row", count, threads
        )


def pose_row(scans: int, threads: int) -> Row:
    """Time and growth of the peak memory of `refine_poses` with drifting poses.

    Raises
    ------
    RuntimeError
        If the poses are not improved.
    """
    drive = radarsdf.simulate.hugin(seed=1)
    copies = -(-scans // len(drive.poses))
    points = (drive.points * copies)[:scans]
    true = np.tile(drive.poses, (copies, 1, 1))[:scans]
    true[:, 0, 3] += _APART_M * (np.arange(scans) // len(drive.poses))
    given = walked(true, *_WALK, 0)
    with measured() as taken:
        refined = radarsdf.refine_poses(points, given, config=FitConfig(num_threads=threads))
    given_deg, found_deg = (
        float(np.degrees(np.sqrt((turned_by(steps(true), steps(poses)) ** 2).mean())))
        for poses in (given, refined.poses)
    )
    if not refined.improved or found_deg >= given_deg:
        msg = f"steps turn by {found_deg:.3f} and not {given_deg:.3f}°: {refined.report['verdict']}"
        raise RuntimeError(msg)
    row: Row = {"returns": sum(map(len, points)), "rounds": refined.report["rounds"]}
    return row | asdict(taken) | {"given_deg": given_deg, "found_deg": found_deg}
