# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses that drift, as those of wheels or of odometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from radarsdf.poses.rigid import moved, steps

__all__ = ["drifted"]

FloatArray = NDArray[np.float64]


def drifted(
    poses: FloatArray, sigma_m: float, sigma_rad: float, seed: int = 0, yaw_rad: float = 0.0
) -> FloatArray:
    """Poses with errors in each step from scan to scan, which add up.

    Parameters
    ----------
    poses : (F, 4, 4) ndarray
        T_world_sensor, m. The first one stays.
    sigma_m, sigma_rad : float
        Standard deviations of each component of a step's translation, m, and rotation, rad.
    seed : int
        Of the errors.
    yaw_rad : float
        By which all steps turn too far about the z axis of the sensor, rad.

    Returns
    -------
    (F, 4, 4) ndarray
        T_world_sensor, m.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=3)
    >>> given = radarsdf.simulate.drifted(scans.poses, 0.02, 0.002)
    >>> given.shape, bool((given[0] == scans.poses[0]).all())
    ((3, 4, 4), True)
    """
    rng = np.random.default_rng(seed)
    errors = rng.normal(0, 1, (len(poses) - 1, 6)) * np.repeat([sigma_m, sigma_rad], 3)
    errors[:, 5] += yaw_rad
    wrong = moved(np.tile(np.eye(4), (len(errors), 1, 1)), errors)
    found = [poses[0]]
    for step, error in zip(steps(poses), wrong, strict=True):
        found.append(found[-1] @ step @ error)
    return np.stack(found)
