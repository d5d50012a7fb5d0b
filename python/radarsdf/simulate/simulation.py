"""Radar scans of a scene from given poses, and lidar points of the same scene as ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from radarsdf.arrays import Bools, Floats, Floats32
from radarsdf.checks import check_poses, instance

from .radar import Origin, RadarSensor, generator, unit_vectors
from .world import Scene

_LIDAR_RAYS = 10_000  # rays per pose
_LIDAR_SIGMA_M = 0.01
_LIDAR_CELL_M = 0.05  # one lidar point per cell, or most would lie on the ground near the sensor
_LIDAR_STREAM = 2**31  # no scan has this index


@dataclass(frozen=True, eq=False)
class Lidar:
    """A lidar at some of the radar's poses with its field of view and range, which sees the surfaces detectable by radar."""

    scene: Scene
    sensor: RadarSensor
    poses: Floats  # (F, 4, 4) T_world_sensor, m
    seed: int

    @cached_property
    def points(self) -> Floats:
        """(M, 3) world, m, computed on first access: ray casting takes as long as the scans."""
        rng, sensor = generator(self.seed, _LIDAR_STREAM), self.sensor
        found = [np.zeros((0, 3))]
        every = max(1, len(self.poses) // 40)  # neighbouring poses see the same surfaces
        for T_world_sensor in self.poses[::every]:
            u = rng.uniform(-1, 1, size=(_LIDAR_RAYS, 2))
            elevation = np.arcsin(u[:, 1] * np.sin(sensor.elevation_fov_rad / 2))
            angles = np.stack([u[:, 0] * sensor.azimuth_fov_rad / 2, elevation], axis=1)
            directions, origin = unit_vectors(angles) @ T_world_sensor[:3, :3].T, T_world_sensor[:3, 3]
            hits = self.scene.raycast(origin, directions, sensor.max_range_m)
            visible = sensor.echo_power_db(self.scene, origin, directions, hits) >= sensor.threshold_db
            visible &= hits.range_m >= sensor.min_range_m
            range_m = hits.range_m[visible] + _LIDAR_SIGMA_M * rng.standard_normal(int(visible.sum()))
            found.append(origin + range_m[:, None] * directions[visible])
        points = np.concatenate(found)
        cells = np.floor(points / _LIDAR_CELL_M).astype(np.int64)
        _, first = np.unique(cells, axis=0, return_index=True)
        return points[np.sort(first)]


@dataclass(frozen=True, eq=False)
class Simulation:
    """Simulated radar scans with poses and ground truth.

    There are F scans, with N_i returns in scan i.
    """

    points: list[Floats32]  # F arrays (N_i, 3), sensor frame, m
    poses: Floats  # (F, 4, 4) T_world_sensor, m
    intensities: list[Floats32]  # F arrays (N_i,), dB
    noiseless_intensities: list[Floats32]  # F arrays (N_i,), dB, without speckle and noise; NaN: false return
    origin_kind: list[NDArray[np.int8]]  # F arrays (N_i,), codes of `Origin`
    scene: Scene
    sensor: RadarSensor
    name: str
    seed: int
    lidar: Lidar

    @property
    def ground_truth(self) -> Floats:
        """(M, 3) lidar points of the surfaces that the radar can detect, world frame, m.

        They have a noise of 1 cm along the ray, and at most one point per cell of 5 cm.
        """
        return self.lidar.points

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.points)

    def world_points(self) -> Floats:
        """All returns, false ones included: (N, 3) float64, world frame, m, in the order of the scans."""
        scans = zip(self.points, self.poses, strict=True)
        return np.concatenate([p.astype(np.float64) @ T[:3, :3].T + T[:3, 3] for p, T in scans])

    def is_surface(self) -> Bools:
        """Mask of the returns from a surface, (N,) bool, in the order of `world_points`."""
        return np.concatenate(self.origin_kind) == Origin.SURFACE

    def intensity_noise_floor(self) -> float:
        """Mean absolute difference between measured and noiseless intensities of the surface returns, dB.

        It is the error of a perfect model of scene and sensor. That of a fit can be slightly lower: near the detection threshold,
        only returns with positive noise are detected, and a fit learns this bias.
        """
        error = np.abs(np.concatenate(self.intensities) - np.concatenate(self.noiseless_intensities))
        surface = self.is_surface()
        return float(error[surface].mean(dtype=np.float64)) if surface.any() else float("nan")


def simulate(scene: Scene, sensor: RadarSensor, poses: Floats, *, name: str, seed: int = 0) -> Simulation:
    """Scan a scene from every pose.

    Parameters
    ----------
    scene, sensor : Scene, RadarSensor
        The world, and the radar.
    poses : (F, 4, 4) float64
        T_world_sensor, m.
    name : str
        Name of the simulation.
    seed : int
        Seed of all random numbers. The same arguments give the same result, bit by bit.

    Returns
    -------
    Simulation
        One scan per pose.

    Raises
    ------
    ValueError
        If a pose is not a rigid transform.
    """
    instance(scene, Scene, "scene")
    instance(sensor, RadarSensor, "sensor")
    poses = check_poses(poses)
    scans = [sensor.scan(scene, T_world_sensor, seed, frame) for frame, T_world_sensor in enumerate(poses)]
    columns = ("points", "intensities", "noiseless_intensities", "origin_kind")
    of_scans = {column: [getattr(scan, column) for scan in scans] for column in columns}
    lidar = Lidar(scene, sensor, poses.copy(), seed)
    return Simulation(poses=poses, scene=scene, sensor=sensor, name=name, seed=seed, lidar=lidar, **of_scans)
