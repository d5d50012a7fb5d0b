# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""An IMU and Doppler velocities measure the same motion: axes of the IMU, up, and time between their clocks.

The velocity by Doppler changes as the accelerometer says, once both are turned into one frame by the gyroscope. With R the
rotation from the IMU's axes to the radar's, Q(t) that of the IMU since the beginning, and v the velocity of the radar in its
own frame:

    Q (Rᵀ v - ω x lever) = V + ∫ Q (f - bias) dt + g t

within each window of some seconds, whose V is free. It is linear in the entries of Rᵀ, g and V, which begins the search over
the time between the clocks. Gauss and Newton's method ends it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.io.imu import Imu
from radarsdf.poses.doppler import SensorVelocities
from radarsdf.poses.gyroscope import FIRST_BIAS_RAD_S, Gyroscope, UnalignedGyroscope
from radarsdf.poses.rigid import Floats, covariance_in, nearest_rotation, rotation, skew

# Of a window, at least: longer ones gave the real walk the same rotation, to 0.5 degrees.
_WINDOW_S, _WINDOW_SCANS = 4.0, 10
_LATEST_S, _LATE_STEP_S = 0.5, 0.02  # times between the clocks that are tried
_UNRELATED_S = 2.0  # from here on, the motions that are compared have nothing to do with each other
_UNRELATED = 60  # such times that are tried: none must fit as well
_LEFT = 4.0  # times their variance, that velocities may differ from what the IMU says: 0.1 to 0.5 where it is right
_KNOWN_RAD = 0.1  # standard deviation of a rotation that is of use
# Parts of a drive with biases of their own: at most so many, at least so long.
_SEGMENTS, _SEGMENT_S = 64, 10.0
_BIAS_CHANGE_RAD_S = 1e-3  # from one of them to the next: of cheap gyroscopes, over minutes
_FORCE_BIAS, _LEVER_M = 0.2, 0.3  # deviations of the accelerometer's bias, m/s², and of the lever
_ITERATIONS, _SETTLED = 20, 1e-4
_MOST_SCANS = 20_000  # that tell it: of longer drives, every second, third … window
_MEDIAN = 2.366  # of a chi-squared variable of three
_ROBUST = 3.0  # deviations from which on a velocity counts less

# Half of the time, nothing that a radar is mounted on turns faster, or is accelerated more: a turn a second, three times gravity.
_MOST_RAD_S, _MOST_MPS2 = 6.0, 30.0


@dataclass(frozen=True)
class ImuMotion:
    """The motion of an IMU, integrated."""

    times_s: Floats
    rates: Floats
    """(G, 3) rad/s without bias."""
    forces: Floats
    """(G, 3) m/s² without bias, in its axes."""
    turns: Floats
    """(G, 3, 3) to the frame of the first time."""

    @classmethod
    def of(cls, imu: Imu, rate_bias: Floats, force_bias: Floats) -> ImuMotion:
        assert imu.specific_force is not None
        parts = len(rate_bias)
        elapsed = imu.times_s - imu.times_s[0]
        part = np.minimum((elapsed / max(elapsed[-1], 1e-9) * parts).astype(np.int64), parts - 1)
        rates = imu.angular_velocity - rate_bias[part]
        durations = np.diff(imu.times_s)[:, None]
        turns = cumulated(0.5 * (rates[1:] + rates[:-1]) * durations)
        return cls(imu.times_s, rates, imu.specific_force - force_bias, turns)

    def integral(self, values: Floats) -> Floats:
        """Of values (G, …) over time, by the trapezoidal rule."""
        found = np.zeros_like(values)
        durations = np.diff(self.times_s).reshape(-1, *[1] * (values.ndim - 1))
        np.cumsum(0.5 * (values[1:] + values[:-1]) * durations, axis=0, out=found[1:])
        return found

    def at(self, values: Floats, times_s: Floats) -> Floats:
        """Values (G, …) at times between."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        width = self.times_s[after] - self.times_s[after - 1]
        share = np.where(width > 0, (times_s - self.times_s[after - 1]) / np.maximum(width, 1e-12), 1.0)
        share = np.clip(share, 0, 1).reshape(-1, *[1] * (values.ndim - 1))
        found: Floats = values[after - 1] + share * (values[after] - values[after - 1])
        return found

    def turns_at(self, times_s: Floats) -> Floats:
        """(F, 3, 3) rotations at times between."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        left = (times_s - self.times_s[after - 1])[:, None]
        small = Rotation.from_rotvec(self.rates[after - 1] * left).as_matrix()
        found: Floats = np.einsum("fij,fjk->fik", self.turns[after - 1], small)
        return found


def cumulated(turns: Floats) -> Floats:
    """(N + 1, 3, 3) products of rotation vectors (N, 3), the identity first: where a body is that turns so, step after step."""
    count = len(turns) + 1
    width = int(np.ceil(np.sqrt(count)))
    padded = np.zeros((width * width, 3))
    padded[1:count] = turns
    found: Floats = Rotation.from_rotvec(padded).as_matrix().reshape(width, width, 3, 3)
    # Rows side by side, then one row after another: few steps of many products each.
    for k in range(1, width):
        found[:, k] = np.einsum("rij,rjk->rik", found[:, k - 1], found[:, k])
    for row in range(1, width):
        found[row] = np.einsum("ij,kjl->kil", found[row - 1, -1], found[row])
    return found.reshape(-1, 3, 3)[:count]


@dataclass(frozen=True)
class ImuAlignment:
    """How an IMU and a radar belong together."""

    R_sensor_imu: Floats
    """(3, 3) from the axes of the IMU to those of the radar."""
    sigma_rad: float
    """Its standard deviation, about the axis that is known least. 0: it was given."""
    late_s: float
    """By how much the times of scans are too late, in the clock of the IMU."""
    lever_m: Floats
    """(3,) position of the radar in the axes of the IMU, m."""
    angular_velocity: Floats
    """(G, 3) rad/s, in the axes of the radar, without bias."""
    bias_rad_s: float
    """Standard deviation of the bias that is left, about the axis that is known least."""
    times_s: Floats
    """(G,) in the clock of the scans."""
    up: Floats
    """(F, 3) unit vectors: which way is up, in the frame of the radar at each scan."""

    @property
    def words(self) -> str:
        """What was found, in one sentence."""
        how = f"found to {np.degrees(self.sigma_rad):.1f} degrees" if self.sigma_rad > 0 else "given"
        return f"The IMU's axes were {how}, scans are {self.late_s:.3f} s late in its clock, and its accelerometer says which way is up."

    @classmethod
    def of(cls, imu: Imu, velocities: SensorVelocities, times_s: Floats) -> ImuAlignment | None:
        """Of velocities at `times_s` (F,), ascending, by the clock of `imu`. None: they do not tell, or not for sure."""
        if imu.specific_force is None or len(times_s) < 2 * _WINDOW_SCANS or len(imu) < 2:
            return None
        state = _first_state(imu, velocities, times_s)
        return None if state is None else _fitted(imu, velocities, times_s, state)


@dataclass(frozen=True)
class _State:
    """What is sought."""

    R: Floats
    gravity: Floats
    """(3,) m/s², in the frame of the IMU at its first time."""
    late_s: float
    force_bias: Floats
    lever_m: Floats
    rate_bias: Floats
    """(K, 3) rad/s, of each part of the drive."""

    def moved(self, step: Floats, R_known: bool) -> _State:
        """With an increment (13 + 3 K,)."""
        return _State(
            self.R if R_known else np.einsum("ij,kj->ik", self.R, rotation(step[:3])),
            self.gravity + step[3:6],
            self.late_s + float(step[12]),
            self.force_bias + step[6:9],
            self.lever_m + step[9:12],
            self.rate_bias + step[13:].reshape(-1, 3),
        )


def _windows(times_s: Floats) -> list[slice]:
    """Parts of a drive of about `_WINDOW_S`, without gaps."""
    usual = float(np.median(np.diff(times_s)))
    length_s = max(_WINDOW_S, _WINDOW_SCANS * usual)
    found, begin = [], 0
    for i in range(1, len(times_s) + 1):
        ends = i == len(times_s) or times_s[i] - times_s[i - 1] > 5 * usual
        if ends or times_s[i] - times_s[begin] > length_s:
            found.append(slice(begin, i))
            begin = i
    return [rows for rows in found if rows.stop - rows.start > 2]


def _first_state(imu: Imu, velocities: SensorVelocities, times_s: Floats) -> _State | None:
    """By linear least squares at many times between the clocks; None if chance explains the motions as well."""
    motion = ImuMotion.of(imu, np.zeros((1, 3)), np.zeros(3))
    ways = motion.integral(np.einsum("gij,gj->gi", motion.turns, motion.forces))
    windows = _windows(times_s)
    if not windows:
        return None
    # A drive that stands still for the most part has the same rotations and velocities at many times.
    late = np.arange(-_LATEST_S, _LATEST_S + 1e-9, _LATE_STEP_S)
    fits = [_linear_fit(motion, ways, velocities, times_s - s, windows, imu.R_sensor_imu) for s in late]
    best = int(np.argmin([cost for cost, _ in fits]))
    span_s = times_s[-1] - times_s[0]
    if span_s < 4 * _UNRELATED_S:
        return None
    away = np.linspace(_UNRELATED_S, span_s - _UNRELATED_S, _UNRELATED)
    begin_s = times_s[0]
    others = (begin_s + (times_s - begin_s + s) % span_s for s in away)
    costs = [_linear_fit(motion, ways, velocities, at_s, windows, imu.R_sensor_imu)[0] for at_s in others]
    if fits[best][0] >= min(costs):
        return None
    matrix, gravity = fits[best][1]
    R = imu.R_sensor_imu
    if R is None:
        R = nearest_rotation(matrix)
    drive_s = imu.times_s[-1] - imu.times_s[0]
    parts = int(np.clip(drive_s // _SEGMENT_S, 1, _SEGMENTS))
    return _State(R, gravity, float(late[best]), np.zeros(3), np.zeros(3), np.zeros((parts, 3)))


def _linear_fit(
    motion: ImuMotion,
    ways: Floats,
    velocities: SensorVelocities,
    at_s: Floats,
    windows: list[slice],
    R_known: Floats | None,
) -> tuple[float, tuple[Floats, Floats]]:
    """Residual sum of squares, and R (3, 3), any matrix, and gravity (3,)."""
    turns, forced = motion.turns_at(at_s), motion.at(ways, at_s)
    # Unknowns: the entries of Rᵀ row by row, then gravity.
    rows = np.zeros((len(at_s), 3, 12))
    for axis in range(3):
        rows[:, :, 3 * axis : 3 * axis + 3] = turns[:, :, axis, None] * velocities.mean_mps[:, None, :]
    rows[:, :, 9:] = -(at_s - at_s.mean())[:, None, None] * np.eye(3)
    right = forced.copy()
    if R_known is not None:
        right = right - np.einsum("fij,kj,fk->fi", turns, R_known, velocities.mean_mps)
        rows = rows[:, :, 9:]
    matrix, vector, square = np.zeros((rows.shape[2],) * 2), np.zeros(rows.shape[2]), 0.0
    for part in windows:
        a, b = rows[part] - rows[part].mean(axis=0), right[part] - right[part].mean(axis=0)
        matrix += np.einsum("fik,fil->kl", a, a)
        vector += np.einsum("fik,fi->k", a, b)
        square += float((b**2).sum())
    solved = np.linalg.solve(matrix + 1e-6 * np.trace(matrix) * np.eye(len(matrix)), vector)
    cost = square - float((solved * vector).sum())
    back = np.eye(3) if R_known is not None else solved[:9].reshape(3, 3)
    return cost, (back.T, solved[-3:])


@dataclass(frozen=True)
class _Rows:
    """What the velocities of one window say of an increment of the state, but for what they have in common."""

    residual: Floats
    """(N, 3) m/s."""
    jacobian: Floats
    """(N, 3, 13 + 3 K)."""
    information: Floats
    """(N, 3, 3) s²/m²."""

    def squares(self) -> Floats:
        """(N,) of the residuals, in standard deviations, once the mean is taken off."""
        weighted = np.einsum("fij,fj->fi", self.information, self.residual)
        off = self.residual - np.linalg.solve(self.information.sum(axis=0), weighted.sum(axis=0))
        found: Floats = np.einsum("fi,fij,fj->f", off, self.information, off)
        return found

    def normal(self, weights: Floats) -> tuple[Floats, Floats]:
        """Matrix and gradient for the increment, the mean taken off."""
        information = self.information * weights[:, None, None]
        wj = np.einsum("fij,fjk->fik", information, self.jacobian)
        wr = np.einsum("fij,fj->fi", information, self.residual)
        common = np.linalg.solve(information.sum(axis=0), wj.sum(axis=0))
        matrix = np.einsum("fik,fil->kl", self.jacobian, wj) - np.einsum("ik,il->kl", common, wj.sum(axis=0))
        gradient = np.einsum("fik,fi->k", self.jacobian, wr) - np.einsum("ik,i->k", common, wr.sum(axis=0))
        return matrix, gradient


def _linearised(
    imu: Imu, velocities: SensorVelocities, times_s: Floats, state: _State, windows: list[slice]
) -> Iterator[_Rows]:
    motion = ImuMotion.of(imu, state.rate_bias, state.force_bias)
    forces = np.einsum("gij,gj->gi", motion.turns, motion.forces)
    ways, turns = motion.integral(forces), motion.integral(motion.turns)
    bent = motion.integral(np.einsum("gij,gjk->gik", skew(forces), turns))
    borders = np.linspace(imu.times_s[0], imu.times_s[-1], len(state.rate_bias) + 1)
    turns_b, ways_b, bent_b = (motion.at(values, borders[:-1]) for values in (turns, ways, bent))
    for window in windows:
        at_s = times_s[window] - state.late_s
        Q, forced = motion.turns_at(at_s), motion.at(ways, at_s)
        rates = motion.at(motion.rates, at_s)
        of_radar = np.einsum("ji,fj->fi", state.R, velocities.mean_mps[window])
        velocity = of_radar - np.cross(rates, state.lever_m)
        y = np.einsum("fij,fj->fi", Q, velocity)
        elapsed_s = at_s - imu.times_s[0]
        jacobian = np.zeros((len(at_s), 3, 13 + 3 * len(state.rate_bias)))
        jacobian[:, :, :3] = -np.einsum("fij,fjk->fik", Q, skew(of_radar))
        jacobian[:, :, 3:6] = -elapsed_s[:, None, None] * np.eye(3)
        jacobian[:, :, 6:9] = motion.at(turns, at_s)
        jacobian[:, :, 9:12] = -np.einsum("fij,fjk->fik", Q, skew(rates))
        turning = np.einsum("fij,fj->fi", Q, np.cross(rates, velocity))
        jacobian[:, :, 12] = -(turning - motion.at(forces, at_s) - state.gravity)
        for j in range(len(state.rate_bias)):
            inside = np.clip(at_s, borders[j], borders[j + 1])
            turned = motion.at(turns, inside) - turns_b[j]
            ways_in = motion.at(ways, inside)
            by_force = motion.at(bent, inside) - bent_b[j]
            by_force -= np.einsum("fij,jk->fik", skew(ways_in - ways_b[j]), turns_b[j])
            by_force += np.einsum("fij,fjk->fik", skew(forced - ways_in), turned)
            jacobian[:, :, 13 + 3 * j : 16 + 3 * j] = np.einsum("fij,fjk->fik", skew(y), turned) - by_force
        to_world = np.einsum("fij,kj->fik", Q, state.R)
        information = np.einsum(
            "fij,fjk,flk->fil", to_world, np.linalg.inv(velocities.covariance[window]), to_world
        )
        yield _Rows(y - forced - elapsed_s[:, None] * state.gravity, jacobian, information)


def _prior(state: _State) -> tuple[Floats, Floats]:
    """What is known of any IMU, as matrix and gradient for an increment."""
    biases = len(state.rate_bias)
    matrix, gradient = np.zeros((13 + 3 * biases,) * 2), np.zeros(13 + 3 * biases)
    for rows, value, sigma in (
        (slice(6, 9), state.force_bias, _FORCE_BIAS),
        (slice(9, 12), state.lever_m, _LEVER_M),
        (slice(13, 16), state.rate_bias[0], FIRST_BIAS_RAD_S),
    ):
        matrix[rows, rows] += np.eye(3) / sigma**2
        gradient[rows] += value / sigma**2
    for j in range(1, biases):
        before, now = slice(10 + 3 * j, 13 + 3 * j), slice(13 + 3 * j, 16 + 3 * j)
        change = (state.rate_bias[j] - state.rate_bias[j - 1]) / _BIAS_CHANGE_RAD_S**2
        for rows, sign in ((before, -1), (now, 1)):
            matrix[rows, rows] += np.eye(3) / _BIAS_CHANGE_RAD_S**2
            gradient[rows] += sign * change
        matrix[before, now] = matrix[now, before] = -np.eye(3) / _BIAS_CHANGE_RAD_S**2
    return matrix, gradient


def _fitted(imu: Imu, velocities: SensorVelocities, times_s: Floats, state: _State) -> ImuAlignment | None:
    """By Gauss and Newton's method, robust. None: it does not explain the velocities, or leaves the rotation open."""
    windows, R_known = _windows(times_s), imu.R_sensor_imu is not None
    windows = windows[:: 1 + len(times_s) // _MOST_SCANS]
    covariance: Floats = np.zeros((0, 0))
    scale = np.inf
    for _ in range(_ITERATIONS):
        normal, gradient = _prior(state)
        parts = list(_linearised(imu, velocities, times_s, state, windows))
        squares = [rows.squares() for rows in parts]
        scale = max(float(np.median(np.concatenate(squares))) / _MEDIAN, 1e-6)
        for rows, square in zip(parts, squares, strict=True):
            # A smaller scale is no better knowledge: errors that scans have in common do not show in it.
            weights = 1 / (1 + square / (3 * scale * _ROBUST**2)) ** 2 / max(scale, 1.0)
            matrix, vector = rows.normal(weights)
            normal, gradient = normal + matrix, gradient + vector
        if R_known:
            normal[:3], normal[:, :3], gradient[:3] = 0, 0, 0
            normal[:3, :3] = np.eye(3)
        covariance = np.linalg.inv(normal).astype(np.float64)
        step: Floats = -np.einsum("ij,j->i", covariance, gradient)
        state = state.moved(step, R_known)
        if np.abs(step[:3]).max() < _SETTLED and abs(step[12]) < _SETTLED:
            break
    sigma_rad = 0.0 if R_known else float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    if scale > _LEFT or sigma_rad > _KNOWN_RAD or abs(state.late_s) > 2 * _LATEST_S:
        return None
    motion = ImuMotion.of(imu, state.rate_bias, state.force_bias)
    turns = motion.turns_at(times_s - state.late_s)
    # Against gravity, Qᵀ g in the axes of the IMU.
    up = -np.einsum("ij,fkj,k->fi", state.R, turns, state.gravity)
    return ImuAlignment(
        state.R,
        sigma_rad,
        state.late_s,
        state.lever_m,
        np.einsum("ij,gj->gi", state.R, motion.rates),
        float(np.sqrt(covariance.diagonal()[13:].max())),
        imu.times_s + state.late_s,
        up / np.linalg.norm(up, axis=1, keepdims=True),
    )


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
