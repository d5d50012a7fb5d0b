# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a gyroscope or an IMU adds to a drive: its rotations, and which way is up."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.io.imu import Imu
from radarsdf.poses.by_doppler import SensorVelocities
from radarsdf.poses.gyroscope import Gyroscope, UnalignedGyroscope
from radarsdf.poses.imu_alignment import ImuAlignment
from radarsdf.poses.rigid import Floats, covariance_in

# Half of the time, nothing that a radar is mounted on turns faster, or is accelerated more: a turn a second, three times gravity.
_MOST_RAD_S, _MOST_MPS2 = 6.0, 30.0


@dataclass(frozen=True)
class Inertial:
    """What is used of it."""

    gyroscope: Gyroscope | None
    """None: there is none, or it is not used."""
    alignment: ImuAlignment | None = None
    """How the IMU sits on the radar, by its accelerometer and Doppler. None: they do not tell."""
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, imu: Imu | None, velocities: SensorVelocities | None, times_s: Floats, begin_s: float
    ) -> Inertial:
        """Of scans at `times_s` (F,) after `begin_s`, in the clock of the IMU."""
        if imu is None:
            return cls(None)
        if (why := implausible_rates(imu.angular_velocity, velocities)) is not None:
            return cls(None).without(why)
        imu = dataclasses.replace(imu, times_s=imu.times_s - begin_s)
        if len(imu) < 2 or imu.times_s[0] > times_s[-1] or imu.times_s[-1] < 0:
            note = "The IMU is not used: it measured before or after all scans. Are both times of one clock?"
            return cls(None, notes=(note,))
        alignment = None if velocities is None else ImuAlignment.of(imu, velocities, times_s)
        if alignment is not None:
            measured = (alignment.angular_velocity, alignment.times_s)
            return cls(Gyroscope.of(*measured, times_s, alignment.bias_rad_s), alignment)
        R = imu.R_sensor_imu
        rates = imu.angular_velocity if R is None else np.einsum("ij,gj->gi", R, imu.angular_velocity)
        return cls((UnalignedGyroscope if R is None else Gyroscope).of(rates, imu.times_s, times_s))

    def without(self, why: object) -> Inertial:
        """Not used, and why."""
        note = f"The gyroscope is not used: {why}."
        return Inertial(None, notes=(*self.notes, note))

    @property
    def report(self) -> dict[str, Any] | None:
        """For the report of the poses. None: nothing was aligned."""
        if self.alignment is None:
            return None
        names = ("R_sensor_imu", "sigma_rad", "late_s", "lever_m")
        values = ((name, getattr(self.alignment, name)) for name in names)
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values}


def implausible_rates(angular_velocity: Floats, velocities: SensorVelocities | None) -> str | None:
    """Why rates (G, 3) cannot be in rad/s. None: they can."""
    rate = float(np.median(np.linalg.norm(angular_velocity, axis=1)))
    speed_mps = 0.0 if velocities is None else velocities.usual_mps
    if rate <= _MOST_RAD_S and rate * speed_mps <= _MOST_MPS2:
        return None
    across = f", {rate * speed_mps:.0f} m/s² across the trajectory at {speed_mps:.1f} m/s" * (speed_mps > 0)
    return f"the median of its rates is {rate:.3g} rad/s{across}. They may be in deg/s: give rad/s"


def levelled(poses: Floats, covariance: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Poses (F, 4, 4) and covariances (F, 6, 6) in a world whose z axis points up, by `up` (F, 3) in the frame of the radar.

    The first position stays at the origin; the world is turned no further than it takes.
    """
    now = np.einsum("fij,fj->i", poses[:, :3, :3], up)
    turn, _ = Rotation.align_vectors([[0, 0, 1.0]], [now])
    if now[2] < 0 and np.hypot(now[0], now[1]) < 1e-9 * -now[2]:
        turn = Rotation.from_rotvec([np.pi, 0, 0])  # upside down: any axis would do
    R, found = turn.as_matrix(), poses.copy()
    found[:, :3] = np.einsum("ij,fjk->fik", R, poses[:, :3])
    return found, covariance_in(covariance, R)
