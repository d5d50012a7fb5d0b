# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Smooth poses along a path, with a little heave, pitch and roll as of a vehicle."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .terrain import Terrain

__all__ = ["along_path"]

FloatArray = NDArray[np.float64]


def along_path(
    terrain: Terrain,
    path: Callable[[FloatArray], FloatArray],
    frames: int,
    *,
    height_m: float,
    rng: np.random.Generator,
    look_at: FloatArray | None = None,
) -> FloatArray:
    """Poses at equal steps along a path over the ground.

    Parameters
    ----------
    terrain : Terrain
        The ground.
    path : callable
        Maps values (N,) in 0..1 to positions (N, 2), world frame, m.
    frames : int
        Number of poses, at least 1.
    height_m : float
        Mean height of the sensor above the ground.
    rng : Generator
        Draws heave, pitch and roll: at most 3 cm, and 1.2 degrees each.
    look_at : (2,) float64, optional
        Position in the world frame, m, that the sensor looks at. Default: it looks ahead.

    Returns
    -------
    (frames, 4, 4) float64
        T_world_sensor: x forward, y left, z up.

    Raises
    ------
    ValueError
        If `frames` is less than 1.
    """
    if frames < 1:
        msg = f"frames must be at least 1, not {frames}"
        raise ValueError(msg)
    u = (np.arange(frames) + 0.5) / frames
    xy = path(u)
    ahead = look_at - xy if look_at is not None else path(u + 1e-4) - path(u - 1e-4)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    # Two sines of different frequency for each of heave, pitch and roll, so that the motion does not repeat.
    cycles, phase = rng.uniform([3, 7], [6, 12], size=(3, 2)), rng.uniform(0, 2 * np.pi, size=(3, 2))
    swing = np.sin(2 * np.pi * u[:, None, None] * cycles + phase).mean(axis=2) * [0.03, 0.02, 0.02]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler(
        "ZYX", np.stack([yaw, swing[:, 1], swing[:, 2]], axis=1)
    ).as_matrix()
    poses[:, :2, 3] = xy
    poses[:, 2, 3] = terrain.height(xy) + height_m + swing[:, 0]
    return poses
