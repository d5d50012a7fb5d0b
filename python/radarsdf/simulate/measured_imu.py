# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What an IMU on the sensor measures."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf.checks import check_poses, not_negative, positive, real_array
from radarsdf.io.imu import Imu, checked_rotation

from .radar import generator

__all__ = ["measured_imu"]

FloatArray = NDArray[np.float64]

_IMU_STREAM = 2**31 + 2  # no scan has this number
_GRAVITY_MPS2 = np.array([0.0, 0.0, -9.81])


def measured_imu(
    poses: ArrayLike,
    times_s: ArrayLike,
    *,
    rate_hz: float = 100.0,
    R_sensor_imu: ArrayLike | None = None,
    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gyroscope_noise_rad_s: float = 0.005,
    gyroscope_bias_rad_s: tuple[float, float, float] = (0.002, -0.003, 0.0035),
    accelerometer_noise_mps2: float = 0.05,
    accelerometer_bias_mps2: tuple[float, float, float] = (0.03, -0.02, 0.04),
    seed: int = 0,
) -> Imu:
    """Measure a motion by an IMU: along the smooth curve that joins poses.

    Parameters
    ----------
    poses : (F, 4, 4) array_like
        T_world_sensor, m, at least two, such as those of a simulation. z is up.
    times_s : (F,) array_like
        When the sensor was there, ascending, such as :func:`measured_motion` says.
    rate_hz : float
        Measurements in a second.
    R_sensor_imu : (3, 3) array_like, optional
        Rotation from the axes of the IMU to those of the sensor. Default: they are the same.
    lever_m : three floats
        Position of the sensor in the axes of the IMU.
    gyroscope_noise_rad_s, accelerometer_noise_mps2 : float
        Standard deviation of each component of each measurement.
    gyroscope_bias_rad_s, accelerometer_bias_mps2 : three floats
        Added to all measurements.
    seed : int
        Seed of all random numbers.

    Returns
    -------
    Imu
        It does not tell its axes: its `R_sensor_imu` is None. The same arguments give the same result, bit by bit.

    Raises
    ------
    ValueError
        If there are fewer than two poses, or times are not as many or do not ascend.

    Examples
    --------
    >>> from radarsdf.simulate import measured_imu, wall
    >>> imu = measured_imu(wall(frames=3).poses, [0.0, 10.0, 20.0])
    >>> len(imu), imu.angular_velocity.shape, imu.R_sensor_imu is None
    (2001, (2001, 3), True)
    """
    at_s: FloatArray = real_array(times_s, "times_s")
    way = check_poses(poses)
    if len(way) < 2 or at_s.shape != (len(way),) or not (np.diff(at_s) > 0).all():
        msg = f"a motion has two poses or more, and an ascending time for each: {len(way)} poses, times {at_s.shape}"
        raise ValueError(msg)
    R_imu = np.eye(3) if R_sensor_imu is None else checked_rotation(R_sensor_imu)
    count = int(np.floor((at_s[-1] - at_s[0]) * positive(rate_hz, "rate_hz") + 1e-6)) + 1
    times = at_s[0] + np.arange(count) / rate_hz
    turning = RotationSpline(at_s, Rotation.from_matrix(way[:, :3, :3]))
    # SciPy's rates are in the frame of the turned body, here turned on into that of the IMU.
    rates, changes = (np.einsum("ji,gj->gi", R_imu, turning(times, order)) for order in (1, 2))
    R_world_imu = np.einsum("gij,jk->gik", turning(times).as_matrix(), R_imu)
    lever = np.asarray(lever_m, np.float64)
    of_lever = np.cross(changes, lever) + np.cross(rates, np.cross(rates, lever))
    accelerations = CubicSpline(at_s, way[:, :3, 3])(times, 2) - _GRAVITY_MPS2
    forces = np.einsum("gji,gj->gi", R_world_imu, accelerations) - of_lever
    rng = generator(seed, _IMU_STREAM, 0)
    noises = (
        not_negative(gyroscope_noise_rad_s, "gyroscope_noise_rad_s"),
        not_negative(accelerometer_noise_mps2, "accelerometer_noise_mps2"),
    )
    measured = [
        values + bias + noise * rng.standard_normal((count, 3))
        for values, bias, noise in (
            (rates, gyroscope_bias_rad_s, noises[0]),
            (forces, accelerometer_bias_mps2, noises[1]),
        )
    ]
    return Imu(times, *measured)
