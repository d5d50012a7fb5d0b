"""``python -m bench.grids [SCENE ...]``: occupied places that planners' grids report as free, and errors of distances.

A place is a point on a true surface that the radar can detect from one of its poses, in a box of 50 × 50 × 10 m round the
middle of the path. Distances of free voxels are compared with the true distances from their centres, and so are their gradients.
"""

import argparse
from collections.abc import Iterator

import numpy as np
import radarsdf
import torch
from numpy.typing import NDArray
from radarsdf.grids.grid import Grid
from radarsdf.simulate import SCENES, Simulation

from bench.measure import timed
from bench.runner import Experiment, Row, main
from scenes.kinds import KINDS

Floats = NDArray[np.float64]

VOXEL_M = 0.2
_SIZE_M = np.array([50.0, 50.0, 10.0])
_SENSOR_ABOVE_M = 3.5  # height above the lower face of the box
_PLACE_M = 0.05  # at most one place per cube of this edge, which makes places uniform over the surface
_RAYS = 10_000  # rays per batch, from a pose
_DISTANCES = 20_000
_NEAR_M = 2.0  # distance of voxels whose gradients count
_STEP_M, _AXES = 0.05, np.concatenate([np.eye(3), -np.eye(3)])  # for the true gradient, by differences
_PLACES = 100_000  # largest number per scene


def box_of(drive: Simulation) -> Floats:
    """Lower and upper corner (2, 3), world, m."""
    middle = drive.poses[:, :3, 3].mean(axis=0)
    lower = middle - [_SIZE_M[0] / 2, _SIZE_M[1] / 2, _SENSOR_ABOVE_M]
    return np.stack([lower, lower + _SIZE_M])


def seen_places(drive: Simulation, box: Floats, number: int, rng: np.random.Generator) -> Floats:
    """At most `number` places (N, 3), world, m: exact surface points in view, in range and above the threshold."""
    sensor = drive.sensor
    found = np.zeros((0, 3))
    poses = drive.poses[:: max(1, len(drive.poses) // 40)]
    for _ in range(8):
        rounds = [found]
        for T_world_sensor in poses:
            azimuth = rng.uniform(-1, 1, _RAYS) * sensor.azimuth_fov_rad / 2
            up = rng.uniform(-1, 1, _RAYS) * np.sin(sensor.elevation_fov_rad / 2)
            flat = np.sqrt(1 - up**2)
            own = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], 1)
            rays, origin = own @ T_world_sensor[:3, :3].T, T_world_sensor[:3, 3]
            hits = drive.scene.raycast(origin, rays, sensor.max_range_m)
            seen = sensor.echo_power_db(drive.scene, origin, rays, hits) >= sensor.threshold_db
            seen &= hits.range_m >= sensor.min_range_m
            x = origin + hits.range_m[seen, None] * rays[seen]
            rounds.append(x[((x >= box[0]) & (x < box[1])).all(axis=1)])
        found = np.concatenate(rounds)
        _, first = np.unique(np.floor(found / _PLACE_M).astype(np.int64), axis=0, return_index=True)
        found = found[first]
        if len(found) >= number:
            break
    return rng.permutation(found)[:number]


def judged(grid: Grid, places: Floats) -> dict[str, float]:
    """Shares of places in free and occupied voxels, of all and of those that are not unknown, %; volume of voxels, m³."""
    state = grid.at(places)
    free, occupied = float((state == 0).mean()), float((state == 1).mean())
    return {
        "called free, %": round(100 * free, 3),
        "of known, %": round(100 * free / max(free + occupied, 1e-12), 3),
        "called occupied, %": round(100 * occupied, 1),
        "free, m³": round(float(grid.free.sum()) * grid.voxel_size**3),
    }


def distances(grid: Grid, drive: Simulation, rng: np.random.Generator) -> dict[str, float]:
    """Errors of the distances of free voxels, m, and of their gradients near surfaces, degrees; shares beyond the stated error, %."""
    field = grid.distances()
    x = grid.centres(grid.free)
    rows = rng.choice(len(x), min(_DISTANCES, len(x)), replace=False)
    true = drive.scene.signed_distance(x[rows])
    near = x[rows[(true > VOXEL_M) & (true < _NEAR_M)]]
    ends = drive.scene.signed_distance(np.stack([near + step for step in _STEP_M * _AXES]).reshape(-1, 3))
    gradient, found = np.subtract(*ends.reshape(2, 3, -1)).T, field.at(near)[1]
    lengths = np.linalg.norm(gradient, axis=1) * np.linalg.norm(found, axis=1)
    turned = np.degrees(np.arccos(np.clip((gradient * found).sum(axis=1) / lengths, -1, 1)))
    occupied, not_free = field.occupied_m[grid.free][rows], field.not_free_m[grid.free][rows]
    return {
        "median error, m": round(float(np.median(np.abs(occupied - true))), 3),
        "median error below 2 m, °": round(float(np.nanmedian(turned)), 1),
        "stated, m": round(field.error_m, 3),
        "beyond it, %": round(100 * float((np.abs(occupied - true) > field.error_m).mean()), 2),
        "too far by it, %": round(100 * float((occupied - true > field.error_m).mean()), 2),
        "not free too far, %": round(100 * float((not_free - true > field.error_m).mean()), 3),
    }


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene."""
    threads = options.threads[0]
    torch.set_num_threads(threads)
    for name in options.cases:
        drive = (dict(SCENES) | dict(KINDS))[name](seed=options.seed, frames=8 if options.quick else None)
        rng = np.random.default_rng(options.seed)
        config = radarsdf.FitConfig(num_threads=threads)
        if options.quick:
            config = radarsdf.FitConfig.quick(num_threads=threads, returns={"free_space": True})
        with timed() as fitting:
            radar_map = radarsdf.fit(drive.points, drive.poses, config=config, progress=False)
        box = box_of(drive)
        with timed() as gridding:
            grid = radarsdf.grid(radar_map, box, VOXEL_M)
        places = seen_places(drive, box, _PLACES, rng)
        yield {
            "scene": name,
            "places": len(places),
            **judged(grid, places),
            **distances(grid, drive, rng),
            "fit, s": round(fitting.cpu_s, 1),
            "grid, s": round(gridding.cpu_s, 1),
        }


EXPERIMENT = Experiment(
    "Occupied places that grids call free, and errors of their distances",
    rows,
    (*SCENES, *KINDS),
    ("seed", "threads"),
    {"seed": 161},
)

if __name__ == "__main__":
    main("bench.grids", EXPERIMENT)
