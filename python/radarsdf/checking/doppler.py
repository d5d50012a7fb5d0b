# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Checks by Doppler: of its own consistency, of poses, axes, intensities and clocks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checking.recording import Finding, FloatArray, Recording
from radarsdf.returns.moving import MIN_DOPPLER_RETURNS, SensorVelocity, sensor_velocities

_STILL_MPS = 0.3  # slower, the direction of a velocity tells nothing
_MIN_SCANS = 4
_MIN_SIGNIFICANCE = 4.0
_MIN_YAW_RAD = np.radians(3)
_MIN_GAIN = 0.7  # the rest of the squared differences must be less than this share
_MANY_MOVE = 0.4


def velocities_of(
    recording: Recording, values: list[NDArray[Any]], count: int = 40
) -> tuple[NDArray[np.int64], list[SensorVelocity]]:
    """About `count` scans, and their velocities by `values`, which may be Doppler."""
    scans = recording.some_scans(count)
    scans = np.array([i for i in scans.tolist() if len(recording.points[i]) >= MIN_DOPPLER_RETURNS], np.int64)
    return scans, sensor_velocities([recording.points[i] for i in scans], [values[i] for i in scans])


def check_doppler(recording: Recording) -> Iterator[Finding]:
    """Whether Doppler, intensities, poses, axes and times agree. The poses must be rigid transforms."""
    if recording.intensities is not None and _are_speeds(recording, recording.intensities):
        yield Finding(
            "intensity_is_doppler",
            "error",
            "In most scans the intensities agree with one velocity of the sensor, as Doppler does.",
            "Pass the field of the power or of the radar cross section as intensity.",
        )
    if recording.doppler_mps is None:
        return
    scans, velocities = velocities_of(recording, recording.doppler_mps)
    good = np.array([velocity.found for velocity in velocities], bool)
    tried, without = len(scans), int((~good).sum())
    if tried and tried - without < max(_MIN_SCANS, tried // 2):
        if tried >= _MIN_SCANS:
            yield Finding(
                "doppler_without_velocity",
                "warning",
                f"In {without} of {tried} scans no velocity of the sensor agrees with 40 % of the Doppler.",
                "Pass the measured speed along the ray in m/s, not one with the sensor's motion taken out.",
            )
        return
    static = [velocity.static for velocity in velocities if velocity.found]
    total = sum(map(len, static))
    moving = 1 - (sum(int(mask.sum()) for mask in static) / total if total else 0.0)
    yield Finding(
        "moving_share",
        "warning" if moving > _MANY_MOVE else "note",
        f"By their Doppler, {moving:.1%} of the returns move.",
        "A fit leaves them out, unless returns.drop_movers is false.",
    )
    by_doppler = np.array([velocity.velocity_mps for velocity in velocities if velocity.found])
    yield from _compared_with_poses(recording, scans[good], by_doppler.reshape(-1, 3))


def _are_speeds(recording: Recording, values: list[NDArray[Any]]) -> bool:
    """Whether values (N_i,) of the scans are Doppler: most scans agree on a velocity, which is not zero in all."""
    if min(float(np.min(value, initial=0)) for value in values) >= 0:
        return False  # Doppler has both signs, or a minus where the sensor comes nearer
    scans, velocities = velocities_of(recording, values, count=10)
    found = [velocity.velocity_mps for velocity in velocities if velocity.found]
    if len(scans) < _MIN_SCANS or len(found) < 0.7 * len(scans):
        return False
    return bool(np.median(np.linalg.norm(found, axis=1)) > _STILL_MPS)


def _compared_with_poses(
    recording: Recording, scans: NDArray[np.int64], by_doppler: FloatArray
) -> Iterator[Finding]:
    """Compares velocities (K, 3) of scans (K,) by Doppler with those by poses: sign, yaw, and with times the clock."""
    times = recording.ascending_times_s
    inner = (scans > 0) & (scans < len(recording) - 1)
    if inner.sum() < _MIN_SCANS:
        return
    scans, by_doppler = scans[inner], by_doppler[inner]
    knots = np.arange(len(recording), dtype=np.float64) if times is None else times
    by_poses = velocity_of_poses(recording.poses, knots)[scans]
    moving = (np.linalg.norm(by_poses, axis=1) > 0) & (np.linalg.norm(by_doppler, axis=1) > _STILL_MPS)
    if moving.sum() < _MIN_SCANS:
        return
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (by_doppler[moving], by_poses[moving]))
    cosine = float(np.median(np.einsum("na,na->n", a, b)))
    if cosine < -0.8:
        # Sensors differ in it, and what moves is found all the same: so this is no fault of the data.
        yield Finding(
            "doppler_sign",
            "note",
            f"By its Doppler the sensor moves backwards where its poses move forwards (median cosine {cosine:.2f}).",
            "Change the sign of the Doppler, so that it is negative where the sensor comes nearer.",
        )
        by_doppler, a = -by_doppler, -a
    # Yaw that turns one onto the other, in each scan.
    yaws = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.einsum("na,na->n", a[:, :2], b[:, :2]))
    yaw = float(np.median(yaws))
    spread = 1.4826 * float(np.median(np.abs(yaws - yaw))) * np.sqrt(np.pi / 2 / len(yaws))
    if abs(yaw) > max(_MIN_YAW_RAD, _MIN_SIGNIFICANCE * spread):
        yield Finding(
            "sensor_turned",
            "warning",
            f"The poses move {np.degrees(yaw):+.1f} degrees to the left of the velocity by Doppler, in the median of "
            f"{len(yaws)} scans.",
            "Multiply the poses by the calibration of the sensor, or turn the points by this yaw.",
        )
    elif times is not None:
        yield from _clock(recording.poses, times, scans, by_doppler)


def _clock(
    T_world_sensor: FloatArray, times_s: FloatArray, scans: NDArray[np.int64], by_doppler: FloatArray
) -> Iterator[Finding]:
    """Whether the velocities by Doppler fit those by poses of another time clearly better."""
    step = float(np.median(np.diff(times_s)))
    most = float(np.clip(np.floor((times_s[-1] - times_s[0]) / step / 5), 1, 8))
    shifts = step * np.linspace(-most, most, 8 * int(most) + 1)
    knots = (times_s[1:] + times_s[:-1]) / 2
    by_poses = _between(T_world_sensor, times_s)
    at = times_s[scans]
    inside = (at - most * step > knots[0]) & (at + most * step < knots[-1])
    if inside.sum() < 2 * _MIN_SCANS:
        return
    errors = []
    for shift in shifts:
        moved = np.stack([np.interp(at[inside] + shift, knots, by_poses[:, k]) for k in range(3)], 1)
        errors.append(np.sum((moved - by_doppler[inside]) ** 2, axis=1))
    means = np.median(np.array(errors), axis=1)
    best, given = int(np.argmin(means)), len(shifts) // 2
    better = errors[given] - errors[best]
    error = float(better.std(ddof=1)) / np.sqrt(len(better))
    if means[best] > _MIN_GAIN * means[given] or abs(shifts[best]) < step:
        return
    if better.mean() < _MIN_SIGNIFICANCE * error:
        return
    yield Finding(
        "clock_offset",
        "error",
        f"The velocity by Doppler fits the poses of a time {abs(shifts[best]):.2f} s "
        f"{'later' if shifts[best] > 0 else 'earlier'}: then they differ by {np.sqrt(means[best]):.2f} m/s, not by "
        f"{np.sqrt(means[given]):.2f} m/s, in the median of {len(better)} scans.",
        "Use one clock for scans and poses, and the time of measurement, not that of arrival.",
    )


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
