# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The velocity of the sensor from the Doppler of a scan, and what it says of poses, clocks, axes and moving things.

A return that stands still, in direction d of a sensor with velocity v, has the Doppler ``-d·v``: negative if the sensor
comes nearer. Three returns give v; the v on which most returns agree is refined by least squares. The method is that of
C. Doer and G. Trommer, "An EKF Based Approach to Radar Inertial Odometry", MFI 2020, written anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checking.finding import Finding
from radarsdf.checking.recording import FloatArray, Recording

_DRAWS = (
    64  # of three returns. With 40 % moving, one without them is among 38 draws with a probability of 0.9999
)
_SIGMA_MPS = 0.15  # a return is off if its Doppler differs by three times the noise, and by at least this
_ROUNDS = 4
_MIN_RETURNS = 10
_MIN_AGREEING = 0.4  # share of the returns that must agree on a velocity
_MAX_CONDITION = 1e3  # of the normal equations: returns in one direction tell no velocity
_FOLDS = (-1.0, 0.0, 1.0)  # intervals by which all three returns of a draw may be folded
_STILL_MPS = 0.3  # slower, the direction of a velocity tells nothing
_MIN_SCANS = 4
_MIN_SIGNIFICANCE = 4.0
_MIN_YAW_RAD = np.radians(3)
_MIN_GAIN = 0.7  # the rest of the squared differences must be less than this share
_MANY_MOVE = 0.4


@dataclass(frozen=True)
class SensorVelocity:
    """What the Doppler of one scan says."""

    velocity_mps: FloatArray
    """(3,) velocity of the sensor in its own frame, m/s. NaN if the returns do not agree on one."""
    covariance: FloatArray
    """(3, 3) its covariance, m²/s². NaN if there is no velocity."""
    static: NDArray[np.bool_]
    """(N,) whether each return agrees with it, so that it stands still. All False if there is no velocity."""

    @property
    def found(self) -> bool:
        """Whether the returns agree on a velocity."""
        return bool(np.isfinite(self.velocity_mps).all())


def sensor_velocity(
    points: NDArray[Any], doppler_mps: NDArray[Any], *, interval_mps: float | None = None
) -> SensorVelocity:
    """Finds the velocity of the sensor from one scan. The same scan gives the same bits.

    Parameters
    ----------
    points : ndarray
        (N, 3) returns, sensor frame; their unit does not matter.
    doppler_mps : ndarray
        (N,) speed along the ray, m/s, positive away from the sensor.
    interval_mps : float, optional
        Width of the interval into which the sensor folds speeds, m/s. None: it folds none.

    Returns
    -------
    SensorVelocity
        Without a velocity if there are fewer than 10 returns, if less than 40 % of them agree, or if they all lie in
        one direction.
    """
    x, speeds = np.asarray(points, np.float64), np.asarray(doppler_mps, np.float64)
    ranges = np.linalg.norm(x, axis=1)
    usable = (ranges > 0) & np.isfinite(speeds) & np.isfinite(ranges)
    unknown = SensorVelocity(np.full(3, np.nan), np.full((3, 3), np.nan), np.zeros(len(x), bool))
    rows = np.flatnonzero(usable)
    if len(rows) < _MIN_RETURNS:
        return unknown
    away = -x[rows] / ranges[rows, None]
    measured = speeds[rows]

    def residuals(velocities: FloatArray) -> FloatArray:
        """(K, M) differences of the measured speeds from those of velocities (K, 3)."""
        off: FloatArray = measured - velocities @ away.T
        return off if interval_mps is None else off - interval_mps * np.round(off / interval_mps)

    velocity = _most_agreed(away, measured, residuals, interval_mps)
    if velocity is None:
        return unknown
    sigma = _SIGMA_MPS / 3
    for _ in range(_ROUNDS):
        off = residuals(velocity[None])[0]
        agrees = np.abs(off) < max(_SIGMA_MPS, 3 * sigma)
        if agrees.sum() < max(_MIN_RETURNS / 2, _MIN_AGREEING * len(rows)):
            return unknown
        normal = away[agrees].T @ away[agrees]
        if np.linalg.cond(normal) > _MAX_CONDITION:
            return unknown
        velocity = velocity + np.linalg.solve(normal, away[agrees].T @ off[agrees])
        # The median is not drawn by what moves.
        sigma = min(1.4826 * float(np.median(np.abs(residuals(velocity[None])[0][agrees]))), _SIGMA_MPS)
    static = np.zeros(len(x), bool)
    off = residuals(velocity[None])[0]
    static[rows] = np.abs(off) < max(_SIGMA_MPS, 3 * sigma)
    spread = float(np.sum(off[agrees] ** 2)) / max(int(agrees.sum()) - 3, 1)
    return SensorVelocity(velocity, spread * np.linalg.inv(normal), static)


def _most_agreed(
    away: FloatArray,
    measured: FloatArray,
    residuals: Callable[[FloatArray], FloatArray],
    interval_mps: float | None,
) -> FloatArray | None:
    """The velocity (3,) of those of random draws of three returns with which most returns agree."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(measured), (_DRAWS, 3))
    speeds = measured[drawn]
    if interval_mps is not None:
        speeds = np.concatenate([speeds + fold * interval_mps for fold in _FOLDS])
        drawn = np.tile(drawn, (len(_FOLDS), 1))
    matrices = away[drawn]
    solvable = np.abs(np.linalg.det(matrices)) > 1e-4
    if not solvable.any():
        return None
    velocities = np.linalg.solve(matrices[solvable], speeds[solvable, :, None])[:, :, 0]
    counts = (np.abs(residuals(velocities)) < _SIGMA_MPS).sum(axis=1)
    best: FloatArray = velocities[int(np.argmax(counts))]
    return best


def folding_interval_mps(doppler_mps: list[NDArray[Any]]) -> float | None:
    """Width of the interval into which the sensor seems to fold speeds, m/s: None if the speeds do not fill one.

    Folded speeds reach both ends of the interval, which lie about as far from 0.
    """
    speeds = np.concatenate([np.asarray(values, np.float64) for values in doppler_mps])
    speeds = speeds[np.isfinite(speeds)]
    if len(speeds) < 100:
        return None
    low, high = float(speeds.min()), float(speeds.max())
    if not 0 < -low < 1.25 * high or not high < -1.25 * low:
        return None
    edge = 0.05 * (high - low)
    ends = ((speeds < low + edge).mean(), (speeds > high - edge).mean())
    if min(ends) < 0.002:
        return None
    values = np.unique(np.abs(np.diff(np.unique(speeds))))
    step = float(values[values > 1e-6].min(initial=np.inf))
    return high - low + (step if step < 0.05 * (high - low) else 0.0)


@dataclass(frozen=True)
class Velocities:
    """Velocities of K scans by their Doppler."""

    scans: NDArray[np.int64]
    """(K,) numbers of the scans."""
    of_doppler_mps: FloatArray
    """(K, 3) sensor frame, m/s."""
    static_share: float
    """Share of the returns that agree."""
    tried: int
    """Number of scans that were tried."""


def velocities_of(recording: Recording, values: list[NDArray[Any]], count: int = 40) -> Velocities:
    """Velocities of about `count` scans from `values`, which may be Doppler."""
    scans = recording.some_scans(count)
    scans = np.array([i for i in scans.tolist() if len(recording.points[i]) >= _MIN_RETURNS], np.int64)
    interval = folding_interval_mps([values[i] for i in scans]) if len(scans) else None
    choices = []
    for folded in (None, interval) if interval else (None,):
        found = [sensor_velocity(recording.points[i], values[i], interval_mps=folded) for i in scans]
        agreeing = sum(int(velocity.static.sum()) for velocity in found)
        choices.append((agreeing, found))
    # Folding lets more returns agree by chance, so that it must explain clearly more.
    best = choices[-1] if len(choices) > 1 and choices[-1][0] > 1.2 * choices[0][0] else choices[0]
    good = np.array([velocity.found for velocity in best[1]], bool)
    total = sum(len(recording.points[i]) for i, ok in zip(scans, good, strict=True) if ok)
    return Velocities(
        scans[good] if len(scans) else scans,
        np.array([velocity.velocity_mps for velocity in best[1] if velocity.found]).reshape(-1, 3),
        best[0] / total if total else 0.0,
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
            "Leave out what moves: it is no surface of the map.",
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


def _beside_poses(recording: Recording, velocities: Velocities) -> list[Finding]:
    """Compares velocities by Doppler with those by poses: sign, yaw, and with times the clock."""
    times = recording.times_s
    timed = times is not None and bool((np.diff(times) > 0).all())
    knots = times if timed and times is not None else np.arange(len(recording), dtype=np.float64)
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
    return found + (_clock(recording.poses, knots, scans, by_doppler) if timed else [])


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
