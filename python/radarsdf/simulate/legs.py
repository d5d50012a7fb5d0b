# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Drives in legs through a simulated scene: loops, stops, turns on the spot, and gaps between scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf.checks import instance, positive

from .simulation import Simulation, simulate

__all__ = ["Leg", "LegDrive", "drive_legs"]

FloatArray = NDArray[np.float64]

_WAY_HZ = 50.0  # poses of the whole way, between which a spline is exact enough for an IMU
_PEAK = 1.875  # largest over mean speed of a leg that begins and ends at rest
_CLOSED_STEPS = 2.5  # mean steps between the last and the first pose of a path that is closed


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
    found = simulate(
        simulation.scene, simulation.sensor, way[rows], name=f"{simulation.name}, in legs", seed=seed
    )
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
