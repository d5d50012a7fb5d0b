# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Radar scans with lidar scans of the same places: recorded ones, and simulated ones with a lidar of their kind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from radarsdf.simulate import Simulation

FloatArray = NDArray[np.float64]

MIN_RANGE_M = 2.5
# A lidar as on the recorded drives: 16 rings. Weak echoes are lost: the drives have half of their lidar points within
# 18 m, and a twentieth beyond 45 m.
_RINGS_RAD = np.deg2rad(np.arange(-15.0, 15.1, 2.0))
_COLUMN_RAD = np.deg2rad(0.3)
_LIDAR_ABOVE_RADAR_M = 0.4
_LIDAR_MAX_RANGE_M = 100.0
_LIDAR_SIGMA_M = 0.02
_LIDAR_SURE_M = (
    100.0  # a matt surface seen straight on is always found up to here; the power falls with range squared
)


@dataclass(frozen=True, eq=False)
class Drive:
    """N returns of F radar scans and M lidar points."""

    name: str
    points: FloatArray  # (N, 3) sensor frame, m
    intensities: FloatArray  # (N,) dB
    frame: NDArray[np.int64]  # (N,) number of the scan
    poses: FloatArray  # (F, 4, 4) T_world_sensor
    lidar: FloatArray  # (M, 3) world frame, m
    lidar_frame: NDArray[np.int64]  # (M,)

    def range_m(self) -> FloatArray:
        """Distance (N,) from the sensor, m."""
        range_m: FloatArray = np.linalg.norm(self.points, axis=1)
        return range_m

    def in_world(self, vectors: FloatArray) -> FloatArray:
        """One vector (N, 3) in the sensor frame for each return, turned into the world frame."""
        turned: FloatArray = np.einsum("nij,nj->ni", self.poses[self.frame, :3, :3], vectors)
        return turned

    def world_points(self) -> FloatArray:
        """The returns (N, 3) in the world frame, m."""
        return self.in_world(self.points) + self.poses[self.frame, :3, 3]


def recorded(path: Path) -> Drive:
    """A drive from an .npz file with `lidar_frame` besides the arrays of `read_scans`; static returns only."""
    with np.load(path) as arrays:
        used = arrays["static"] & (np.linalg.norm(arrays["points"], axis=1) >= MIN_RANGE_M)
        return Drive(
            name=path.stem,
            points=arrays["points"][used].astype(np.float64),
            intensities=arrays["intensity"][used].astype(np.float64),
            frame=arrays["frame"][used].astype(np.int64),
            poses=arrays["poses"].astype(np.float64),
            lidar=arrays["lidar_points"].astype(np.float64),
            lidar_frame=arrays["lidar_frame"].astype(np.int64),
        )


def with_lidar(simulation: Simulation, same_lidar: Drive | None = None) -> Drive:
    """A simulated drive, with the points that a lidar of 16 rings finds on its surfaces.

    They do not depend on the radar: they can be those of another drive through the same scene, with the same poses.
    """
    points = np.concatenate(simulation.points).astype(np.float64)
    used = np.linalg.norm(points, axis=1) >= MIN_RANGE_M
    if same_lidar is None:
        scans = [_lidar_scan(simulation, frame) for frame in range(len(simulation))]
        lidar, lidar_frame = (
            np.concatenate(scans),
            np.repeat(np.arange(len(scans)), [len(scan) for scan in scans]),
        )
    else:
        lidar, lidar_frame = same_lidar.lidar, same_lidar.lidar_frame
    return Drive(
        name=f"{simulation.name}, seed {simulation.seed}",
        points=points[used],
        intensities=np.concatenate(simulation.intensities).astype(np.float64)[used],
        frame=np.repeat(np.arange(len(simulation)), [len(scan) for scan in simulation.points])[used],
        poses=simulation.poses,
        lidar=lidar,
        lidar_frame=lidar_frame,
    )


def _lidar_scan(simulation: Simulation, frame: int) -> FloatArray:
    rng = np.random.default_rng([simulation.seed, frame])
    azimuth = np.arange(-np.pi, np.pi, _COLUMN_RAD)
    angles = np.stack(np.meshgrid(azimuth, _RINGS_RAD), axis=-1).reshape(-1, 2)
    cos = np.cos(angles[:, 1])
    ahead, left, up = cos * np.cos(angles[:, 0]), cos * np.sin(angles[:, 0]), np.sin(angles[:, 1])
    T_world_sensor = simulation.poses[frame]
    directions = np.stack([ahead, left, up], axis=1) @ T_world_sensor[:3, :3].T
    origin = T_world_sensor[:3, 3] + _LIDAR_ABOVE_RADAR_M * T_world_sensor[:3, 2]
    hits = simulation.scene.raycast(origin, directions, _LIDAR_MAX_RANGE_M)
    cos_incidence = np.abs(np.einsum("ni,ni->n", hits.normals, directions))
    found = rng.random(len(directions)) < cos_incidence * (_LIDAR_SURE_M / hits.range_m) ** 2
    range_m = hits.range_m[found] + _LIDAR_SIGMA_M * rng.standard_normal(int(found.sum()))
    points: FloatArray = origin + range_m[:, None] * directions[found]
    return points
