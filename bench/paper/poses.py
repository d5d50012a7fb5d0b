"""Effect of pose errors, and results of `refine_poses` and `odometry`."""

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.evaluation import surface_metrics, trajectory_metrics
from radarsdf.io import Imu
from radarsdf.poses.rigid import aligned, moved
from radarsdf.simulate import drifted, measured_motion
from scipy.spatial.transform import Rotation, Slerp

from bench.measure import timed
from bench.paper.reflectance import errors_of
from bench.paper.surface import samples_of
from bench.runner import Column, Row, chosen_scenes
from scenes.scene import Scene

Poses = NDArray[np.float64]

COLUMNS = {
    "f_given": Column("F before, %"),
    "f_found": Column("F after, %"),
    "f_true": Column("F true, %"),
    "mae_found": Column("intensity, dB"),
    "mae_true": Column("intensity true, dB"),
    "given_cm": Column("before, cm"),
    "found_cm": Column("after, cm"),
    "given_deg": Column("before, °"),
    "found_deg": Column("after, °"),
    "relative_percent": Column("relative, %"),
    "deg_per_m": Column("°/m"),
    "nees": Column("NEES / 3"),
    "taken": Column("taken"),
    "segments": Column("segments"),
    "seconds": Column("s"),
}

_SOURCES = ("returns and Doppler", "returns, Doppler, gyroscope", "returns alone")


def poses(options: argparse.Namespace) -> Iterator[Row]:
    """Yield rows per scene, error model of its poses and odometry; repetitions have other seeds of the scene or errors."""
    for scene, repetition in itertools.product(list(chosen_scenes(options)), range(options.repetitions)):
        own, seed = scene.repeated(repetition), options.seed + repetition
        base = {"scene": scene.name, "seed": seed} | _map_errors(own, own.poses, "true", options)
        for name in ("none", "walk of 0.02 m, 0.1°") if options.quick else BREAKAGES:
            given = BREAKAGES[name](own.poses, seed)
            row = base | _trajectory_errors(given, own.poses, "given")
            row |= _map_errors(own, aligned(given, own.poses), "given", options)
            for source, measured in _measured(own):
                found = radarsdf.refine_poses(own.points, given, **measured)
                row |= {
                    "poses": name + source,
                    "taken": float(found.improved),
                    "seconds": found.report["seconds"],
                }
                row |= _trajectory_errors(found.poses, own.poses, "found", found.covariance)
                yield row | _map_errors(own, aligned(found.poses, own.poses), "found", options)
        for row in _odometry_rows(own, seed, options):
            yield base | row


def _measured(scene: Scene) -> list[tuple[str, dict[str, Any]]]:
    """Inputs of refinement in addition to returns, with the suffix of their rows: none, and recorded Doppler."""
    if scene.doppler_mps is None or scene.times_s is None:
        return [("", {})]
    return [("", {}), (", Doppler", {"doppler_mps": scene.doppler_mps, "times_s": scene.times_s})]


def _odometry_rows(scene: Scene, seed: int, options: argparse.Namespace) -> Iterator[Row]:
    if scene.simulation is not None:
        motion = measured_motion(scene.simulation, seed=seed)
        times_s, doppler, rates = motion.times_s, motion.doppler_mps, motion.angular_velocity
    elif scene.doppler_mps is not None and scene.times_s is not None and seed == 0:
        times_s, doppler, rates = scene.times_s, scene.doppler_mps, None
    else:
        return
    for name in _SOURCES:
        imu = None
        if "gyroscope" in name:
            if rates is None:
                continue
            imu = Imu(times_s, rates, R_sensor_imu=np.eye(3))
        try:
            with timed() as taken:
                found = radarsdf.odometry(
                    scene.points,
                    doppler_mps=None if name == "returns alone" else doppler,
                    times_s=times_s,
                    imu=imu,
                )
        except ValueError as error:
            yield {"poses": name, "why_not": str(error)}
            continue
        row: Row = {"poses": name, "seconds": taken.wall_s, "segments": float(found.report["segments"])}
        part = found.longest_segment()
        row |= _trajectory_errors(found.poses[part], scene.poses[part], "found", found.covariance[part])
        if found.report["segments"] == 1:
            row |= _map_errors(scene, aligned(found.poses, scene.poses), "found", options)
        yield row


def _trajectory_errors(poses: Poses, true: Poses, name: str, covariance: np.ndarray | None = None) -> Row:
    # With alignment by positions alone, straight drives leave the rotation about them open.
    metrics = trajectory_metrics(poses, true)
    turns = trajectory_metrics(poses, true, align="poses")
    row: Row = {
        f"{name}_cm": 100 * metrics["absolute_m"],
        f"{name}_deg": float(np.degrees(turns["absolute_rad"])),
    }
    if covariance is not None:
        ratio, rad = metrics["relative_ratio"], metrics["relative_rad_per_m"]
        row |= {
            "relative_percent": None if ratio is None else 100 * ratio,
            "deg_per_m": None if rad is None else float(np.degrees(rad)),
            "nees": _nees(poses, true, covariance),
        }
    return row


def _nees(poses: Poses, true: Poses, covariance: np.ndarray) -> float | None:
    """Mean normalised squared error of positions over 3, relative to the middle scan: 1 is calibrated."""
    middle = len(poses) // 2
    others = np.arange(len(poses)) != middle
    if not np.linalg.det(covariance[others, :3, :3]).all():
        return None
    whole = true[middle] @ np.linalg.inv(poses[middle])
    off = np.einsum("ij,fjk->fik", whole, poses)[:, :3, 3] - true[:, :3, 3]
    off = np.einsum("ji,fj->fi", whole[:3, :3], off)
    squares = np.einsum(
        "fi,fi->f", off[others], np.linalg.solve(covariance[others, :3, :3], off[others, :, None])[..., 0]
    )
    return float(squares.mean() / 3)


def _map_errors(scene: Scene, poses: Poses, name: str, options: argparse.Namespace) -> Row:
    """F-score with nothing discarded, and the error of held-out intensities, of quick maps with these poses."""
    if scene.ground_truth is None:
        return {}
    config = scene.config("quick")
    whole = radarsdf.fit(scene.points, poses, config=config, progress=False)
    metrics = surface_metrics(
        whole.mesh(), scene.ground_truth, box=scene.box, samples=samples_of(options, 1_000_000)
    )
    row: Row = {f"f_{name}": 100 * metrics["f_score_all"]}
    if scene.intensities is None or name == "given":
        return row
    train, test = dataclasses.replace(scene, poses=poses).split()
    return row | {f"mae_{name}": errors_of(train.fit(config), test)["mae"]}


_STEP_S = 0.1  # between two scans, for time offsets


def walked(poses: Poses, sigma_m: float, sigma_deg: float, seed: int, yaw_deg: float = 0.0) -> Poses:
    """Add a random walk, with a bias in yaw."""
    return drifted(poses, sigma_m, np.radians(sigma_deg), seed, np.radians(yaw_deg))


def jumped(poses: Poses, jump_m: float, jump_deg: float, seed: int) -> Poses:
    """Displace all poses after the middle, as when odometry restarts."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(0, 1, 3)
    jump = np.concatenate([jump_m * direction / np.linalg.norm(direction), [0, 0, np.radians(jump_deg)]])
    found = poses.copy()
    middle = len(poses) // 2
    found[middle:] = (
        moved(poses[middle : middle + 1], jump[None])[0] @ np.linalg.inv(poses[middle]) @ found[middle:]
    )
    return found


def stale(poses: Poses) -> Poses:
    """Repeat every second pose, as from a slow source without interpolation."""
    return poses[np.arange(len(poses)) // 2 * 2]


def late(poses: Poses, time_offset_s: float) -> Poses:
    """Shift the clock of the poses, at ten scans per second."""
    times = _STEP_S * np.arange(len(poses))
    asked = np.clip(times - time_offset_s, 0, times[-1])
    found = poses.copy()
    found[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(asked).as_matrix()
    for axis in range(3):
        found[:, axis, 3] = np.interp(asked, times, poses[:, axis, 3])
    return found


BREAKAGES: dict[str, Callable[[Poses, int], Poses]] = {
    "none": lambda poses, _: poses,
    "walk of 0.01 m, 0.05°": lambda poses, seed: walked(poses, 0.01, 0.05, seed),
    "walk of 0.02 m, 0.1°": lambda poses, seed: walked(poses, 0.02, 0.1, seed),
    "walk of 0.05 m, 0.25°": lambda poses, seed: walked(poses, 0.05, 0.25, seed),
    "walk of 0.02 m, 0.05°, yaw 0.2° a step": lambda poses, seed: walked(poses, 0.02, 0.05, seed, 0.2),
    "a jump of 0.5 m, 2°": lambda poses, seed: jumped(poses, 0.5, 2.0, seed),
    "every second pose stale": lambda poses, _: stale(poses),
    "0.05 s late": lambda poses, _: late(poses, 0.05),
}
"""Error models applied to true poses, by name; the second argument is a seed."""
