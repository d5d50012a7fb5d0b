"""Trajectories, and errors that accumulate with steps."""

import dataclasses

import numpy as np
import pytest
from radarsdf.io import Scans
from radarsdf.poses.doppler import SensorVelocities
from radarsdf.simulate import RadarSensor, SimulatedScan, measured_motion
from scipy.spatial.transform import Rotation


def trajectory(count):
    """A winding drive of steps of half a metre."""
    k = np.arange(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler(
        "zyx", np.stack([0.05 * k, 0.02 * np.sin(k), 0.01 * k], 1)
    ).as_matrix()
    poses[:, :3, 3] = np.stack([0.5 * k, 2 * np.sin(0.1 * k), 0.1 * np.cos(k)], 1)
    return poses


def velocities_of(mean_mps, covariance):
    """Velocities (F, 3) of all scans, with the same covariance (3, 3)."""
    count = len(mean_mps)
    every = np.tile(covariance, (count, 1, 1))
    return SensorVelocities(mean_mps, every, np.ones(3), np.ones(count, bool))


def normalised_errors(found, true):
    """Squared errors (F - 1,) of positions relative to the middle scan, per axis, with the covariance as the unit."""
    middle = len(true) // 2
    T = true[middle] @ np.linalg.inv(found.poses[middle])
    errors_m = (T @ found.poses - true)[:, :3, 3]
    covariance = T[:3, :3] @ found.covariance[:, :3, :3] @ T[:3, :3].T
    others = np.arange(len(true)) != middle
    solved = np.linalg.solve(covariance[others], errors_m[others, :, None])[:, :, 0]
    return (errors_m[others] * solved).sum(axis=1) / 3


def position_error_m(poses, true):
    """Root mean square, m."""
    return float(np.sqrt(((poses - true)[:, :3, 3] ** 2).sum(axis=1).mean()))


def first(drive, count, *given, **named):
    """Simulate only the first scans of a `drive` of `radarsdf.simulate`: a shorter one would have longer steps on the same path."""
    scan = RadarSensor.scan
    nothing = SimulatedScan(np.zeros((0, 3), np.float32), *np.zeros((3, 0), np.float32))

    def begun(sensor, scene, T_world_sensor, seed=0, frame=0):
        return scan(sensor, scene, T_world_sensor, seed, frame) if frame < count else nothing

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RadarSensor, "scan", begun)
        simulation = drive(*given, **named)
    of_scans = {
        name: getattr(simulation, name)[:count]
        for name in ("points", "poses", "intensities", "noiseless_intensities", "origin_kind")
    }
    return dataclasses.replace(simulation, **of_scans)


def measured(drive, **options):
    """Scans of a simulation with the times and the Doppler of `measured_motion`."""
    motion = measured_motion(drive, **options)
    of_motion = {"doppler_mps": motion.doppler_mps, "times_s": motion.times_s}
    return Scans(drive.points, drive.poses, drive.intensities, **of_motion)


def thinned(simulation, every):
    """Every n-th return of a simulation, where a test needs fewer."""
    names = ("points", "intensities", "noiseless_intensities", "origin_kind")
    parts = {name: [values[::every] for values in getattr(simulation, name)] for name in names}
    return dataclasses.replace(simulation, **parts)
