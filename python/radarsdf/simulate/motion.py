# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Drives through a simulated scene, what a radar, a gyroscope and an IMU measure of their motion, and poses that drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf.checks import check_poses, instance, not_negative, positive, real_array
from radarsdf.io.imu import Imu, checked_rotation
from radarsdf.poses.rigid import moved, steps

from .radar import generator
from .simulation import Simulation, simulate

__all__ = ["Leg", "LegDrive", "MeasuredMotion", "drifted", "drive_legs", "measured_imu", "measured_motion"]

FloatArray = NDArray[np.float64]

_WAY_HZ = 50.0  # poses of the whole way, between which a spline is exact enough for an IMU
_PEAK = 1.875  # largest over mean speed of a leg that begins and ends at rest
_CLOSED_STEPS = 2.5  # mean steps between the last and the first pose of a path that is closed
_MOTION_STREAM = 2**31 + 1  # no scan has this number
_MOVER_MPS = 5.0  # deviation of the speed of what moves
_IMU_STREAM = 2**31 + 2  # no scan has this number
_GRAVITY_MPS2 = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class Leg:
    """A part of a drive, which begins and ends at rest. It moves and turns at the same time, and then waits."""

    ahead_m: float = 0.0
    """Along the path of the simulation, the way that the sensor looks; less than 0: backwards."""
    turn_deg: float = 0.0
    """To the left. With `ahead_m`, on top of the bends of the path."""
    wait_s: float = 0.0
    """How long it then stands still."""
    scanned: bool = True
    """False: there are no scans meanwhile."""


@dataclass(frozen=True, eq=False)
class LegDrive:
    """F scans of a drive, and the whole way."""

    simulation: Simulation
    """The scans, with their true poses."""
    times_s: FloatArray
    """(F,) when they were taken."""
    way_times_s: FloatArray
    """(K,) times from begin to end, fifty in a second."""
    way_poses: FloatArray
    """(K, 4, 4) T_world_sensor at these times, m, in gaps too."""


def drive_legs(
    simulation: Simulation,
    legs: Sequence[Leg],
    *,
    speed_mps: float = 4.0,
    turn_deg_s: float = 60.0,
    rate_hz: float = 10.0,
    seed: int = 0,
) -> LegDrive:
    """Drive once more along the path of a simulation, in legs.

    Parameters
    ----------
    simulation : Simulation
        Its scene, its radar and the path of its poses are used. A path whose ends meet may be driven round and round.
    legs : sequence of Leg
        One after another, from the first pose of the simulation.
    speed_mps, turn_deg_s : float
        Largest speed and rate of turning.
    rate_hz : float
        Scans in a second.
    seed : int
        Seed of the scans.

    Returns
    -------
    LegDrive
        For :func:`measured_motion` and :func:`measured_imu`. The same arguments give the same result, bit by bit.

    Raises
    ------
    ValueError
        If a leg leads beyond the end of the path, or the simulation has none.

    Examples
    --------
    >>> from radarsdf.simulate import Leg, drive_legs, wall
    >>> drive = drive_legs(wall(frames=9), [Leg(ahead_m=4), Leg(turn_deg=180), Leg(ahead_m=4, scanned=False), Leg(wait_s=0.5)])
    >>> drive.simulation.poses.shape, drive.way_poses[[0, -1], 0, 3].round(1).tolist()
    ((81, 4, 4), [3.3, 3.3])
    """
    instance(simulation, Simulation, "simulation")
    positive(speed_mps, "speed_mps")
    positive(turn_deg_s, "turn_deg_s")
    path = _Path.of(simulation.poses)
    times, along, yaw, scanned = _profile(legs, speed_mps, np.radians(turn_deg_s))
    way = path.poses(along, yaw)
    step = _WAY_HZ / positive(rate_hz, "rate_hz")
    rows = np.unique(np.arange(0, len(times) - 1e-9, step).astype(np.int64))
    rows = rows[scanned[rows]]  # the first pose is
    name = f"{simulation.name}, in legs"
    found = simulate(simulation.scene, simulation.sensor, way[rows], name=name, seed=seed)
    return LegDrive(found, times[rows], times, way)


def _profile(
    legs: Sequence[Leg], speed_mps: float, turn_rad_s: float
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Of each 1 / `_WAY_HZ`: time, s; place along the path, m; yaw on top of the path's, rad; whether it is scanned."""
    along, yaw, scanned = [np.zeros(1)], [np.zeros(1)], [np.ones(1, bool)]
    for leg in legs:
        turn = float(np.radians(leg.turn_deg))
        move_s = _PEAK * max(abs(leg.ahead_m) / speed_mps, abs(turn) / turn_rad_s)
        moving, waiting = (int(np.ceil(s * _WAY_HZ)) for s in (move_s, leg.wait_s))
        share = np.concatenate([np.arange(1, moving + 1) / max(moving, 1), np.ones(waiting)])
        share = share**3 * (10 - 15 * share + 6 * share**2)  # with speed and acceleration 0 at both ends
        # Ahead is where the sensor looks as the leg begins.
        facing = 1.0 if np.cos(yaw[-1][-1]) >= 0 else -1.0
        along.append(along[-1][-1] + share * leg.ahead_m * facing)
        yaw.append(yaw[-1][-1] + share * turn)
        scanned.append(np.full(len(share), leg.scanned))
    places = np.concatenate(along)
    return np.arange(len(places)) / _WAY_HZ, places, np.concatenate(yaw), np.concatenate(scanned)


@dataclass(frozen=True)
class _Path:
    """A curve through poses, by the length from the first."""

    positions: CubicSpline
    rotations: RotationSpline
    length_m: float
    closed: bool

    @classmethod
    def of(cls, poses: FloatArray) -> _Path:
        if len(poses) < 4:
            msg = f"a path has four poses or more, not {len(poses)}"
            raise ValueError(msg)
        step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        if not (step_m > 0).all():
            msg = "the simulation stands still: there is no path"
            raise ValueError(msg)
        closed = bool(
            np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < _CLOSED_STEPS * float(np.median(step_m))
        )
        rows = np.append(np.arange(len(poses)), 0) if closed else np.arange(len(poses))
        steps = np.linalg.norm(np.diff(poses[rows, :3, 3], axis=0), axis=1)
        at_m = np.concatenate([[0.0], np.cumsum(steps)])
        positions = CubicSpline(at_m, poses[rows, :3, 3], bc_type="periodic" if closed else "not-a-knot")
        rotations = RotationSpline(at_m, Rotation.from_matrix(poses[rows, :3, :3]))
        return cls(positions, rotations, float(at_m[-1]), closed)

    def poses(self, along_m: FloatArray, yaw: FloatArray) -> FloatArray:
        """(K, 4, 4) at places (K,), m, turned to the left by `yaw` (K,), rad."""
        if self.closed:
            along_m = along_m % self.length_m
        elif along_m.min() < -1e-9 or along_m.max() > self.length_m + 1e-9:
            msg = (
                f"the legs lead from {along_m.min():.1f} to {along_m.max():.1f} m, beyond the path of {self.length_m:.1f} m; "
                "legs go ahead where the sensor looks: turn by 180 degrees to come back"
            )
            raise ValueError(msg)
        along_m = np.clip(along_m, 0, self.length_m)
        turn = np.zeros((len(yaw), 3))
        turn[:, 2] = yaw
        found = np.tile(np.eye(4), (len(yaw), 1, 1))
        found[:, :3, 3] = self.positions(along_m)
        found[:, :3, :3] = (self.rotations(along_m) * Rotation.from_rotvec(turn)).as_matrix()
        return found


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
    gyroscope = not_negative(gyroscope_noise_rad_s, "gyroscope_noise_rad_s") * rng.standard_normal((count, 3))
    accelerometer = not_negative(accelerometer_noise_mps2, "accelerometer_noise_mps2") * rng.standard_normal(
        (count, 3)
    )
    return Imu(
        times, rates + gyroscope_bias_rad_s + gyroscope, forces + accelerometer_bias_mps2 + accelerometer
    )


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
