"""Measurements of a radar, a gyroscope and an IMU on a simulated drive, drifting poses, and rigs of several radars."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf.arrays import ArrayLike, Floats, Floats32
from radarsdf.checks import check, check_poses, positive, real_array
from radarsdf.poses.rigid import assembled, steps, transform
from radarsdf.rig import Imu, Label, Rig, checked_rotation
from radarsdf.scans import Scans

from .radar import RadarSensor, Simulation, generator, simulate
from .world import Scene

_MOTION_STREAM, _IMU_STREAM, _RIG_STREAM = 2**31 + 1, 2**31 + 2, 2**31 + 4  # no scan has these numbers
_DOPPLER_SIGMA_MPS = 0.1
_MOVING_SHARE, _MOVING_SIGMA_MPS = 0.1, 5.0  # share and speed of moving returns
_GYROSCOPE_SIGMA_RAD_S = 0.005  # per component
_GYROSCOPE_BIAS_RAD_S = (0.002, -0.003, 0.0035)
_ACCELEROMETER_SIGMA_MPS2 = 0.05
_ACCELEROMETER_BIAS_MPS2 = (0.03, -0.02, 0.04)
_GRAVITY_MPS2 = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Measurements of a radar and a gyroscope during F scans."""

    times_s: Floats
    """(F,) times of the scans, s."""
    doppler_mps: list[Floats32]
    """F arrays (N_i,): radial velocity, m/s, positive away from the sensor."""
    angular_velocity: Floats
    """(F, 3) rad/s, frame of the sensor, at the times of the scans."""


def measured_motion(
    simulation: Simulation,
    *,
    rate_hz: float = 10.0,
    interval_mps: float | None = None,
    gyroscope_bias_rad_s: tuple[float, float, float] = _GYROSCOPE_BIAS_RAD_S,
    seed: int = 0,
) -> MeasuredMotion:
    """Measure the motion along the smooth curve through the poses of a simulation.

    Doppler has a standard deviation of 0.1 m/s, and a tenth of the returns move on their own, with a standard deviation of
    5 m/s. Each component of the gyroscope has a standard deviation of 0.005 rad/s. Raises a ValueError for fewer than two scans.

    Parameters
    ----------
    simulation : Simulation
        F scans, at least two.
    rate_hz : float
        Scan rate, Hz.
    interval_mps : float, optional
        Width of the ambiguity interval, centred on 0, into which speeds are folded, m/s. Default: no folding.
    gyroscope_bias_rad_s : three floats
        Bias of the rates, rad/s.
    seed : int
        Seed of all random numbers.

    Returns
    -------
    MeasuredMotion
        The same arguments give the same result, bit by bit.

    Examples
    --------
    >>> from radarsdf.simulate import measured_motion, wall
    >>> motion = measured_motion(wall(frames=3))
    >>> motion.times_s.round(3), motion.angular_velocity.shape
    (array([0. , 0.1, 0.2]), (3, 3))
    """
    poses = simulation.poses
    times_s = np.arange(len(poses), dtype=np.float64) / positive(rate_hz, "rate_hz")
    positions, turning = splines(poses, times_s)
    in_sensor = np.einsum("fji,fj->fi", poses[:, :3, :3], positions(times_s, 1))
    doppler_mps = measured_doppler(simulation.points, in_sensor, interval_mps, seed)
    rng = generator(seed, _MOTION_STREAM, len(poses))
    noise = _GYROSCOPE_SIGMA_RAD_S * rng.standard_normal((len(poses), 3))
    return MeasuredMotion(times_s, doppler_mps, turning(times_s, 1) + gyroscope_bias_rad_s + noise)


def measured_doppler(
    points: Sequence[Floats32], velocities: Floats, interval_mps: float | None, seed: int
) -> list[Floats32]:
    """Measure the Doppler (N_i,), m/s, of F scans from the velocities (F, 3) of their sensors, m/s, sensor frame."""
    doppler_mps = []
    for i, scan in enumerate(points):
        rng = generator(seed, _MOTION_STREAM, i)
        directions = scan / np.linalg.norm(scan, axis=1, keepdims=True)
        speeds = -np.einsum("ni,i->n", directions, velocities[i])
        speeds += _DOPPLER_SIGMA_MPS * rng.standard_normal(len(speeds))
        is_moving = rng.random(len(speeds)) < _MOVING_SHARE
        speeds += is_moving * _MOVING_SIGMA_MPS * rng.standard_normal(len(speeds))
        if interval_mps is not None:
            half = positive(interval_mps, "interval_mps") / 2
            speeds = (speeds + half) % (2 * half) - half
        doppler_mps.append(speeds.astype(np.float32))
    return doppler_mps


def measured_imu(
    poses: ArrayLike,
    times_s: ArrayLike,
    *,
    rate_hz: float = 100.0,
    R_sensor_imu: ArrayLike | None = None,
    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gyroscope_bias_rad_s: tuple[float, float, float] = _GYROSCOPE_BIAS_RAD_S,
    seed: int = 0,
) -> Imu:
    """Measure a motion by an IMU along the smooth curve through poses.

    Each component has a standard deviation of 0.005 rad/s and 0.05 m/s². The accelerometer has a bias of 0.02 to 0.04 m/s².
    Raises a ValueError for fewer than two poses, and for times that differ in number or do not ascend.

    Parameters
    ----------
    poses : (F, 4, 4) array_like
        T_world_sensor, m, at least two, such as those of a simulation. z is up.
    times_s : (F,) array_like
        Times of the poses, s, ascending.
    rate_hz : float
        Measurement rate, Hz.
    R_sensor_imu : (3, 3) array_like, optional
        Rotation from the axes of the IMU to those of the sensor. Default: the identity.
    lever_m : three floats
        Position of the sensor in the axes of the IMU, m.
    gyroscope_bias_rad_s, seed
        As for :func:`measured_motion`.

    Returns
    -------
    Imu
        Its `R_sensor_imu` is None. The same arguments give the same result, bit by bit.

    Examples
    --------
    >>> from radarsdf.simulate import measured_imu, wall
    >>> imu = measured_imu(wall(frames=3).poses, [0.0, 10.0, 20.0])
    >>> len(imu), imu.angular_velocity.shape, imu.R_sensor_imu is None
    (2001, (2001, 3), True)
    """
    at_s: Floats = real_array(times_s, "times_s")
    positions, turning = splines(check_poses(poses), at_s)
    R_imu = np.eye(3) if R_sensor_imu is None else checked_rotation(R_sensor_imu)
    count = int(np.floor((at_s[-1] - at_s[0]) * positive(rate_hz, "rate_hz") + 1e-6)) + 1
    times = at_s[0] + np.arange(count) / rate_hz
    # SciPy's rates are in the frame of the rotating body, here rotated to that of the IMU.
    rates, changes = (np.einsum("ji,gj->gi", R_imu, turning(times, order)) for order in (1, 2))
    R_world_imu = np.einsum("gij,jk->gik", turning(times).as_matrix(), R_imu)
    lever = np.asarray(lever_m, np.float64)
    of_lever = np.cross(changes, lever) + np.cross(rates, np.cross(rates, lever))
    accelerations = positions(times, 2) - _GRAVITY_MPS2
    forces = np.einsum("gji,gj->gi", R_world_imu, accelerations) - of_lever
    rng = generator(seed, _IMU_STREAM, 0)
    rates = rates + gyroscope_bias_rad_s + _GYROSCOPE_SIGMA_RAD_S * rng.standard_normal((count, 3))
    noise = _ACCELEROMETER_SIGMA_MPS2 * rng.standard_normal((count, 3))
    return Imu(times, rates, forces + _ACCELEROMETER_BIAS_MPS2 + noise)


def splines(poses: Floats, times_s: Floats) -> tuple[CubicSpline, RotationSpline]:
    """Splines of positions and rotations by time. Both raise a ValueError unless there are two poses, and ascending times."""
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    return CubicSpline(times_s, poses[:, :3, 3]), RotationSpline(times_s, rotations)


def drifted(poses: Floats, sigma_m: float, sigma_rad: float, seed: int = 0, yaw_rad: float = 0.0) -> Floats:
    """Add errors to the steps between scans, which accumulate along the trajectory.

    Parameters
    ----------
    poses : (F, 4, 4) ndarray
        T_world_sensor, m. The first one is kept.
    sigma_m, sigma_rad : float
        Standard deviations of each component of a step's translation, m, and rotation, rad.
    seed : int
        Seed of the errors.
    yaw_rad : float
        Yaw error of every step about the z axis of the sensor, rad.

    Returns
    -------
    (F, 4, 4) ndarray
        T_world_sensor, m.
    """
    rng = np.random.default_rng(seed)
    errors = rng.normal(0, 1, (len(poses) - 1, 6)) * np.repeat([sigma_m, sigma_rad], 3)
    errors[:, 5] += yaw_rad
    pairs = zip(steps(poses), transform(errors[:, 3:], errors[:, :3]), strict=True)
    return np.stack([*accumulate(pairs, lambda T, pair: T @ pair[0] @ pair[1], initial=poses[0])])


@dataclass(frozen=True, eq=False)
class MountedRadar:
    """A radar of a rig."""

    sensor: RadarSensor
    """The radar."""
    T_body_sensor: ArrayLike
    """(4, 4) its mounting, m."""
    rate_hz: float = 10.0
    """Scan rate, Hz."""
    first_s: float = 0.0
    """Delay of its first scan after the start of the drive, s."""
    time_offset_s: float = 0.0
    """How late the times of its scans are, s."""
    interval_mps: float | None = None
    """Width of its ambiguity interval of Doppler, as for :func:`measured_motion`."""


@dataclass(frozen=True, eq=False)
class SimulatedRig:
    """Simulated scans of several radars."""

    scans: Scans
    """Scans of all radars in order of their times, with true poses of the body, Doppler velocities and ground truth."""
    radars: dict[Label, Simulation]
    """Scans of each radar by its label; their poses are T_world_sensor."""


def simulate_rig(
    scene: Scene, radars: Mapping[Any, MountedRadar], poses: ArrayLike, times_s: ArrayLike, *, seed: int = 0
) -> SimulatedRig:
    """Scan a scene by several radars along the smooth curve through poses of the body that carries them.

    Parameters
    ----------
    scene : Scene
        The world.
    radars : mapping of MountedRadar
        The radars by label.
    poses : (G, 4, 4) array_like
        T_world_body, m, at least two.
    times_s : (G,) array_like
        Times of the poses, s, ascending. Each radar scans from the first to the last at its own rate.
    seed : int
        Seed of all random numbers. The same arguments give the same result, bit by bit.

    Returns
    -------
    SimulatedRig
        Its `scans` are inputs of :func:`radarsdf.fit` and the like. :func:`measured_imu` of `poses` adds an IMU.

    Raises
    ------
    ValueError
        If there is no radar, fewer than two poses, or a pose or mounting is not a rigid transform.

    Examples
    --------
    >>> import numpy as np
    >>> from radarsdf import simulate
    >>> drive, rear = simulate.hugin(frames=3), np.diag([-1.0, -1.0, 1.0, 1.0])
    >>> mounted = {"front": np.eye(4), "rear": rear}
    >>> radars = {label: simulate.MountedRadar(drive.sensor, T) for label, T in mounted.items()}
    >>> scans = simulate.simulate_rig(drive.scene, radars, drive.poses, [0.0, 0.05, 0.1]).scans
    >>> scans.sensors
    ['front', 'rear', 'front', 'rear']
    """
    check(radars, "radars must have at least one radar")
    at_s: Floats = real_array(times_s, "times_s")
    positions, turning = splines(check_poses(poses), at_s)
    times = [_scan_times(radar, at_s) for radar in radars.values()]
    labels = [label for label, own in zip(radars, times, strict=True) for _ in own]
    mounted = {label: radar.T_body_sensor for label, radar in radars.items()}
    rig = Rig.of(labels, mounted)
    assert rig is not None
    true_s = np.concatenate(times)
    body = assembled(turning(true_s).as_matrix(), positions(true_s))
    # SciPy's rates are in the frame of the rotating body.
    velocities = np.einsum("fji,fj->fi", body[:, :3, :3], positions(true_s, 1))
    velocities += np.cross(turning(true_s, 1), rig.mountings[:, :3, 3])
    velocities = np.einsum("fji,fj->fi", rig.mountings[:, :3, :3], velocities)
    T_world_sensor = rig.sensor_poses(body)
    simulations, doppler_mps = dict[Label, Simulation](), list[Floats32]()
    for i, (label, radar) in enumerate(radars.items()):
        rows, own = rig.of_scan == i, int(generator(seed, _RIG_STREAM, i).integers(2**31))
        simulations[label] = simulate(scene, radar.sensor, T_world_sensor[rows], name=str(label), seed=own)
        doppler_mps += measured_doppler(simulations[label].points, velocities[rows], radar.interval_mps, own)
    stamps_s = true_s + np.array([radar.time_offset_s for radar in radars.values()])[rig.of_scan]
    each = [*simulations.values()]
    points = [scan for own in each for scan in own.points]
    values = [scan for own in each for scan in own.intensities]
    of_radars: dict[str, Any] = {"sensors": labels, "T_body_sensor": mounted}
    scans = Scans(points, body, values, doppler_mps=doppler_mps, times_s=stamps_s, **of_radars)
    scans = scans.select(np.argsort(stamps_s, kind="stable"))
    truth = scans.with_ground_truth(lambda: np.concatenate([own.ground_truth for own in each]))
    return SimulatedRig(truth, simulations)


def _scan_times(radar: MountedRadar, at_s: Floats) -> Floats:
    first_s = float(at_s[0]) + radar.first_s
    count = np.floor((at_s[-1] - first_s) * positive(radar.rate_hz, "rate_hz") + 1e-6) + 1
    check(radar.first_s >= 0 and count > 0, f"first_s must be within the drive, not {radar.first_s}")
    return first_s + np.arange(count) / radar.rate_hz
