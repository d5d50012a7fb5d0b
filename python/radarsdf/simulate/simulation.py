# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Drive a radar through a scene, and a lidar after it for the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import check_poses

from .radar import Origin, RadarSensor, generator, unit_vectors
from .scene import Scene

__all__ = ["Simulation", "lidar_points", "simulate"]

FloatArray = NDArray[np.float64]

_LIDAR_SIGMA_M = 0.01
_LIDAR_VOXEL_M = (
    0.05  # one lidar point per cell: otherwise most of them would lie on the ground near the sensor
)
_LIDAR_STREAM = 2**31  # no frame has this number


@dataclass(frozen=True, eq=False)
class Simulation:
    """Radar scans with poses, and everything a real data set does not tell.

    F frames, N_i returns in frame i.
    """

    points: list[NDArray[np.float32]]  # F arrays (N_i, 3), sensor frame, metres
    poses: FloatArray  # (F, 4, 4) T_world_sensor
    intensities: list[NDArray[np.float32]]  # F arrays (N_i,), sensor units, dB
    noiseless_intensities: list[NDArray[np.float32]]  # F arrays (N_i,), no noise, no steps; NaN: false return
    origin_kind: list[NDArray[np.int8]]  # F arrays (N_i,), codes of `Origin`
    ground_truth: FloatArray  # (M, 3) lidar points of what the radar could see, world frame, metres
    scene: Scene
    sensor: RadarSensor
    name: str
    seed: int

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.points)

    @property
    def num_returns(self) -> int:
        """Number of returns in all frames, false ones included."""
        return sum(len(points) for points in self.points)

    def world_points(self) -> FloatArray:
        """All returns, (num_returns, 3) float64, world frame, metres, in the order of the frames."""
        moved = [
            p.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
            for p, T in zip(self.points, self.poses, strict=True)
        ]
        return np.concatenate(moved)

    def is_surface(self) -> NDArray[np.bool_]:
        """Which of `world_points` are true returns, (num_returns,) bool."""
        surface: NDArray[np.bool_] = np.concatenate(self.origin_kind) == Origin.SURFACE
        return surface

    def intensity_noise_floor(self) -> float:
        """Mean absolute error, in dB, of the noiseless intensities over the surface returns.

        The error of one who knows scene and sensor but not speckle and noise. Near the detection threshold only lucky
        returns survive, so a fit to them, which sees their bias, may come out slightly lower.
        """
        error = np.abs(np.concatenate(self.intensities) - np.concatenate(self.noiseless_intensities))
        surface = self.is_surface()
        return float(error[surface].mean(dtype=np.float64)) if surface.any() else float("nan")


def simulate(
    scene: Scene,
    sensor: RadarSensor,
    poses: FloatArray,
    *,
    name: str,
    seed: int = 0,
    lidar_rays: int = 10_000,
) -> Simulation:
    """Scan a scene from every pose.

    Parameters
    ----------
    scene : Scene
        What is there.
    sensor : RadarSensor
        What looks at it.
    poses : (F, 4, 4) float64
        T_world_sensor.
    name : str
        Kept in the result.
    seed : int
        Fixes every random number: same arguments, same bits.
    lidar_rays : int
        Rays cast from a pose for the ground truth; of more than 80 poses only every n-th is used, 40 to 79.

    Returns
    -------
    Simulation
        With one entry per pose.
    """
    poses = check_poses(poses, len(poses))
    scans = [sensor.scan(scene, T_world_sensor, seed, frame) for frame, T_world_sensor in enumerate(poses)]
    return Simulation(
        points=[scan.points for scan in scans],
        poses=poses,
        intensities=[scan.intensities for scan in scans],
        noiseless_intensities=[scan.noiseless_intensities for scan in scans],
        origin_kind=[scan.origin_kind for scan in scans],
        ground_truth=lidar_points(scene, sensor, poses, seed, lidar_rays),
        scene=scene,
        sensor=sensor,
        name=name,
        seed=seed,
    )


def lidar_points(scene: Scene, sensor: RadarSensor, poses: FloatArray, seed: int, rays: int) -> FloatArray:
    """Dense points of the surfaces the radar could see: in its field of view and range, with an echo it detects.

    Parameters
    ----------
    scene, sensor, poses, seed
        As in `simulate`.
    rays : int
        Rays from a pose.

    Returns
    -------
    (M, 3) float64
        World frame, metres, 1 cm of noise along the ray, at most one point in a cell of 5 cm.
    """
    rng = generator(seed, _LIDAR_STREAM)
    poses = poses[:: max(1, len(poses) // 40)]  # neighbouring poses see the same
    found = [np.zeros((0, 3))]
    for T_world_sensor in poses:
        u = rng.uniform(-1, 1, size=(rays, 2))
        elevation = np.arcsin(u[:, 1] * np.sin(sensor.elevation_fov_rad / 2))
        angles = np.stack([u[:, 0] * sensor.azimuth_fov_rad / 2, elevation], axis=1)
        directions, origin = unit_vectors(angles) @ T_world_sensor[:3, :3].T, T_world_sensor[:3, 3]
        hits = scene.raycast(origin, directions, sensor.max_range_m)
        visible = sensor.echo_power_db(scene, origin, directions, hits) >= sensor.threshold_db
        visible &= hits.range_m >= sensor.min_range_m
        range_m = hits.range_m[visible] + _LIDAR_SIGMA_M * rng.standard_normal(int(visible.sum()))
        found.append(origin + range_m[:, None] * directions[visible])
    points = np.concatenate(found)
    cells = np.floor(points / _LIDAR_VOXEL_M).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]
