"""Calibration of several radars on one body: mountings and time offsets, from their Doppler and the surfaces that they share.

The trajectory of the body is a cubic B-spline, estimated jointly with the mountings by the Gauss-Newton method. The velocity of
radar k in its own frame at a scan is, for a mounting of rotation M and lever arm l,

    v_k = M^T (v_body + omega x l)

and the returns of all radars lie on common planes, whose offsets and tilts are eliminated (Schur complement).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf.arrays import Floats, Ints
from radarsdf.checks import instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.imu import Imu
from radarsdf.poses.checked_scans import CheckedScans
from radarsdf.poses.doppler import CLEAR, LEAST_MPS, SensorVelocities, sign_significance
from radarsdf.poses.imu import ImuAlignment, Inertial
from radarsdf.poses.motion import Motion, unsteadiness
from radarsdf.poses.odometry import odometry
from radarsdf.poses.planes import SensorReturns, plane_cell_m, planes_of, unbiased_normals
from radarsdf.poses.rigid import increments, moved, rotation, skew, step_vectors
from radarsdf.returns.moving import SensorVelocity, sensor_velocities
from radarsdf.returns.noise import sensor_noise, variances_across
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.rig import Label, Rig
from radarsdf.scans import Scans, chosen
from radarsdf.threads import resolve_num_threads

_PATH, _OWN = (
    6,
    10,
)  # unknowns of a knot, and of a radar: lever arm, rotation, time offset, share of the speed
# Standard deviations of mountings about the given ones: m, rad, s; and of the systematic error of velocities, share of the speed.
# The latter is that of elevations for the vertical: on a motorway, vertical velocities of two radars were wrong by 0.003 and 0.01.
_COMMON = SensorVelocities.common_sigma
_PRIOR = np.array([*[0.5] * 3, *[0.2] * 3, 0.1, _COMMON, _COMMON, 0.01])
_FIXED = 1e12  # information that fixes the reference
_WEAK = 1e-4
_UNOBSERVED = np.repeat([0.1, np.radians(2.0), 0.02], [3, 3, 1])
_CELLS = (
    0,
    0,
    0,
    2,
    2,
    1,
    1,
    1,
    1,
    1,
    1,
    1,
)  # cell edges by iteration, relative to a map's surfels; 0: Doppler alone
_FEWEST = 3  # returns of a radar on a plane that it shares with others
# Factor of the variances of returns on planes: which plane a return belongs to depends on its error, and so do the planes. Measured on
# simulated drives with ghosts: without it, errors are 3 times their deviations, and Doppler is overruled.
_IN_COMMON = 10.0
_SIGMAS2 = 4.0  # squared scale of the Geman-McClure weight
_MEDIANS = {1: 0.4549, 3: 2.366}  # of the chi-squared distribution
_DIFFERENCE_S = 1e-3
_SLOW = 0.001  # standard deviation of slowly changing errors of velocities, share of the speed
_ROUNDING = 1e-11  # covariances of what is fixed
_MOST_KNOTS = 200
_LEAST_CHANGE = 1e-3  # m/s and rad/s, between knots


@dataclass(frozen=True)
class _Radars:
    """Scans of K radars in order of time, and velocities of the radars by Doppler."""

    of_scan: Ints  # (F,)
    times_s: Floats  # (F,)
    returns: SensorReturns
    mean_mps: Floats  # (F, 3) in the sensor frame
    whitening: Floats  # (F, 3, 3) of velocities; 0: unknown


@dataclass(frozen=True)
class _Motion:
    """Motion of the body at F times, and weights (F, J) of the knots."""

    weights: Floats
    rates: Floats
    R: Floats
    p: Floats
    v: Floats  # world, m/s
    omega: Floats  # body, rad/s


@dataclass(frozen=True)
class _State:
    """Estimates."""

    knots_s: Floats
    positions: Floats  # (J, 3)
    turns: Floats  # (J, 3) rotation vectors, world
    first: RotationSpline  # that the turns refine
    mountings: Floats  # (K, 4, 4)
    late_s: Floats  # (K,)
    shares: Floats  # (K, 3)

    def motion(self, times_s: Floats) -> _Motion:
        times_s = np.clip(times_s, self.knots_s[3], self.knots_s[-4])
        basis = BSpline(self.knots_s, np.eye(len(self.positions)), 3)
        weights, rates = basis(times_s), basis(times_s, 1)
        R = rotation(weights @ self.turns) @ self.first(times_s).as_matrix()
        omega = self.first(times_s, 1) + np.einsum("fji,fj->fi", R, rates @ self.turns)
        return _Motion(weights, rates, R, weights @ self.positions, rates @ self.positions, omega)

    def moved(self, step: Floats) -> _State:
        count = len(self.positions)
        path, own = step[: _PATH * count].reshape(count, _PATH), step[_PATH * count :].reshape(-1, _OWN)
        return dataclasses.replace(
            self,
            positions=self.positions + path[:, :3],
            turns=self.turns + path[:, 3:],
            mountings=moved(self.mountings, own[:, :6]),
            late_s=self.late_s + own[:, 6],
            shares=self.shares + own[:, 7:],
        )

    def columns(self, of_scan: Ints, pairs: list[tuple[Floats, Floats]], own: Floats) -> Any:
        """Derivatives (F * M, U), sparse: by increments of the path, weights (F, J) and blocks (F, M, 6), and of radars (F, M, 10)."""
        count, rows = len(of_scan), own.shape[1]
        path = sum(np.einsum("fmi,fj->fmji", block, weights) for weights, block in pairs)
        whole = np.zeros((count, rows, len(self.mountings), _OWN))
        whole[np.arange(count), :, of_scan] = own
        both = [np.reshape(path, (count * rows, -1)), whole.reshape(count * rows, -1)]
        return sparse.csr_matrix(np.concatenate(both, axis=1))


def _sensor_poses(state: _State, radars: _Radars) -> tuple[Floats, Any]:
    """Poses (F, 4, 4) of the radars, and their increments (6 F, U) by the unknowns."""
    times_s = radars.times_s - state.late_s[radars.of_scan]
    at, M = state.motion(times_s), state.mountings[radars.of_scan]
    poses = np.tile(np.eye(4), (len(M), 1, 1))
    poses[:, :3, :3], lever = at.R @ M[:, :3, :3], np.einsum("fij,fj->fi", at.R, M[:, :3, 3])
    poses[:, :3, 3] = at.p + lever
    by_path, own = np.tile(np.eye(6), (len(M), 1, 1)), np.zeros((len(M), 6, _OWN))
    by_path[:, :3, 3:] = -skew(lever)
    own[:, :3, :3] = own[:, 3:, 3:6] = at.R
    omega = np.einsum("fij,fj->fi", at.R, at.omega)
    own[:, :3, 6], own[:, 3:, 6] = -(at.v + np.cross(omega, lever)), -omega
    return poses, state.columns(radars.of_scan, [(at.weights, by_path)], own)


def _velocity_rows(state: _State, radars: _Radars) -> tuple[Any, Floats]:
    """Derivatives (3 F, U) and residuals (F, 3) of velocities, whitened."""
    times_s = radars.times_s - state.late_s[radars.of_scan]
    R_body, lever = state.mountings[radars.of_scan, :3, :3], state.mountings[radars.of_scan, :3, 3]

    def of_sensor(times_s: Floats) -> tuple[_Motion, Floats, Floats]:
        at = state.motion(times_s)
        in_body = np.einsum("fji,fj->fi", at.R, at.v) + np.cross(at.omega, lever)
        return at, in_body, np.einsum("fji,fj->fi", R_body, in_body)

    at, in_body, v = of_sensor(times_s)
    change = (of_sensor(times_s + _DIFFERENCE_S)[2] - of_sensor(times_s - _DIFFERENCE_S)[2]) / (
        2 * _DIFFERENCE_S
    )
    speed = np.linalg.norm(v, axis=1)
    back = np.einsum("fji,fkj->fik", R_body, at.R)  # world to sensor
    by_value, by_rate = np.zeros((2, len(v), 3, 6))
    by_value[:, :, 3:] = back @ skew(at.v)
    by_rate[:, :, :3] = back
    by_rate[:, :, 3:] = -np.einsum("fji,fjk,flk->fil", R_body, skew(lever), at.R)
    own = np.zeros((len(v), 3, _OWN))
    own[:, :, :3] = np.einsum("fji,fjk->fik", R_body, skew(at.omega))
    own[:, :, 3:6] = np.einsum("fji,fjk->fik", R_body, skew(in_body))
    own[:, :, 6] = -change
    own[:, :, 7:] = speed[:, None, None] * np.eye(3)
    v = v + speed[:, None] * state.shares[radars.of_scan]
    W = radars.whitening
    left = np.einsum("fij,fj->fi", W, v - radars.mean_mps)
    weights = np.sqrt(1 / (1 + (left**2).sum(axis=1) / (3 * _SIGMAS2)) ** 2)
    W = W * weights[:, None, None]
    columns = state.columns(radars.of_scan, [(at.weights, W @ by_value), (at.rates, W @ by_rate)], W @ own)
    return columns, left * weights[:, None]


def _smooth_rows(state: _State, spread: Floats) -> tuple[Any, Floats]:
    """Derivatives and residuals of changes of velocity and turn rate from knot to knot, normalised."""
    times_s = (state.knots_s[3:-4] + state.knots_s[4:-3]) / 2
    at = state.motion(times_s)
    residual = np.concatenate([np.diff(at.v, axis=0), np.diff(at.omega, axis=0)], axis=1) / spread
    by_rate = np.tile(np.eye(6), (len(times_s), 1, 1))
    by_rate[:, 3:, 3:] = at.R.transpose(0, 2, 1)
    by_rate /= spread[:, None]
    columns = state.columns(
        np.zeros(len(times_s), np.int64), [(at.rates, by_rate)], np.zeros((len(times_s), 6, _OWN))
    )
    return columns[6:] - columns[:-6], residual


def _plane_equations(
    state: _State, radars: _Radars, cell_m: float, config: ReturnsConfig, num_threads: int
) -> tuple[Any, Floats]:
    """Normal equations of the unknowns from common planes."""
    poses, columns = _sensor_poses(state, radars)
    rays = radars.returns.posed(poses)
    surfels = Surfels.of(rays, cell_m / LEAVES_PER_SURFEL, num_threads)
    planes = planes_of(rays.points, surfels, num_threads)
    on = np.flatnonzero(planes >= 0)
    # Of one or two returns of a radar on a plane of another, chance and the cell decide: they turned a simulated radar by 0.8 degrees.
    K, of_return = len(state.mountings), radars.of_scan[rays.scans]
    cluster = K * planes[on].astype(np.int64) + of_return[on]
    counts = np.bincount(cluster, minlength=K * len(surfels.centres))
    alone = counts.reshape(-1, K).max(axis=1) == counts.reshape(-1, K).sum(axis=1)
    on = on[(counts[cluster] >= _FEWEST) | alone[planes[on]]]
    plane, scan = planes[on], rays.scans[on]
    normals = unbiased_normals(surfels, num_threads)[plane]
    away = rays.points[on] - surfels.centres[plane]
    residual = np.einsum("ni,ni->n", away, normals)
    variance = np.empty(len(on))
    for k in range(K):
        noise = sensor_noise(surfels, rays.select(of_return == k), config, num_threads)
        rows = np.flatnonzero(of_return[on] == k)
        variance[rows] = variances_across(rays, on[rows], normals[rows], noise)
    squares = residual**2 / variance
    scale = max(1.0, float(np.median(squares)) / _MEDIANS[1])
    weights = 1 / (1 + squares / scale / _SIGMAS2) ** 2 / (variance * scale * _IN_COMMON)
    arm = rays.directions[on] * rays.ranges_m[on, None]
    jacobian = np.concatenate([normals, np.cross(arm, normals)], axis=1)
    assert surfels.widest is not None
    widest = surfels.widest[plane].astype(np.float64)
    ones = np.ones(len(on))
    tilts = [np.einsum("ni,ni->n", away, axes) / cell_m for axes in (widest, np.cross(normals, widest))]
    tangents = np.stack([ones, *tilts], axis=1)
    count, total = len(radars.of_scan), len(surfels.centres)

    def spread(values: Floats, of: Ints, width: int) -> Any:
        at = of[:, None] * values.shape[1] + np.arange(values.shape[1])
        rows = np.repeat(np.arange(len(values)), values.shape[1])
        return sparse.csr_matrix((values.ravel(), (rows, at.ravel())), (len(values), width * values.shape[1]))

    J, P = spread(jacobian, scan.astype(np.int64), count), spread(tangents, plane.astype(np.int64), total)
    W = sparse.diags(weights)
    own = np.zeros((total, 3, 3))
    np.add.at(own, plane, weights[:, None, None] * tangents[:, :, None] * tangents[:, None])
    own += (1e-9 * np.trace(own, axis1=1, axis2=2)[:, None, None] + 1e-30) * np.eye(3)
    inverse = sparse.bsr_matrix(
        (np.linalg.inv(own), np.arange(total), np.arange(total + 1)), (3 * total, 3 * total)
    )
    coupling = P.T @ W @ J
    H = J.T @ W @ J - coupling.T @ inverse @ coupling
    g = J.T @ (weights * residual) - coupling.T @ (inverse @ (P.T @ (weights * residual)))
    return columns.T @ H @ columns, columns.T @ g


def _step_rows(state: _State, poses: Motion, times_s: Floats) -> tuple[Any, Floats]:
    """Derivatives and residuals (F - 1, 6) of the steps of the body at `times_s` (F,) against given ones, normalised."""
    at = state.motion(times_s)
    path = np.tile(np.eye(4), (len(at.p), 1, 1))
    path[:, :3, :3], path[:, :3, 3] = at.R, at.p
    spread = np.sqrt(np.repeat(poses.variances, 3) * poses.shares)
    first, second = (jacobian / spread[:, :, None] for jacobian in poses.jacobians(path))
    pairs = [(at.weights[:-1], first), (at.weights[1:], second)]
    none = np.zeros((len(first), 6, _OWN))
    return state.columns(np.zeros(len(first), np.int64), pairs, none), poses.errors(path) / spread


def _estimate(
    state: _State,
    radars: _Radars,
    reference: int | None,
    steps: tuple[Motion, Floats] | None,
    cell_m: float,
    config: FitConfig,
) -> tuple[_State, Floats]:
    """Return the estimates and covariances (K, 7, 7) of lever arm, rotation and time offset. `steps`: given ones, at times (F,)."""
    given, num_path, K = state.mountings, _PATH * len(state.positions), len(state.mountings)
    information, num_threads = np.tile(1 / _PRIOR**2, (K, 1)), resolve_num_threads(config.num_threads)
    information[reference, :7] = _FIXED
    spread = _changes(state)
    for cells in _CELLS:
        # Velocities alone do not observe the turns of the body: at first, its trajectory is kept.
        held = np.concatenate([np.full(num_path, _WEAK if cells else _FIXED), information.ravel()])
        H, g = sparse.diags(held).tocsr(), np.zeros(len(held))
        off = [increments(given, state.mountings), state.late_s[:, None], state.shares]
        g[num_path:] = (information * np.concatenate(off, axis=1)).ravel()
        rows = [_velocity_rows(state, radars), _smooth_rows(state, spread)]
        for J, residual in rows if steps is None else [*rows, _step_rows(state, *steps)]:
            H, g = H + J.T @ J, g + J.T @ residual.ravel()
        if cells:
            of_planes = _plane_equations(state, radars, cells * cell_m, config.returns, num_threads)
            H, g = H + of_planes[0], g + of_planes[1]
        solver = splu(H.tocsc())
        state = state.moved(-solver.solve(g))
    units = np.zeros((len(held), K * _OWN))
    units[num_path:] = np.eye(K * _OWN)
    blocks = solver.solve(units)[num_path:].reshape(K, _OWN, K, _OWN)
    covariance = np.stack([blocks[k, :7, k, :7] for k in range(K)])
    # Errors of velocities that change slowly pass for a delay where the speed changes slowly.
    at = state.motion(np.linspace(0.0, radars.times_s[-1], 2 * len(state.positions)))
    change = np.linalg.norm(np.diff(at.v, axis=0), axis=1) / (
        radars.times_s[-1] / (2 * len(state.positions) - 1)
    )
    slow_s = _SLOW * np.linalg.norm(at.v, axis=1).mean() / np.sqrt((change**2).mean())
    covariance[information[:, 6] < _FIXED, 6, 6] += slow_s**2
    return state, covariance


def _changes(state: _State) -> Floats:
    """Return standard deviations (6,) of the changes of velocity, m/s, and turn rate, rad/s, between knots."""
    # Includes the noise of the first trajectory: an overestimate.
    at = state.motion((state.knots_s[3:-4] + state.knots_s[4:-3]) / 2)
    changes = np.diff(np.concatenate([at.v, at.omega], axis=1), axis=0)
    return np.sqrt((changes**2).mean(axis=0)) + _LEAST_CHANGE


def _turning_part(times_s: Floats, poses: Floats, most_s: float) -> tuple[float, float]:
    """Return begin and end of the part of at most `most_s` in which poses (F, 4, 4) turn most."""
    turned = np.append(0.0, np.cumsum(np.linalg.norm(step_vectors(poses)[:, 3:], axis=1)))
    last = np.searchsorted(times_s, times_s + most_s, side="right") - 1
    begin = int(np.argmax(turned[last] - turned))
    return float(times_s[begin]), float(times_s[last[begin]])


def _imu_mounting(found: ImuAlignment, T_body_sensor: Floats) -> Mounting:
    """Convert the alignment with a radar to the mounting of the IMU."""
    T = np.eye(4)
    T[:3, :3] = T_body_sensor[:3, :3] @ found.R_sensor_imu
    lever_m = T[:3, :3] @ found.lever_m
    T[:3, 3] = T_body_sensor[:3, 3] - lever_m
    J = np.eye(7)
    J[:3, :3], J[3:6, 3:6], J[:3, 3:6] = -T[:3, :3], T[:3, :3], skew(lever_m[None])[0] @ T[:3, :3]
    # The alignment states the delay of scans in the clock of the IMU.
    return Mounting.of(T, T, J @ found.covariance @ J.T, -found.time_offset_s)


@dataclass(frozen=True)
class Mounting:
    """Mounting of a radar or IMU on the body. What the drive does not show is NaN, for the reason in `unobserved`."""

    T_body_sensor: Floats
    """(4, 4) m."""
    covariance: Floats
    """(6, 6) of the translation, m, and the rotation vector about the sensor, rad, in the axes of the body."""
    time_offset_s: float
    """Delay of its times, to be subtracted from them, s."""
    time_offset_sigma_s: float
    """Its standard deviation, s. 0: it defines the clock."""
    unobserved: tuple[str, ...] = ()
    """Why values are NaN, in words."""

    @classmethod
    def of(cls, given: Floats, T: Floats, covariance: Floats, late_s: float) -> Mounting:
        """Build from a covariance (7, 7) that includes the time offset, without what it leaves open."""
        covariance = np.where(np.abs(covariance) < _ROUNDING, 0.0, covariance)
        sigmas = np.sqrt(covariance.diagonal())
        unknown, why = sigmas > _UNOBSERVED, []
        kept = unknown | (sigmas == 0)
        T = moved(given, np.where(kept[:6], 0.0, increments(given, T)))
        for axis in np.flatnonzero(unknown[:3]):
            many = f"{sigmas[axis]:.2f} m for {_UNOBSERVED[axis]:g} m"
            why.append(
                f"lever arm along {'xyz'[axis]}: a deviation of {many}: the drive turns too little about other axes"
            )
            T[axis, 3] = np.nan
        for axis in np.flatnonzero(unknown[3:6]):
            many = f"{np.degrees(sigmas[3 + axis]):.1f} degrees for {np.degrees(_UNOBSERVED[3 + axis]):.0f}"
            why.append(
                f"rotation about {'xyz'[axis]}: a deviation of {many}: it is kept as given, since nothing shows it"
            )
        if unknown[3:6].all():
            T[:3, :3] = np.nan
        if unknown[6]:
            many = f"{sigmas[6]:.3f} s for {_UNOBSERVED[6]:g} s"
            why.append(f"time offset: a deviation of {many}: the velocity changes too little")
        covariance[unknown], covariance[:, unknown] = np.nan, np.nan
        late_s = np.nan if unknown[6] else 0.0 if kept[6] else late_s
        return cls(T, covariance[:6, :6], float(late_s), float(np.sqrt(covariance[6, 6])), tuple(why))


@dataclass(frozen=True)
class Calibration:
    """Mountings of the radars of a recording."""

    mountings: dict[Label, Mounting]
    """By label of the radar."""
    imu: Mounting | None
    """That of the IMU, if there is one that the Doppler of the reference observes."""
    against: str
    """Label of the first radar, to which the mountings are relative: its own is kept."""
    notes: list[str]
    """Unused input, in words."""


def _given_poses(scans: Scans) -> Floats | None:
    try:
        return scans.poses
    except ValueError:
        return None


def _odometry_of(
    scans: Scans, rows: Ints, T_body_sensor: Floats, imu: Imu | None, config: FitConfig
) -> tuple[Ints, Floats, list[str]]:
    """Return the scans of the longest segment of one radar's odometry, their poses of the body, and notes."""
    assert scans.times_s is not None
    found = odometry(
        [scans.points[i] for i in rows],
        doppler_mps=chosen(scans.doppler_mps, rows),
        times_s=scans.times_s[rows],
        imu=imu,
        config=config,
        progress=False,
    )
    part = found.longest_segment()
    return rows[part], found.poses[part] @ np.linalg.inv(T_body_sensor), found.report["notes"]


def _measured(
    scans: Scans, rig: Rig, times_s: Floats
) -> tuple[list[Floats], Floats, Floats, dict[int, SensorVelocities | None], list[str]]:
    """Return static returns, velocities (F, 3) by Doppler, matrices (F, 3, 3) that whiten them, the same by radar, and notes."""
    notes: list[str] = []
    points, total = list(scans.points), len(rig.of_scan)
    mean, whitening = np.zeros((total, 3)), np.zeros((total, 3, 3))
    velocities: dict[int, SensorVelocities | None] = {}
    for k in np.unique(rig.of_scan).tolist():
        rows = np.flatnonzero(rig.of_scan == k)
        rows = rows[np.argsort(times_s[rows], kind="stable")]
        doppler_mps = chosen(scans.doppler_mps, rows)
        checked = CheckedScans.of([scans.points[i] for i in rows], doppler_mps, times_s[rows])
        notes += [f"{rig.labels[k]}: {note}" for note in checked.notes]
        velocities[k] = checked.velocities
        each: list[SensorVelocity | None] = [None] * len(rows)
        if checked.velocities is not None and checked.times_s is not None:
            significance = sign_significance(checked.scans, checked.velocities, checked.times_s)[0]
            sign = -1 if significance < -CLEAR else 1
            velocities[k] = checked.velocities.scaled(sign)
            each = [*sensor_velocities([scans.points[i] for i in rows], doppler_mps or [])]
        for i, scan, velocity in zip(rows.tolist(), checked.scans, each, strict=True):
            points[i] = scan
            if velocity is not None and velocity.found:
                mean[i] = sign * velocity.velocity_mps
                least = np.array(
                    [LEAST_MPS, LEAST_MPS, np.hypot(LEAST_MPS, _PRIOR[-1] * np.linalg.norm(mean[i]))]
                )
                information = np.linalg.inv(velocity.covariance + np.diag(least**2))
                whitening[i] = np.linalg.cholesky(information).T
    return points, mean, whitening, velocities, notes


def calibrate(scans: Scans, *, imu: Imu | None = None, config: FitConfig | None = None) -> Calibration:
    """Estimate how the radars of a recording are mounted, and their time offsets.

    Velocities by Doppler and common surfaces of all radars are fitted jointly with the trajectory of the body. Where the drive
    turns, and for all rotations about directions of motion, their surfaces must overlap.

    Parameters
    ----------
    scans : Scans
        Scans of several radars, with `sensors` and times. `T_body_sensor`, rough mountings, may be wrong by several degrees and
        decimetres; default: the identity. All are relative to the first radar,
        whose mounting is kept, since the trajectory absorbs a change of all of them. Poses T_world_body of its scans help.
    imu : Imu, optional
        An accelerometer and gyroscope to calibrate as well, whose `R_sensor_imu`, if known, is its rotation on the body. Default:
        that of the scans.
    config : FitConfig, optional
        Settings, of which ranges, noise, leaf cells and threads are used.

    Returns
    -------
    Calibration
        Values that the drive does not show are NaN. At most the 200 scan intervals with the most turns are used.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If there are no labels of several radars, no times, or the motion of the first radar is not observable.

    Examples
    --------
    >>> import numpy as np, radarsdf
    >>> drive = radarsdf.simulate.wall(frames=6)
    >>> scans = radarsdf.io.Scans(drive.points, drive.poses)
    >>> radarsdf.calibrate(scans)
    Traceback (most recent call last):
        ...
    ValueError: calibrate needs scans of several radars: Scans(..., sensors=labels)
    """
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    rig, limits = instance(scans, Scans, "scans").rig, config.returns
    if rig is None or len(np.unique(rig.of_scan)) < 2:
        msg = "calibrate needs scans of several radars: Scans(..., sensors=labels)"
        raise ValueError(msg)
    times_s = scans.times_s
    if times_s is None:
        msg = "times_s are missing: the time of each scan, s"
        raise ValueError(msg)
    mountings = (
        np.tile(np.eye(4), (len(rig.labels), 1, 1)) if rig.T_body_sensor is None else rig.T_body_sensor
    )
    reference = int(rig.of_scan[np.argmin(times_s)])
    points, mean, whitening, velocities, notes = _measured(scans, rig, times_s)
    imu = scans.imu if imu is None else imu
    if imu is not None and imu.R_sensor_imu is not None:
        imu = dataclasses.replace(imu, R_sensor_imu=mountings[reference, :3, :3].T @ imu.R_sensor_imu)
    first = np.flatnonzero(rig.of_scan == reference)
    first = first[np.argsort(times_s[first], kind="stable")]
    order = np.argsort(times_s, kind="stable")
    given = _given_poses(scans)
    used, path = first, given if given is None else given[first]
    if path is None:
        used, path, more = _odometry_of(scans, first, mountings[reference], imu, config)
        notes += more
    rising = np.append(True, np.diff(times_s[used]) > 0)
    at_s, path = times_s[used][rising], path[rising]
    interval_s = float(np.median(np.diff(times_s[first])))
    begin_s, end_s = _turning_part(at_s, path, _MOST_KNOTS * interval_s)
    kept = order[(times_s[order] >= begin_s) & (times_s[order] <= end_s)]
    radars = _Radars(
        rig.of_scan[kept].astype(np.int64),
        times_s[kept] - begin_s,
        SensorReturns.of([points[i] for i in kept], limits.min_range_m, limits.max_range_m),
        mean[kept],
        whitening[kept],
    )
    count = int(np.ceil((end_s - begin_s) / interval_s)) + 3
    knots_s: Floats = np.asarray(interval_s * (np.arange(count + 4) - 3.0), np.float64)
    turning = RotationSpline(at_s - begin_s, Rotation.from_matrix(path[:, :3, :3]))
    rows = (at_s >= begin_s) & (at_s <= end_s)
    weights = BSpline(knots_s, np.eye(count), 3)(at_s[rows] - begin_s)
    positions = np.linalg.lstsq(weights, path[rows, :3, 3] - path[rows, :3, 3].mean(axis=0), rcond=None)[0]
    state = _State(
        knots_s,
        positions,
        np.zeros((count, 3)),
        turning,
        mountings,
        np.zeros(len(mountings)),
        np.zeros((len(mountings), 3)),
    )
    steps = None
    if given is not None:
        motion = Motion.of(path[rows], *unsteadiness(path[rows], at_s[rows]), at_s[rows])
        steps = motion, at_s[rows] - begin_s
    cell_m = plane_cell_m([points[i] for i in kept], config.leaf_size_m)
    state, covariance = _estimate(state, radars, reference, steps, cell_m, config)
    found_each = {
        label: Mounting.of(mountings[k], state.mountings[k], covariance[k], state.late_s[k])
        for k, label in enumerate(rig.labels)
    }
    of_imu = None
    if imu is not None:
        inertial = Inertial.of(
            imu, velocities[reference], times_s[first] - times_s[first[0]], float(times_s[first[0]])
        )
        notes += inertial.notes
        if inertial.alignment is not None:
            of_imu = _imu_mounting(inertial.alignment, mountings[reference])
    return Calibration(found_each, of_imu, str(rig.labels[reference]), notes)
