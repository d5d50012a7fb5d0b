"""Rotations from a gyroscope, and alignment of an IMU with a radar: axes, vertical, and time offset.

Changes of the Doppler velocity match the accelerometer once the gyroscope rotates both into one frame. With R the rotation
from the IMU's axes to the radar's, Q(t) that of the IMU since the beginning, and v the velocity of the radar in its own
frame:

    Q (Rᵀ v - ω x lever) = V + ∫ Q (f - bias) dt + g t

within windows of some seconds, each with a free V. The equation is linear in the entries of Rᵀ, g and V: a linear solution for
each time offset on a grid initialises robust nonlinear least squares (Gauss-Newton).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats, Ints, NDArray
from radarsdf.poses.doppler import SensorVelocities
from radarsdf.poses.motion import MotionRate, interpolate, usual_duration_s
from radarsdf.poses.rigid import covariance_in, nearest_rotation, rotation, rotation_vector
from radarsdf.rig import Imu

# Prior bias and noise, of cheap gyroscopes, until they are estimated from the drive.
FIRST_BIAS_RAD_S = 0.02
_FIRST_NOISE_RAD = 0.003
_LEAST_STEPS = 4  # minimum number of turns for a contradiction
_MOST_BIAS_RAD_S = 0.35  # zero-rate offset of the cheapest gyroscopes: 20 degrees a second
# Gate on the mean squared residual of turns from the rates, absolute and relative to that from a constant rate. Simulated
# drives of 9 kinds: 0.02 to 0.63 times; in wrong units, signs or axes 1.3 times and more.
_CONTRADICTED, _CONTRADICTED_SHARE = 12.0, 1.2


class UnusableGyroscopeError(ValueError):
    """The rates of a gyroscope contradict a drive."""


def cumulate_turns(turns: Floats) -> Floats:
    """Return the cumulative products (N + 1, 3, 3) of rotation vectors (N, 3), the identity first."""
    count = len(turns) + 1
    width = int(np.ceil(np.sqrt(count)))
    padded = np.zeros((width * width, 3))
    padded[1:count] = turns
    found = rotation(padded).reshape(width, width, 3, 3)
    # Scan within rows in parallel, then across rows: few steps of many products each.
    for k in range(1, width):
        found[:, k] = found[:, k - 1] @ found[:, k]
    for row in range(1, width):
        found[row] = found[row - 1, -1] @ found[row]
    return found.reshape(-1, 3, 3)[:count]


def integrate_rates(times_s: Floats, rates: Floats) -> Floats:
    """Return the rotations (G, 3, 3) to the first frame, from rates (G, 3), rad/s, by the trapezoidal rule."""
    return cumulate_turns(0.5 * (rates[1:] + rates[:-1]) * np.diff(times_s)[:, None])


@dataclass(frozen=True)
class Gyroscope:
    """Rotations between F scans, with their errors."""

    turns: Floats  # (F - 1, 3) rotation vectors in the frame of the first of two scans, rad
    durations_s: Floats  # (F - 1,)
    bias: MotionRate  # bias of the measured rate, rad/s
    noise_rad2: float = _FIRST_NOISE_RAD**2  # variance of a rotation over the median duration

    @classmethod
    def of(
        cls, angular_velocity: Floats, at_s: Floats, times_s: Floats, bias_rad_s: float = FIRST_BIAS_RAD_S
    ) -> "Gyroscope":
        """Integrate rates (G, 3), rad/s, at ascending times (G,) between scans at `times_s` (F,)."""
        edges = np.union1d(at_s[(at_s > times_s[0]) & (at_s < times_s[-1])], times_s)
        rates = interpolate(edges, at_s, angular_velocity)
        poses = integrate_rates(edges, rates)[np.searchsorted(edges, times_s)]
        turns = rotation_vector(np.einsum("fji,fjk->fik", poses[:-1], poses[1:]))
        return cls(turns, np.diff(times_s), MotionRate(np.zeros(3), bias_rad_s**2 * np.eye(3)))

    @property
    def _noise(self) -> Floats:
        """Variance (F - 1,) of each component of a rotation, rad²."""
        return self.noise_rad2 * self.durations_s / max(usual_duration_s(self.durations_s), 1e-9)

    def step(self, i: int) -> MotionRate:
        """Return the rotation vector from scan `i` to the next, rad."""
        duration_s = self.durations_s[i]
        covariance = self.bias.covariance * duration_s**2 + self._noise[i] * np.eye(3)
        return MotionRate(self.turns[i] - self.bias.mean * duration_s, covariance)

    def learnt(self, rates: Sequence[MotionRate | None]) -> "Gyroscope":
        """Estimate bias and noise from turn rates, rad/s. Raise an UnusableGyroscopeError if they contradict the gyroscope."""
        known = {i: rate for i, rate in enumerate(rates) if rate is not None and self.durations_s[i] > 0}
        if len(known) < 2:
            return self
        rows, motions = list(known), [rate.integrate(self.durations_s[i]) for i, rate in known.items()]
        durations_s, noise = self.durations_s[rows], self._noise[rows]
        turns = np.stack([motion.mean for motion in motions])
        covariance = np.stack([motion.covariance for motion in motions])
        off = self.turns[rows] - turns
        weights = np.linalg.inv(covariance + noise[:, None, None] * np.eye(3)).astype(np.float64)
        bias, _, square = _fit_bias(off, durations_s, weights)
        constant, rate = _fit_bias(-turns, durations_s, weights)[2], float(np.linalg.norm(bias))
        contradicted = len(off) > _LEAST_STEPS and square > max(_CONTRADICTED, _CONTRADICTED_SHARE * constant)
        # Turns that the returns hardly observe share the error of their prediction.
        unknown = float(np.sqrt(np.median(np.einsum("fii->f", covariance) / durations_s**2)))
        if contradicted or rate >= _MOST_BIAS_RAD_S + 3 * unknown:
            by = f"{np.sqrt(square / 3):.1f} standard deviations and a bias of {rate:.2f} rad/s"
            msg = f"its rates differ from the turns that the returns show by {by}: are they in rad/s, and in the axes of the radar?"
            raise UnusableGyroscopeError(msg)
        prior = np.linalg.inv(self.bias.covariance).astype(np.float64)
        bias, information, _ = _fit_bias(off, durations_s, weights, prior)
        squares = (off - bias * durations_s[:, None]) ** 2 - np.einsum("fii->fi", covariance)
        noise_rad2 = np.maximum(squares * (self.noise_rad2 / noise)[:, None], 0.0).mean()
        fitted = MotionRate(bias, np.linalg.inv(information).astype(np.float64))
        return replace(self, bias=fitted, noise_rad2=float(max(noise_rad2, 1e-10)))


def _fit_bias(
    off: Floats, durations_s: Floats, weights: Floats, before: Floats | float = 0.0
) -> tuple[Floats, Floats, float]:
    """Fit a constant rate to rotations `off` (K, 3), with prior information `before` at 0: rate, information, mean square."""
    information = before + np.einsum("fij,f->ij", weights, durations_s**2)
    bias: Floats = np.linalg.solve(information, np.einsum("fij,fj,f->i", weights, off, durations_s))
    left = off - bias * durations_s[:, None]
    return bias, information, float(np.einsum("fi,fij,fj->f", left, weights, left).mean())


# Minimum length of a window: longer ones gave the same rotation for the real walk, to 0.5 degrees.
_WINDOW_S, _WINDOW_SCANS = 4.0, 10
_MAX_TIME_OFFSET_S, _LATE_STEP_S = 0.5, 0.02  # grid of time offsets
_UNRELATED_S = 2.0  # time shift from which on motions are uncorrelated
_UNRELATED = 60  # number of such shifts as null hypotheses: none must fit as well
_LEFT = 4.0  # maximum normalised variance of residual velocities: 0.1 to 0.5 for a correct alignment
_KNOWN_RAD = 0.1  # maximum standard deviation of a useful rotation
# Maximum number of knots of the gyroscope's piecewise linear bias, and their minimum distance.
_KNOTS, _KNOT_S = 12, 10.0
_BIAS_CHANGE_RAD_S = 1e-3  # deviation of its change between knots: cheap gyroscopes, over minutes
_FORCE_BIAS, _LEVER_M = 0.2, 0.3  # prior deviations of the accelerometer's bias, m/s², and of the lever arm
_MEDIAN = 2.366  # median of the chi-squared distribution with three degrees of freedom
_ROBUST = 3.0  # scale of Cauchy's loss, standard deviations
_ITERATIONS, _SETTLED, _DIFFERENCE = 20, 0.03, 1e-6  # maximum, tolerance in deviations, finite difference

# Maximum median rate and centripetal acceleration of anything that carries a radar: one turn a second, three times gravity.
_MOST_RAD_S, _MOST_MPS2 = 6.0, 30.0


@dataclass(frozen=True)
class _ImuMotion:
    times_s: Floats
    rates: Floats  # (G, 3) rad/s without bias
    turns: Floats  # (G, 3, 3) rotations to the initial frame
    speeds: Floats  # (G, 3) integral of the specific forces without bias in the initial frame, m/s

    @classmethod
    def of(cls, imu: Imu, rate_bias: Floats, force_bias: Floats) -> "_ImuMotion":
        """Integrate `imu` corrected for biases (K, 3) of rates at evenly spaced knots, and (3,) of forces."""
        assert imu.specific_force is not None
        at = np.linspace(imu.times_s[0], imu.times_s[-1], len(rate_bias))
        rates = imu.angular_velocity - interpolate(imu.times_s, at, rate_bias)
        turns = integrate_rates(imu.times_s, rates)
        forces = np.einsum("gij,gj->gi", turns, imu.specific_force - force_bias)
        speeds = cumulative_trapezoid(forces, imu.times_s, axis=0, initial=0)
        return cls(imu.times_s, rates, turns, speeds)

    def at(self, times_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Interpolate rates (F, 3), rotations (F, 3, 3) and speeds (F, 3) at `times_s` (F,)."""
        times_s = np.clip(times_s, self.times_s[0], self.times_s[-1])
        before = np.clip(np.searchsorted(self.times_s, times_s) - 1, 0, len(self.times_s) - 2)
        left = (times_s - self.times_s[before])[:, None]
        turns = np.einsum("fij,fjk->fik", self.turns[before], rotation(self.rates[before] * left))
        rates, speeds = (interpolate(times_s, self.times_s, of) for of in (self.rates, self.speeds))
        return rates, turns, speeds


@dataclass(frozen=True)
class ImuAlignment:
    """Extrinsics and time offset between an IMU and a radar."""

    R_sensor_imu: Floats  # (3, 3)
    sigma_rad: float  # its standard deviation about the least certain axis. 0: given
    time_offset_s: float  # delay of the times of scans in the clock of the IMU
    lever_m: Floats  # (3,) position of the radar in the axes of the IMU
    covariance: Floats  # (7, 7) of `lever_m`, the rotation vector in the axes of the IMU, and the time offset
    gyroscope: Gyroscope
    up: Floats  # (F, 3) unit vectors in the frame of the radar at each scan

    @property
    def report(self) -> dict[str, Any]:
        keys = ("R_sensor_imu", "sigma_rad", "time_offset_s", "lever_m")
        return {key: np.asarray(getattr(self, key)).tolist() for key in keys}

    @property
    def words(self) -> str:
        how = f"found to {np.degrees(self.sigma_rad):.1f} degrees" if self.sigma_rad > 0 else "given"
        return f"The IMU's axes were {how}, scans are {self.time_offset_s:.3f} s late in its clock, and its accelerometer gives the vertical."

    @classmethod
    def of(
        cls, imu: Imu, velocities: SensorVelocities, times_s: Floats, radar: Ints | slice = slice(None)
    ) -> "ImuAlignment | None":
        """Estimate from velocities at `times_s` (F,), those of the scans `radar`. None if it is not observable, or does not explain them."""
        velocities, own_s = velocities.select(radar), times_s[radar]
        if imu.specific_force is None or len(own_s) < 2 * _WINDOW_SCANS or len(imu) < 2:
            return None
        rows, window = _windows(own_s)
        if len(rows) == 0 or own_s[-1] - own_s[0] < 4 * _UNRELATED_S:
            return None
        model = _AlignmentModel(imu, velocities.select(rows), own_s[rows], window)
        if (solved := _solve_linearly(model)) is None:
            return None
        model, x = solved
        x, covariance = _minimise(model.residuals, x)
        if not np.isfinite(x).all():
            return None
        scale = float(np.median((model.velocity_residuals(x) ** 2).sum(axis=1))) / _MEDIAN
        # A scale below 1 does not reduce the covariance: common errors of scans do not show in residuals.
        covariance *= max(scale, 1.0)
        known = imu.R_sensor_imu is not None
        sigma_rad = 0.0 if known else float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        R, gravity, lever_m, late_s, motion = model.unpack(x)
        if scale > _LEFT or sigma_rad > _KNOWN_RAD or abs(late_s) > 2 * _MAX_TIME_OFFSET_S:
            return None
        # Against gravity, Qᵀ g in the axes of the IMU.
        up = -np.einsum("ij,fkj,k->fi", R, motion.at(times_s - late_s)[1], gravity)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        rates, bias_rad_s = np.einsum("ij,gj->gi", R, motion.rates), np.sqrt(covariance.diagonal()[13:].max())
        gyroscope = Gyroscope.of(rates, imu.times_s + late_s, times_s, float(bias_rad_s))
        used = np.array([9, 10, 11, 0, 1, 2, 12])
        kept = covariance[np.ix_(used, used)]
        if known:
            kept[3:6] = kept[:, 3:6] = 0.0
        return cls(R, sigma_rad, late_s, lever_m, kept, gyroscope, up)


def _windows(times_s: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows (K,) of scans in windows of about `_WINDOW_S` without gaps, and their window (K,)."""
    usual = float(np.median(np.diff(times_s)))
    length_s = max(_WINDOW_S, _WINDOW_SCANS * usual)
    number, begin = np.zeros(len(times_s), np.intp), 0
    for i in range(1, len(times_s)):
        ends = times_s[i] - times_s[i - 1] > 5 * usual or times_s[i] - times_s[begin] > length_s
        begin = i if ends else begin
        number[i] = number[i - 1] + ends
    rows = np.flatnonzero(np.bincount(number)[number] > 2)
    return rows, np.unique(number[rows], return_inverse=True)[1].ravel()


@dataclass(frozen=True)
class _AlignmentModel:
    """Equation above for K scans, of rotation vector, gravity, bias of forces, lever arm, time offset, bias of rates at knots."""

    imu: Imu
    velocities: SensorVelocities
    times_s: Floats  # (K,)
    window: NDArray[np.intp]  # (K,) ascending
    R_first: Floats = field(default_factory=lambda: np.eye(3))  # that the rotation vector refines

    @cached_property
    def begins(self) -> NDArray[np.intp]:
        return np.searchsorted(self.window, np.arange(self.window[-1] + 1))

    @cached_property
    def weights(self) -> tuple[Floats, Floats]:
        """Information (K, 3, 3) of the velocities, and matrices (K, 3, 3) that whiten them."""
        information = np.linalg.inv(self.velocities.covariance).astype(np.float64)
        return information, np.linalg.cholesky(information).transpose(0, 2, 1).astype(np.float64)

    def centre(self, values: Floats) -> Floats:
        """Subtract the mean of each window from values (K, ...)."""
        counts = np.bincount(self.window).reshape(-1, *[1] * (values.ndim - 1))
        return values - (np.add.reduceat(values, self.begins, axis=0) / counts)[self.window]

    def unpack(self, x: Floats) -> tuple[Floats, Floats, Floats, float, _ImuMotion]:
        """Return the rotation, gravity, the lever arm, the time offset, and the motion without biases."""
        turn, gravity, force_bias, lever_m, late_s, rate_bias = np.split(x, [3, 6, 9, 12, 13])
        R = self.R_first if self.imu.R_sensor_imu is not None else self.R_first @ rotation(turn)
        motion = _ImuMotion.of(self.imu, rate_bias.reshape(-1, 3), force_bias)
        return R, gravity, lever_m, float(late_s[0]), motion

    def velocity_residuals(self, x: Floats) -> Floats:
        """Return whitened residual velocities (K, 3), with the mean of each window removed."""
        R, gravity, lever_m, late_s, motion = self.unpack(x)
        at_s = self.times_s - late_s
        rates, turns, speeds = motion.at(at_s)
        information, whitening = self.weights
        moved = np.einsum("ji,fj->fi", R, self.velocities.mean_mps) - np.cross(rates, lever_m)
        since_s = at_s - self.imu.times_s[0]
        left = np.einsum("fij,fj->fi", turns, moved) - speeds - since_s[:, None] * gravity
        to_radar = np.einsum("ij,fkj->fik", R, turns)
        weights = np.einsum("fji,fjk,fkl->fil", to_radar, information, to_radar)
        sums = np.add.reduceat(np.einsum("fij,fj->fi", weights, left), self.begins)
        means = np.linalg.solve(np.add.reduceat(weights, self.begins), sums[..., None])[..., 0]
        return np.einsum("fij,fjk,fk->fi", whitening, to_radar, left - means[self.window])

    def residuals(self, x: Floats) -> Floats:
        prior = [x[:3] / np.pi, x[6:9] / _FORCE_BIAS, x[9:12] / _LEVER_M, x[13:16] / FIRST_BIAS_RAD_S]
        changes = (x[16:] - x[13:-3]) / _BIAS_CHANGE_RAD_S
        return np.concatenate([self.velocity_residuals(x).ravel(), *prior, changes])


def _solve_linearly(model: _AlignmentModel) -> tuple[_AlignmentModel, Floats] | None:
    """Solve for rotation, gravity and time offset by linear least squares. None if not significant."""
    imu, times_s = model.imu, model.times_s
    motion = _ImuMotion.of(imu, np.zeros((1, 3)), np.zeros(3))

    def fit(at_s: Floats) -> tuple[float, Floats]:
        """Return the residual sum of squares, and the entries of Rᵀ row by row, then gravity."""
        _, turns, speeds = motion.at(at_s)
        rows = np.zeros((len(at_s), 3, 12))
        rows[:, :, :9] = np.einsum("fij,fk->fijk", turns, model.velocities.mean_mps).reshape(-1, 3, 9)
        rows[:, :, 9:] = -(at_s - at_s.mean())[:, None, None] * np.eye(3)
        a, b = model.centre(rows).reshape(-1, 12), model.centre(speeds).ravel()
        matrix, vector = np.einsum("nk,nl->kl", a, a), np.einsum("nk,n->k", a, b)
        solved = np.linalg.solve(matrix + 1e-6 * np.trace(matrix) * np.eye(12), vector)
        return float((b**2).sum() - (solved * vector).sum()), solved

    late = np.arange(-_MAX_TIME_OFFSET_S, _MAX_TIME_OFFSET_S + 1e-9, _LATE_STEP_S)
    fits = [fit(times_s - s) for s in late]
    best = int(np.argmin([cost for cost, _ in fits]))
    # A mostly stationary drive has the same rotations and velocities at many times.
    span_s = times_s[-1] - times_s[0]
    away = np.linspace(_UNRELATED_S, span_s - _UNRELATED_S, _UNRELATED)
    cost, solved = fits[best]
    if cost >= min(fit(times_s[0] + (times_s - times_s[0] + s) % span_s)[0] for s in away):
        return None
    R = nearest_rotation(solved[:9].reshape(3, 3).T) if imu.R_sensor_imu is None else imu.R_sensor_imu
    knots = 1 + int(np.clip((imu.times_s[-1] - imu.times_s[0]) // _KNOT_S, 1, _KNOTS))
    x = np.concatenate([np.zeros(3), solved[9:], np.zeros(6), [late[best]], np.zeros(3 * knots)])
    return replace(model, R_first=R), x


def _minimise(residuals: Callable[[Floats], Floats], x: Floats) -> tuple[Floats, Floats]:
    """Minimise Cauchy's loss of normalised residuals by Gauss-Newton; return the parameters and their covariance."""
    for _ in range(_ITERATIONS):
        now = residuals(x)
        slopes = (np.stack([residuals(x + h) for h in _DIFFERENCE * np.eye(len(x))]) - now) / _DIFFERENCE
        weighted = slopes / (1 + (now / _ROBUST) ** 2)
        covariance = np.linalg.inv(np.einsum("kn,ln->kl", weighted, slopes))
        step = -np.einsum("kl,ln,n->k", covariance, weighted, now)
        x = x + step
        if (np.abs(step) < _SETTLED * np.sqrt(covariance.diagonal())).all():
            break
    return x, covariance


@dataclass(frozen=True)
class Inertial:
    """The usable measurements of an IMU."""

    gyroscope: Gyroscope | None = None
    alignment: ImuAlignment | None = None
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        imu: Imu | None,
        velocities: SensorVelocities | None,
        times_s: Floats,
        begin_s: float,
        radar: Ints | slice = slice(None),
    ) -> "Inertial":
        """Build for scans at `times_s` (F,) relative to `begin_s`, in the clock of the IMU, aligned with the scans `radar` of one radar."""
        if imu is None:
            return cls()
        # Check units first.
        rate = float(np.median(np.linalg.norm(imu.angular_velocity, axis=1)))
        across = rate * (0.0 if velocities is None else velocities.select(radar).usual_mps)
        if rate > _MOST_RAD_S or across > _MOST_MPS2:
            measured = f"{rate:.3g} rad/s, {across:.0f} m/s² across the trajectory"
            return cls().without(f"the median of its rates is {measured}. They may be in deg/s: give rad/s")
        imu = replace(imu, times_s=imu.times_s - begin_s)
        if len(imu) < 2 or imu.times_s[0] > times_s[-1] or imu.times_s[-1] < 0:
            return cls().without("it measured before or after all scans. Are both times of one clock?")
        found = None if velocities is None else ImuAlignment.of(imu, velocities, times_s, radar)
        if found is not None:
            return cls(found.gyroscope, found)
        if imu.R_sensor_imu is None:
            return cls().without("Doppler and accelerometer do not determine its rotation: give R_sensor_imu")
        rates = np.einsum("ij,gj->gi", imu.R_sensor_imu, imu.angular_velocity)
        return cls(Gyroscope.of(rates, imu.times_s, times_s))

    def learnt(self, turn_rates: Sequence[MotionRate | None]) -> "Inertial":
        """Estimate the errors of the gyroscope from turn rates, rad/s, or leave it out if they contradict it."""
        if self.gyroscope is None:
            return self
        try:
            return replace(self, gyroscope=self.gyroscope.learnt(turn_rates))
        except UnusableGyroscopeError as why:
            return self.without(why)

    def without(self, why: object) -> "Inertial":
        return Inertial(None, notes=(*self.notes, f"The gyroscope is not used: {why}."))


def level_poses(poses: Floats, covariance: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Minimally rotate poses (F, 4, 4) and covariances to a world with z up, by `up` (F, 3) in the frame of the radar."""
    now = np.einsum("fij,fj->i", poses[:, :3, :3], up)
    turn, _ = Rotation.align_vectors([[0, 0, 1.0]], [now])
    if now[2] < 0 and np.hypot(now[0], now[1]) < 1e-9 * -now[2]:
        turn = Rotation.from_rotvec([np.pi, 0, 0])  # upside down: the axis is arbitrary
    R, found = turn.as_matrix(), poses.copy()
    found[:, :3] = np.einsum("ij,fjk->fik", R, poses[:, :3])
    return found, covariance_in(covariance, R)
