# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses with the errors that real ones have."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from radarsdf.poses.rigid import moved
from radarsdf.simulate import drifted
from scipy.spatial.transform import Rotation, Slerp

Poses = NDArray[np.float64]

_STEP_S = 0.1  # between two scans, for what is late


def walked(poses: Poses, sigma_m: float, sigma_deg: float, seed: int, yaw_deg: float = 0.0) -> Poses:
    """A random walk, with a bias in yaw."""
    return drifted(poses, sigma_m, np.radians(sigma_deg), seed, np.radians(yaw_deg))


def jumped(poses: Poses, jump_m: float, jump_deg: float, seed: int) -> Poses:
    """All poses after the middle are elsewhere, as when odometry begins anew."""
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
    """Every second pose is the one before, as of a slow source without interpolation."""
    return poses[np.arange(len(poses)) // 2 * 2]


def late(poses: Poses, late_s: float) -> Poses:
    """The poses of a clock that is late, of scans ten times a second."""
    times = _STEP_S * np.arange(len(poses))
    asked = np.clip(times - late_s, 0, times[-1])
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
"""What is done to true poses, by name; the second argument is a seed."""
