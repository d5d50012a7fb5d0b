# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a radar and a gyroscope measure of their own motion: times, Doppler, angular velocity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf.checks import instance, not_negative, positive

from .radar import generator
from .simulation import Simulation

__all__ = ["MeasuredMotion", "measured_motion"]

FloatArray = NDArray[np.float64]

_MOTION_STREAM = 2**31 + 1  # no scan has this number
_MOVER_MPS = 5.0  # deviation of the speed of what moves


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Of F scans."""

    times_s: FloatArray
    """(F,)."""
    doppler_mps: list[NDArray[np.float32]]
    """F arrays (N_i,): speed along the ray, positive away from the sensor."""
    angular_velocity: FloatArray
    """(F, 3) rad/s, frame of the sensor, at the times of the scans."""


def measured_motion(
    simulation: Simulation,
    *,
    rate_hz: float = 10.0,
    times_s: FloatArray | None = None,
    way: tuple[FloatArray, FloatArray] | None = None,
    doppler_noise_mps: float = 0.1,
    interval_mps: float | None = None,
    movers: float = 0.1,
    gyroscope_noise_rad_s: float = 0.005,
    gyroscope_bias_rad_s: tuple[float, float, float] = (0.002, -0.003, 0.0035),
    seed: int = 0,
) -> MeasuredMotion:
    """Measure the motion of a simulation, whose poses a smooth curve joins.

    Parameters
    ----------
    simulation : Simulation
        F scans, at least two.
    rate_hz : float
        Scans in a second.
    times_s : (F,) float64, optional
        Of the scans, ascending. Default: by `rate_hz`.
    way : (K,) and (K, 4, 4) float64, optional
        Times and poses of the whole way, such as those of a :class:`LegDrive`, where scans are too far apart for a curve.
    doppler_noise_mps : float
        Standard deviation.
    interval_mps : float, optional
        Width of the interval, centred on 0, into which speeds are folded. Default: none are.
    movers : float
        Share of the returns that move by themselves, at places where nothing was seen to move.
    gyroscope_noise_rad_s : float
        Standard deviation of each component at each scan.
    gyroscope_bias_rad_s : three floats
        Added to all rates.
    seed : int
        Seed of all random numbers.

    Returns
    -------
    MeasuredMotion
        The same arguments give the same result, bit by bit.

    Raises
    ------
    ValueError
        If there are fewer than two scans.

    Examples
    --------
    >>> from radarsdf.simulate import measured_motion, wall
    >>> motion = measured_motion(wall(frames=3))
    >>> motion.times_s.round(3), motion.angular_velocity.shape
    (array([0. , 0.1, 0.2]), (3, 3))
    """
    instance(simulation, Simulation, "simulation")
    if len(simulation) < 2:
        msg = "a motion has two scans or more"
        raise ValueError(msg)
    if times_s is None:
        times_s = np.arange(len(simulation), dtype=np.float64) / positive(rate_hz, "rate_hz")
    not_negative(movers, "movers")
    poses = simulation.poses
    at_s, on_way = (times_s, poses) if way is None else way
    velocities = CubicSpline(at_s, on_way[:, :3, 3])(times_s, 1)
    in_sensor = np.einsum("fji,fj->fi", poses[:, :3, :3], velocities)
    # SciPy's rates are in the frame of the turned body.
    rates = RotationSpline(at_s, Rotation.from_matrix(on_way[:, :3, :3]))(times_s, 1)
    doppler_mps = []
    for i, points in enumerate(simulation.points):
        rng = generator(seed, _MOTION_STREAM, i)
        directions = points / np.linalg.norm(points, axis=1, keepdims=True)
        speeds = -np.einsum("ni,i->n", directions, in_sensor[i])
        speeds += doppler_noise_mps * rng.standard_normal(len(speeds))
        speeds += (rng.random(len(speeds)) < movers) * _MOVER_MPS * rng.standard_normal(len(speeds))
        if interval_mps is not None:
            half = positive(interval_mps, "interval_mps") / 2
            speeds = (speeds + half) % (2 * half) - half
        doppler_mps.append(speeds.astype(np.float32))
    rng = generator(seed, _MOTION_STREAM, len(poses))
    noise = not_negative(gyroscope_noise_rad_s, "gyroscope_noise_rad_s") * rng.standard_normal(
        (len(poses), 3)
    )
    return MeasuredMotion(times_s, doppler_mps, rates + gyroscope_bias_rad_s + noise)
