# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``python -m bench.movers [FILE.npz ...]``: what it is worth to leave out returns that move by their Doppler.

Each drive is fitted with all its returns, without those that Doppler tells, and without those that truly move: by the
flags ``static`` of a recorded file, or by construction. Simulated drives have Doppler of their poses with noise, and
cars that drive through them.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf import FitConfig
from radarsdf.checking.doppler import velocity_of_poses
from radarsdf.evaluation import surface_metrics
from radarsdf.returns.moving import Movers
from radarsdf.returns.rays import prepare
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]

_STEP_S = 0.1
_DOPPLER_SIGMA_MPS = 0.08
_CAR_M = np.array([4.5, 1.8, 1.5])
_MIN_RANGE_M, _MAX_RANGE_M = 2.5, 60.0
_SEEN_BY_RADAR_M = 1.0  # as in bench.paper.scenes: lidar points farther from every return do not count


@dataclass(frozen=True, eq=False)
class Drive:
    """F scans, whose returns move or not, and the surface of what stands still."""

    points: list[NDArray[Any]]
    poses: FloatArray
    doppler_mps: list[NDArray[Any]]
    moves: list[NDArray[np.bool_]]
    truth: FloatArray


def simulated(name: str, frames: int, cars: int) -> Drive:
    """A simulated scene in which `cars` drive beside the sensor, faster and slower than it, and hide what is behind."""
    scans = radarsdf.simulate.SCENES[name](frames=frames)
    times_s = _STEP_S * np.arange(frames, dtype=np.float64)
    velocities = velocity_of_poses(scans.poses, times_s)
    rng = np.random.default_rng(0)
    start, forwards = scans.poses[0], scans.poses[0, :3, :3] @ np.array([1.0, 0, 0])
    speeds = np.linalg.norm(velocities, axis=1).mean() + rng.choice([-1, 1], cars) * rng.uniform(2, 8, cars)
    offsets = np.stack([rng.uniform(0, 40, cars), rng.choice([-1, 1], cars) * rng.uniform(2.5, 4, cars)], 1)
    points, doppler, moves = [], [], []
    for i, scan in enumerate(scans.points):
        T = scans.poses[i]
        ranges = np.linalg.norm(scan, axis=1)
        away = scan / ranges[:, None]
        speed = -away @ velocities[i]
        hit = np.zeros(len(scan), bool)
        for car in range(cars):
            middle = start[:3, 3] + start[:3, :3] @ [*offsets[car], 0.0] + forwards * speeds[car] * times_s[i]
            middle = np.array([*middle[:2], T[2, 3] - 1.0])
            entry = _entry(T[:3, 3], away @ T[:3, :3].T, middle)
            nearer = entry < ranges
            ranges = np.where(nearer, entry, ranges)
            seen_from = T[:3, :3].T @ (forwards * speeds[car])
            speed = np.where(nearer, away @ (seen_from - velocities[i]), speed)
            hit |= nearer
        points.append((away * ranges[:, None]).astype(np.float32))
        doppler.append((speed + rng.normal(0, _DOPPLER_SIGMA_MPS, len(scan))).astype(np.float32))
        moves.append(hit)
    assert scans.ground_truth is not None
    return Drive(points, scans.poses, doppler, moves, scans.ground_truth)


def _entry(origin: FloatArray, directions: FloatArray, middle: FloatArray) -> FloatArray:
    """(N,) distance at which rays enter a car, whose sides are along the axes of the world, m; inf beside it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (middle - _CAR_M / 2 - origin) / directions
        far = (middle + _CAR_M / 2 - origin) / directions
    enter = np.minimum(near, far).max(axis=1)
    leave = np.maximum(near, far).min(axis=1)
    found: FloatArray = np.where((enter < leave) & (enter > 0), enter, np.inf)
    return found


def recorded(path: Path) -> Drive:
    """A file of scans with the arrays doppler, static and lidar_points."""
    with np.load(path) as file:
        rows = [np.flatnonzero(file["frame"] == i) for i in range(len(file["poses"]))]
        points, doppler, static = ([file[name][r] for r in rows] for name in ("points", "doppler", "static"))
        poses, lidar = file["poses"].astype(np.float64), file["lidar_points"].astype(np.float64)
    standing = [scan[flags] for scan, flags in zip(points, static, strict=True)]
    rays = prepare(standing, poses, min_range_m=_MIN_RANGE_M, max_range_m=_MAX_RANGE_M)
    distance, _ = cKDTree(rays.in_world()[0]).query(lidar, distance_upper_bound=_SEEN_BY_RADAR_M)
    return Drive(points, poses, doppler, [~flags for flags in static], lidar[np.isfinite(distance)])


def measure(drive: Drive, seeds: int, samples: int, changes: dict[str, Any]) -> list[list[str]]:
    """One row of words for each choice of returns."""
    found = Movers.of(drive.points, drive.doppler_mps)
    truth = Movers(drive.moves, None)
    none = Movers([np.zeros_like(mask) for mask in drive.moves], None)
    rows = []
    for label, movers in (
        ("all returns", none),
        ("without movers by Doppler", found),
        ("without true movers", truth),
    ):
        scores = []
        for seed in range(seeds):
            config = FitConfig(seed=seed, **changes).override(
                returns={"min_range_m": _MIN_RANGE_M, "max_range_m": _MAX_RANGE_M}
            )
            radar_map = radarsdf.fit(movers.without(drive.points), drive.poses, config=config, progress=False)
            mesh = radar_map.mesh(progress=False)
            metrics = surface_metrics(mesh, drive.truth, samples=samples)
            scores.append([100 * metrics[key] for key in ("f_score_all", "precision", "completion_ratio")])
        wrong = sum(int((a != b).sum()) for a, b in zip(movers.masks, drive.moves, strict=True))
        cells = [f"{value:.2f}" for value in np.mean(scores, axis=0)]
        rows.append([label, str(movers.count), str(wrong), *cells])
    return rows


def main() -> None:
    """Print a table for each drive."""
    parser = argparse.ArgumentParser(prog="python -m bench.movers", description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="recorded drives, .npz")
    parser.add_argument("--quick", action="store_true", help="only check that it runs")
    options = parser.parse_args()
    seeds, samples = (1, 50_000) if options.quick else (3, 1_000_000)
    changes: dict[str, Any] = {"training": {"sdf_iterations": 20}} if options.quick else {}
    simulations = (
        (("wall", 6, 1),) if options.quick else (("hugin", 60, 0), ("hugin", 60, 3), ("astyx", 20, 2))
    )
    drives = {
        f"{name}, {frames} scans, {cars} cars": (simulated, (name, frames, cars))
        for name, frames, cars in simulations
    }
    drives |= {path.stem: (recorded, (path,)) for path in options.files}
    for name, (load, arguments) in drives.items():
        drive = load(*arguments)
        print(
            f"\n### {name}, {sum(map(len, drive.points))} returns, {sum(int(m.sum()) for m in drive.moves)} move\n"
        )
        print(
            "| fit with | left out | wrongly told | F-score, nothing discarded, % | precision, % | completion, % |"
        )
        print("|---|---|---|---|---|---|")
        for row in measure(drive, seeds, samples, changes):
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
