"""Simulated rigs: several radars on one body, each with its own rate, noise, gain and mounting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.arrays import Floats, Floats32
from radarsdf.checks import check, check_poses, positive, real_array
from radarsdf.rig import Label, Rig
from radarsdf.scans import Scans

from .motion import measured_doppler, splines
from .radar import RadarSensor, generator
from .simulation import Simulation, simulate
from .world import Scene

_RIG_STREAM = 2**31 + 4  # no scan has this index


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
    body = np.tile(np.eye(4), (len(true_s), 1, 1))
    body[:, :3, :3], body[:, :3, 3] = turning(true_s).as_matrix(), positions(true_s)
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
    lidars = [simulation.lidar for simulation in simulations.values()]

    def truth() -> Floats:
        return np.concatenate([lidar.points for lidar in lidars])

    return SimulatedRig(scans.with_ground_truth(truth), simulations)


def _scan_times(radar: MountedRadar, at_s: Floats) -> Floats:
    first_s = float(at_s[0]) + radar.first_s
    count = np.floor((at_s[-1] - first_s) * positive(radar.rate_hz, "rate_hz") + 1e-6) + 1
    check(radar.first_s >= 0 and count > 0, f"first_s must be within the drive, not {radar.first_s}")
    return first_s + np.arange(count) / radar.rate_hz
