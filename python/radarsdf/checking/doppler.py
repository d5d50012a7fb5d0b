# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What Doppler says of poses, clocks, axes, intensities and moving things."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checking.finding import Finding
from radarsdf.checking.recording import FloatArray, Recording
from radarsdf.returns.moving import MIN_DOPPLER_RETURNS, sensor_velocities

_STILL_MPS = 0.3  # slower, the direction of a velocity tells nothing
_MIN_SCANS = 4
_MIN_SIGNIFICANCE = 4.0
_MIN_YAW_RAD = np.radians(3)
_MIN_GAIN = 0.7  # the rest of the squared differences must be less than this share
_MANY_MOVE = 0.4


@dataclass(frozen=True)
class VelocitiesFound:
    """Velocities of K scans by their Doppler."""

    scans: NDArray[np.int64]
    """(K,) numbers of the scans."""
    of_doppler_mps: FloatArray
    """(K, 3) sensor frame, m/s."""
    static_share: float
    """Share of the returns that agree."""
    tried: int
    """Number of scans that were tried."""


def velocities_of(recording: Recording, values: list[NDArray[Any]], count: int = 40) -> VelocitiesFound:
    """Velocities of about `count` scans from `values`, which may be Doppler."""
    scans = recording.some_scans(count)
    scans = np.array([i for i in scans.tolist() if len(recording.points[i]) >= MIN_DOPPLER_RETURNS], np.int64)
    found = sensor_velocities([recording.points[i] for i in scans], [values[i] for i in scans])
    good = np.array([velocity.found for velocity in found], bool)
    total = sum(len(velocity.static) for velocity in found if velocity.found)
    return VelocitiesFound(
        scans[good] if len(scans) else scans,
        np.array([velocity.velocity_mps for velocity in found if velocity.found]).reshape(-1, 3),
        sum(int(velocity.static.sum()) for velocity in found) / total if total else 0.0,
        len(scans),
    )


def check_doppler(recording: Recording) -> list[Finding]:
    """Tells whether Doppler, intensities, poses, axes and times agree. The poses must be rigid transforms."""
    found: list[Finding] = []
    if recording.intensities is not None and _are_speeds(recording, recording.intensities):
        found.append(
            Finding(
                "intensity_is_doppler",
                "error",
                "In most scans the intensities agree with one velocity of the sensor, as Doppler does.",
                "Pass the field of the power or of the radar cross section as intensity.",
            )
        )
    if recording.doppler_mps is None:
        return found
    velocities = velocities_of(recording, recording.doppler_mps)
    if velocities.tried and len(velocities.scans) < max(_MIN_SCANS, velocities.tried // 2):
        if velocities.tried >= _MIN_SCANS:
            found.append(
                Finding(
                    "doppler_without_velocity",
                    "warning",
                    f"In {velocities.tried - len(velocities.scans)} of {velocities.tried} scans no velocity of the "
                    "sensor agrees with 40 % of the Doppler.",
                    "Pass the measured speed along the ray in m/s, not one with the sensor's motion taken out.",
                )
            )
        return found
    moving = 1 - velocities.static_share
    found.append(
        Finding(
            "moving_share",
            "warning" if moving > _MANY_MOVE else "note",
            f"By their Doppler, {moving:.1%} of the returns move.",
            "A fit leaves them out, unless returns.drop_movers is false.",
        )
    )
    return found + _beside_poses(recording, velocities)


def _are_speeds(recording: Recording, values: list[NDArray[Any]]) -> bool:
    """Whether values (N_i,) of the scans are Doppler: most scans agree on a velocity, which is not zero in all."""
    if min(float(np.min(value, initial=0)) for value in values) >= 0:
        return False  # Doppler has both signs, or a minus where the sensor comes nearer
    found = velocities_of(recording, values, count=10)
    if found.tried < _MIN_SCANS or len(found.scans) < 0.7 * found.tried:
        return False
    return bool(np.median(np.linalg.norm(found.of_doppler_mps, axis=1)) > _STILL_MPS)


def _beside_poses(recording: Recording, velocities: VelocitiesFound) -> list[Finding]:
    """Compares velocities by Doppler with those by poses: sign, yaw, and with times the clock."""
    times = recording.ascending_times_s
    knots = np.arange(len(recording), dtype=np.float64) if times is None else times
    inner = (velocities.scans > 0) & (velocities.scans < len(recording) - 1)
    found: list[Finding] = []
    if inner.sum() < _MIN_SCANS:
        return found
    scans, by_doppler = velocities.scans[inner], velocities.of_doppler_mps[inner]
    by_poses = velocity_of_poses(recording.poses, knots)[scans]
    moving = (np.linalg.norm(by_poses, axis=1) > 0) & (np.linalg.norm(by_doppler, axis=1) > _STILL_MPS)
    if moving.sum() < _MIN_SCANS:
        return found
    a, b = by_doppler[moving], by_poses[moving]
    units = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b)]
    cosines = np.einsum("na,na->n", *units)
    if np.median(cosines) < -0.8:
        # Sensors differ in it, and what moves is found all the same: so this is no fault of the data.
        found.append(
            Finding(
                "doppler_sign",
                "note",
                f"By its Doppler the sensor moves backwards where its poses move forwards (median cosine {np.median(cosines):.2f}).",
                "Change the sign of the Doppler, so that it is negative where the sensor comes nearer.",
            )
        )
        by_doppler, units[0] = -by_doppler, -units[0]
    # Yaw that turns one onto the other, in each scan.
    cross = units[0][:, 0] * units[1][:, 1] - units[0][:, 1] * units[1][:, 0]
    yaws = np.arctan2(cross, np.einsum("na,na->n", units[0][:, :2], units[1][:, :2]))
    yaw = float(np.median(yaws))
    spread = 1.4826 * float(np.median(np.abs(yaws - yaw))) * np.sqrt(np.pi / 2 / len(yaws))
    if abs(yaw) > max(_MIN_YAW_RAD, _MIN_SIGNIFICANCE * spread):
        return [
            *found,
            Finding(
                "sensor_turned",
                "warning",
                f"The poses move {np.degrees(yaw):+.1f} degrees to the left of the velocity by Doppler, in the median of "
                f"{len(yaws)} scans.",
                "Multiply the poses by the calibration of the sensor, or turn the points by this yaw.",
            ),
        ]
    return found + ([] if times is None else _clock(recording.poses, times, scans, by_doppler))


def _clock(
    T_world_sensor: FloatArray, times_s: FloatArray, scans: NDArray[np.int64], by_doppler: FloatArray
) -> list[Finding]:
    """Tells whether the velocities by Doppler fit those by poses of another time clearly better."""
    step = float(np.median(np.diff(times_s)))
    most = float(np.clip(np.floor((times_s[-1] - times_s[0]) / step / 5), 1, 8))
    shifts = step * np.linspace(-most, most, 8 * int(most) + 1)
    knots = (times_s[1:] + times_s[:-1]) / 2
    by_poses = _between(T_world_sensor, times_s)
    at = times_s[scans]
    inside = (at - most * step > knots[0]) & (at + most * step < knots[-1])
    if inside.sum() < 2 * _MIN_SCANS:
        return []
    errors = []
    for shift in shifts:
        moved = np.stack([np.interp(at[inside] + shift, knots, by_poses[:, k]) for k in range(3)], 1)
        errors.append(np.sum((moved - by_doppler[inside]) ** 2, axis=1))
    means = np.median(np.array(errors), axis=1)
    best, given = int(np.argmin(means)), len(shifts) // 2
    better = errors[given] - errors[best]
    error = float(better.std(ddof=1)) / np.sqrt(len(better))
    if means[best] > _MIN_GAIN * means[given] or abs(shifts[best]) < step:
        return []
    if better.mean() < _MIN_SIGNIFICANCE * error:
        return []
    return [
        Finding(
            "clock_offset",
            "error",
            f"The velocity by Doppler fits the poses of a time {abs(shifts[best]):.2f} s "
            f"{'later' if shifts[best] > 0 else 'earlier'}: then they differ by {np.sqrt(means[best]):.2f} m/s, not by "
            f"{np.sqrt(means[given]):.2f} m/s, in the median of {len(better)} scans.",
            "Use one clock for scans and poses, and the time of measurement, not that of arrival.",
        )
    ]


def velocity_of_poses(T_world_sensor: FloatArray, times_s: FloatArray) -> FloatArray:
    """(F, 3) velocities of the sensor in its own frame at the poses (F, 4, 4), m/s, from the steps before and after."""
    between = _between(T_world_sensor, times_s)
    found = np.concatenate([between[:1], (between[1:] + between[:-1]) / 2, between[-1:]])
    return np.asarray(found, np.float64)


def _between(T_world_sensor: FloatArray, times_s: FloatArray) -> FloatArray:
    """(F - 1, 3) velocities between the poses, each in the frame halfway, m/s."""
    rotations = Rotation.from_matrix(T_world_sensor[:, :3, :3])
    half = rotations[:-1] * Rotation.from_rotvec((rotations[:-1].inv() * rotations[1:]).as_rotvec() / 2)
    steps = np.diff(T_world_sensor[:, :3, 3], axis=0) / np.diff(times_s)[:, None]
    found: FloatArray = half.inv().apply(steps)
    return found
