"""Distances of a mesh from the true surface: from simulated solids exactly, from lidar points by planes."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from radarsdf._core import cell_keys
from radarsdf.evaluation import surface_metrics
from radarsdf.returns.sensor import Sensor
from radarsdf.simulate import Scene as World
from radarsdf.simulate import Simulation
from radarsdf.simulate.radar import generator
from scipy.spatial import cKDTree

from scenes.scene import Scene

FloatArray = NDArray[np.float64]

REACH_M = 1.0
"""Search distance of errors along the normal."""

_STARTS = (1.0, 0.5, 0.25, 0.125, 0.0625, 0.0)  # shares of the search distance
_LIDAR_SIGMA_M = 0.03  # range accuracy of a VLP-16 by its data sheet; also that of other lidars of its time
_PIECES_M = (0.2, 0.4)  # radii of neighbourhoods on the lidar's surface; the first flat one is used
_PIECE_RAD = 0.04  # radius as a share of the range: two of 16 rings are 0.035 of it apart
_PIECE_POINTS = 10
_MOST_POINTS = 1000  # largest neighbourhood; more points change nothing
_THICKNESS_M = 0.06
_THIN = 0.1  # variance across a flat neighbourhood, as a share of the smaller one along it
_WIDE = 0.03  # smaller variance along a neighbourhood, over its squared radius. A single ring is a line
_LEAST_COS = 0.5  # surfaces with normals more than 60 degrees from that of the mesh are other ones
_SLACK_M = 1e-6  # rounding of distances

NEAR_M = 0.2
"""Distance of correct points, as for the F-score with nothing discarded."""

_FILLED_CELL_M = 0.1
_FIRST_RAYS = 4_000  # from each pose
_MOST_RAYS = 100  # that follow one of them
_GRAZING_COS = 0.01
_STREAM = 2**31 + 3  # of random numbers, which no scan, kind or lidar uses


class Truth(NamedTuple):
    """True surface near N points."""

    distance_m: FloatArray  # (N,) to the nearest surface or lidar point in any direction
    error_m: (
        FloatArray  # (N,) along the normal, positive in front of the surface; NaN where no surface is met
    )
    sigma_m: FloatArray  # (N,) standard error of the truth itself


def truth_of(scene: Scene, x: FloatArray, normals: FloatArray) -> Truth:
    """True surface near points `x` (N, 3) of a mesh, with unit normals (N, 3) towards free space; world frame, m.

    Raises
    ------
    ValueError
        If the scene has neither a simulation nor ground truth.
    """
    if scene.simulation is not None:
        world = scene.simulation.scene
        distance_m, error_m = np.abs(world.signed_distance(x)), along_normals(world, x, normals)
        # Beyond an edge, a ray misses the adjacent surface and hits one far behind.
        error_m[_LEAST_COS * np.abs(error_m) > distance_m + _SLACK_M] = np.nan
        return Truth(distance_m, error_m, np.zeros(len(x)))
    if scene.ground_truth is None or len(scene.ground_truth) == 0:
        msg = "the scene has no ground truth"
        raise ValueError(msg)
    distance_m, nearest = cKDTree(scene.ground_truth).query(x)
    error_m = to_planes(scene.ground_truth, nearest, x, normals, scene.poses[:, :3, 3])
    return Truth(distance_m, error_m, np.full(len(x), _LIDAR_SIGMA_M))


def along_normals(world: World, x: FloatArray, normals: FloatArray) -> FloatArray:
    """Signed distances (N,), m, to the nearest surface of the same orientation, along the normals in both directions.

    Rays are cast against the normals, from the points and from places in front of them. A ray from inside a solid
    would hit surfaces hidden in others, so only origins in free space are used. NaN without a surface within
    `REACH_M`.
    """
    error_m = np.full(len(x), np.nan)
    for share in _STARTS:
        ahead_m = share * REACH_M
        origins = x + ahead_m * normals
        rows = np.flatnonzero(world.signed_distance(origins) > 0)
        hits = world.raycast(origins[rows], -normals[rows], ahead_m + REACH_M)
        found = hits.range_m - ahead_m
        nearer = np.isfinite(found) & ~(np.abs(error_m[rows]) <= np.abs(found))
        error_m[rows[nearer]] = found[nearer]
    return error_m


def to_planes(
    lidar: FloatArray, nearest: NDArray[np.int64], x: FloatArray, normals: FloatArray, sensors: FloatArray
) -> FloatArray:
    """Signed distances (N,), m, along the normals to planes through neighbourhoods on the lidar's surface.

    A neighbourhood surrounds the lidar point `nearest` (N,) to each point. Far from the `sensors` (F, 3), rings are far
    apart, so neighbourhoods may be larger there. NaN if none is flat and wide, or it faces elsewhere, or its plane is
    farther than `REACH_M`.
    """
    centres, which = np.unique(nearest, return_inverse=True)
    tree = cKDTree(lidar)
    far_m = _PIECE_RAD * cKDTree(sensors).query(lidar[centres])[0]
    plane, middle = np.full((2, len(centres), 3), np.nan)
    for i, centre in enumerate(centres):
        for radius_m in (*_PIECES_M, max(far_m[i], _PIECES_M[-1])):
            found = _flat_piece(lidar, tree.query_ball_point(lidar[centre], radius_m), radius_m)
            if found is not None:
                middle[i], plane[i] = found
                break
    cosine = np.einsum("ij,ij->i", plane[which], normals)
    across = np.einsum("ij,ij->i", plane[which], x - middle[which])
    with np.errstate(divide="ignore", invalid="ignore"):
        error_m: FloatArray = across / cosine
        error_m[~((np.abs(cosine) >= _LEAST_COS) & (np.abs(error_m) <= REACH_M))] = np.nan
    return error_m


def _flat_piece(lidar: FloatArray, rows: list[int], radius_m: float) -> tuple[FloatArray, FloatArray] | None:
    """Centre (3,) and normal (3,) of the points, or None if they are few, a line, or not flat."""
    if len(rows) < _PIECE_POINTS:
        return None
    piece = lidar[rows[:: 1 + len(rows) // _MOST_POINTS]]
    middle = piece.mean(axis=0)
    spread = piece - middle
    variances, directions = np.linalg.eigh(spread.T @ spread / (len(piece) - 1))
    thin = variances[0] < min(_THICKNESS_M**2, _THIN * variances[1])
    return (middle, directions[:, 0]) if thin and variances[1] > _WIDE * radius_m**2 else None


@lru_cache(maxsize=1)
def filled_truth(simulation: Simulation) -> FloatArray:
    """Points (M, 3), world, m, one per cell of 0.1 m, of all surface that the radar typically detects.

    The ground truth of a simulation has holes where the rays of its lidar are sparse. Here, as many rays follow each ray of
    a grid as there are cells in the surface that it stands for.
    """
    rng, sensor, found = generator(simulation.seed, _STREAM), simulation.sensor, np.zeros((0, 3))
    half = np.array([sensor.azimuth_fov_rad / 2, np.sin(sensor.elevation_fov_rad / 2)])
    columns = max(1, round(np.sqrt(_FIRST_RAYS * half[0] / half[1])))
    lines = -(-_FIRST_RAYS // columns)
    shape, grid = np.array([columns, lines]), np.indices((columns, lines)).reshape(2, -1).T
    for T_world_sensor in simulation.lidar_poses[:: max(1, len(simulation.lidar_poses) // 40)]:
        rays, before, origin = grid, cell_keys(found, _FILLED_CELL_M), T_world_sensor[:3, 3]
        for is_last in (False, True):
            u = half * (2 * (rays + rng.random(rays.shape)) / shape - 1)
            angles = np.stack([u[:, 0], np.arcsin(u[:, 1])], axis=1)
            directions = Sensor.directions(*angles.T) @ T_world_sensor[:3, :3].T
            hits = simulation.scene.raycast(origin, directions, sensor.max_range_m)
            detected = sensor.echo_power_db(simulation.scene, origin, directions, hits) >= sensor.threshold_db
            rows = np.flatnonzero(detected & (hits.range_m >= sensor.min_range_m))
            points = origin + hits.range_m[rows, None] * directions[rows]
            new = ~np.isin(cell_keys(points, _FILLED_CELL_M), before)
            found, rows = np.concatenate([found, points[new]]), rows[new]
            if not is_last:
                cos = -np.einsum("ni,ni->n", directions[rows], hits.normals[rows])
                area_m2 = 4 * half.prod() / shape.prod() * hits.range_m[rows] ** 2
                counts = area_m2 / np.maximum(cos, _GRAZING_COS) / _FILLED_CELL_M**2
                rays = np.repeat(rays[rows], np.minimum(np.ceil(counts), _MOST_RAYS).astype(int), axis=0)
        found = found[np.unique(cell_keys(found, _FILLED_CELL_M), return_index=True)[1]]
    return found


def score_without_holes(simulation: Simulation, mesh: trimesh.Trimesh, x: FloatArray, samples: int) -> float:
    """F-score with nothing discarded: precision of points `x` (N, 3) by the scene, completeness by :func:`filled_truth`."""
    precision = float(np.mean(np.abs(simulation.scene.signed_distance(x)) <= NEAR_M))
    completion: float = surface_metrics(mesh, filled_truth(simulation), samples=samples)["completion_ratio"]
    return 2 * precision * completion / max(precision + completion, 1e-9)
