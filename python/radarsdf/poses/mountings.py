"""Joint estimate of the trajectory of a body, and of the mountings and time offsets of its radars.

The trajectory is a cubic B-spline, estimated jointly with the mountings by the Gauss-Newton method. The velocity of radar k in its
own frame at a scan is, for a mounting of rotation M and lever arm l,

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

from radarsdf._core import CommonPlanes
from radarsdf.arrays import Floats, Ints32
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.doppler import SensorVelocities
from radarsdf.poses.motion import Motion
from radarsdf.poses.planes import SensorReturns, planes_of, unbiased_normals
from radarsdf.poses.rigid import assembled, increments, moved, rotation, skew
from radarsdf.returns.noise import rig_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.threads import resolve_num_threads

# Unknowns of a knot, and of a radar: lever arm, rotation, time offset, systematic error of its velocities, share of the speed.
_PATH, _OWN = 6, 10
# Their standard deviations about the given mountings: m, rad, s. The error of elevations makes that of vertical velocities larger:
# on a motorway, those of two radars were wrong by 0.003 and 0.01.
_COMMON = SensorVelocities.common_sigma
PRIOR = np.array([*[0.5] * 3, *[0.2] * 3, 0.1, _COMMON, _COMMON, 0.01])
_FIXED = 1e12  # information that fixes the reference
_WEAK = 1e-4
# Cell edges by iteration, relative to a map's surfels; 0: Doppler alone.
_CELLS = (0, 0, 0, 2, 2, 1, 1, 1, 1, 1, 1, 1)
_FEWEST = 3  # returns of a radar on a plane that it shares with others
# Factor of the variances of returns on planes: which plane a return belongs to depends on its error, and so do the planes. Measured on
# simulated drives with ghosts: without it, errors are 3 times their deviations, and Doppler is overruled.
_IN_COMMON = 10.0
_SIGMAS2 = 4.0  # squared scale of the Geman-McClure weight
_SLOW = 0.001  # standard deviation of slowly changing errors of velocities, share of the speed
_LEAST_CHANGE = 1e-3  # m/s and rad/s, between knots


@dataclass(frozen=True)
class RadarsOfBody:
    """Scans of K radars in order of time, and velocities of the radars by Doppler."""

    of_scan: Ints32  # (F,)
    times_s: Floats  # (F,)
    returns: SensorReturns
    mean_mps: Floats  # (F, 3) in the sensor frame
    whitening: Floats  # (F, 3, 3) of velocities; 0: unknown
    cell_m: float  # edge of the cell of a plane
    reference: int  # radar whose mounting is kept


@dataclass(frozen=True)
class _Motion:
    """Motion of the body at F times."""

    weights: Floats  # (F, J) of the knots
    rates: Floats  # (F, J) derivatives of the weights
    R: Floats
    p: Floats
    v: Floats  # world, m/s
    omega: Floats  # body, rad/s
    change: Floats  # (F, 12) derivatives of position, orientation, velocity and turn rate, world


@dataclass(frozen=True)
class BodyPath:
    """Estimates."""

    knots_s: Floats
    positions: Floats  # (J, 3)
    turns: Floats  # (J, 3) rotation vectors, world
    first: RotationSpline  # that the turns refine
    mountings: Floats  # (K, 4, 4)
    late_s: Floats  # (K,)
    shares: Floats  # (K, 3)

    @classmethod
    def of(cls, times_s: Floats, poses: Floats, end_s: float, step_s: float, mountings: Floats) -> BodyPath:
        """Fit a spline from 0 to `end_s`, with knots every `step_s`, to poses (F, 4, 4) at times (F,)."""
        count = int(np.ceil(end_s / step_s)) + 3
        knots_s = step_s * np.linspace(-3, count, count + 4)
        first = RotationSpline(times_s, Rotation.from_matrix(poses[:, :3, :3]))
        within = (times_s >= 0) & (times_s <= end_s)
        weights, positions = BSpline(knots_s, np.eye(count), 3)(times_s[within]), poses[within, :3, 3]
        # Knots before and after the drive are not observed: the spline continues smoothly (P-spline).
        weights = np.concatenate([weights, 1e-3 * np.diff(np.eye(count), 2, axis=0)])
        ahead = np.concatenate([positions - positions.mean(axis=0), np.zeros((count - 2, 3))])
        positions = np.linalg.lstsq(weights, ahead, rcond=None)[0]
        own = np.zeros((len(mountings), 4))
        return cls(knots_s, positions, np.zeros((count, 3)), first, mountings, own[:, 0], own[:, 1:])

    def motion(self, times_s: Floats) -> _Motion:
        times_s = np.clip(times_s, self.knots_s[3], self.knots_s[-4])
        basis = BSpline(self.knots_s, np.eye(len(self.positions)), 3)
        weights = np.stack([basis(times_s, order) for order in range(3)])
        p, v, acceleration = weights @ self.positions
        turns = weights @ self.turns
        R = rotation(turns[0]) @ self.first(times_s).as_matrix()
        omega, alpha = (self.first(times_s, i) + np.einsum("fji,fj->fi", R, turns[i]) for i in (1, 2))
        turning, accelerating = np.einsum("fij,kfj->kfi", R, [omega, alpha])
        change = np.concatenate([v, turning, acceleration, accelerating], axis=1)
        return _Motion(weights[0], weights[1], R, p, v, omega, change)

    def moved(self, step: Floats) -> BodyPath:
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

    def columns(
        self, at: _Motion, by_motion: Floats, own: Floats | None = None, of_scan: Ints32 | None = None
    ) -> Any:
        """Derivatives (F * M, U), sparse, from those by the motion (F, M, 12) and the unknowns of the radars (F, M, 10)."""
        count, rows, _ = by_motion.shape
        path = np.einsum("fmi,fj->fmji", by_motion[..., :6], at.weights)
        path += np.einsum("fmi,fj->fmji", by_motion[..., 6:], at.rates)
        radars = np.zeros((count, rows, len(self.mountings), _OWN))
        if own is not None:
            own[..., 6] = -np.einsum("fmi,fi->fm", by_motion, at.change)
            radars[np.arange(count), :, of_scan] = own
        whole = [path.reshape(count * rows, -1), radars.reshape(count * rows, -1)]
        return sparse.csr_matrix(np.concatenate(whole, axis=1))


def _block_diagonal(blocks: Floats) -> Any:
    return sparse.bsr_matrix((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)))


def _sensor_rows(path: BodyPath, radars: RadarsOfBody) -> tuple[Floats, Floats, Any, Any]:
    """Poses (F, 4, 4) and velocities (F, 3) of the radars, and derivatives of their increments (6 F, U), and of these (3 F, U)."""
    at = path.motion(radars.times_s - path.late_s[radars.of_scan])
    M = path.mountings[radars.of_scan]
    lever, arm = M[:, :3, 3], np.einsum("fij,fj->fi", at.R, M[:, :3, 3])
    poses = assembled(at.R @ M[:, :3, :3], at.p + arm)
    in_body = np.einsum("fji,fj->fi", at.R, at.v) + np.cross(at.omega, lever)
    velocities = np.einsum("fji,fj->fi", M[:, :3, :3], in_body)
    speeds = np.linalg.norm(velocities, axis=1)
    by_motion, own = np.zeros((len(M), 9, 12)), np.zeros((len(M), 9, _OWN))
    by_motion[:, :6, :6] = np.eye(6)
    by_motion[:, :3, 3:6] = -skew(arm)
    back, from_body = poses[:, :3, :3].swapaxes(1, 2), M[:, :3, :3].swapaxes(1, 2)
    by_motion[:, 6:, 3:] = np.concatenate([back @ skew(at.v), back, -back @ skew(arm)], axis=2)
    own[:, :3, :3] = own[:, 3:6, 3:6] = at.R
    own[:, 6:, :3], own[:, 6:, 3:6] = from_body @ skew(at.omega), from_body @ skew(in_body)
    own[:, 6:, 7:] = speeds[:, None, None] * np.eye(3)
    of_poses = path.columns(at, by_motion[:, :6], own[:, :6], radars.of_scan)
    of_velocities = path.columns(at, by_motion[:, 6:], own[:, 6:], radars.of_scan)
    return poses, velocities + speeds[:, None] * path.shares[radars.of_scan], of_poses, of_velocities


def _smooth_rows(path: BodyPath) -> tuple[Any, Floats]:
    """Derivatives and residuals (G, 6) of changes of velocity, m/s, and turn rate, rad/s, from knot to knot."""
    at = path.motion((path.knots_s[3:-4] + path.knots_s[4:-3]) / 2)
    by_motion = np.zeros((len(at.v), 6, 12))
    by_motion[:, :3, 6:9], by_motion[:, 3:, 9:] = np.eye(3), at.R.swapaxes(1, 2)
    columns = path.columns(at, by_motion)
    return columns[6:] - columns[:-6], np.diff(np.concatenate([at.v, at.omega], axis=1), axis=0)


def _step_rows(path: BodyPath, steps: Motion, times_s: Floats) -> tuple[Any, Floats]:
    """Derivatives and residuals (F - 1, 6) of the steps of the body at `times_s` (F,) against given ones, normalised."""
    at = path.motion(times_s)
    poses = assembled(at.R, at.p)
    spread = np.sqrt(np.repeat(steps.variances, 3) * steps.shares)
    columns = path.columns(at, np.tile(np.eye(6, 12), (len(at.p), 1, 1)))
    before, after = (_block_diagonal(jacobian / spread[:, :, None]) for jacobian in steps.jacobians(poses))
    return before @ columns[:-6] + after @ columns[6:], steps.errors(poses) / spread


def _plane_equations(
    poses: Floats, radars: RadarsOfBody, cell_m: float, config: FitConfig, num_threads: int
) -> tuple[Any, Floats]:
    """Normal equations of increments of the poses (F, 4, 4) of the radars from common planes: (6 F, 6 F), sparse, and (6 F,)."""
    rays = radars.returns.posed(poses)
    surfels = Surfels.of(rays, cell_m / LEAVES_PER_SURFEL, num_threads)
    planes = planes_of(rays.points, surfels, num_threads)
    # Of one or two returns of a radar on a plane of another, chance and the cell decide: they turned a simulated radar by 0.8 degrees.
    on = np.flatnonzero(planes >= 0)
    plane, radar = planes[on], radars.of_scan[rays.scans[on]]
    counts = np.zeros((len(surfels.centres), rays.num_sensors), np.int64)
    np.add.at(counts, (plane, radar), 1)
    few = (counts[plane, radar] < _FEWEST) & (np.count_nonzero(counts, axis=1)[plane] > 1)
    planes[on[few]] = -1
    noise = rig_noise(surfels, rays, config.returns, num_threads).of_scans(rays)
    of_rays = rays.points, rays.directions, rays.ranges_m, rays.scans, planes
    of_scans = poses[:, :3, 3] - rays.origin, rays.up_of_scan
    of_planes = surfels.centres, unbiased_normals(surfels, num_threads)
    common = CommonPlanes(*of_rays, *of_scans, *of_planes, cell_m, noise, len(poses), num_threads)
    diagonal, gradient, coupling, scans, first = common.equations
    shape = 3 * (len(first) - 1), 6 * len(poses)
    C = sparse.bsr_matrix((coupling.reshape(-1, 3, 6), scans, first), shape)
    return (_block_diagonal(diagonal.reshape(-1, 6, 6)) - C.T @ C) / _IN_COMMON, gradient / _IN_COMMON


def estimate_mountings(
    path: BodyPath, radars: RadarsOfBody, steps: tuple[Motion, Floats] | None, config: FitConfig
) -> tuple[BodyPath, Floats]:
    """Return the estimates and covariances (K, 7, 7) of lever arm, rotation and time offset. `steps`: given ones, at times (F,)."""
    given, num_path, K = path.mountings, _PATH * len(path.positions), len(path.mountings)
    information, num_threads = np.tile(1 / PRIOR**2, (K, 1)), resolve_num_threads(config.num_threads)
    information[radars.reference, :7] = _FIXED
    # Includes the noise of the first trajectory: an overestimate.
    spread = np.sqrt((_smooth_rows(path)[1] ** 2).mean(axis=0)) + _LEAST_CHANGE
    for cells in _CELLS:
        # Velocities alone do not observe the turns of the body: at first, its trajectory is kept.
        held = np.concatenate([np.full(num_path, _WEAK if cells else _FIXED), information.ravel()])
        H, g = sparse.diags(held).tocsr(), np.zeros(len(held))
        off = [increments(given, path.mountings), path.late_s[:, None], path.shares]
        g[num_path:] = (information * np.concatenate(off, axis=1)).ravel()
        poses, velocities, of_poses, of_velocities = _sensor_rows(path, radars)
        off_mps = np.einsum("fij,fj->fi", radars.whitening, velocities - radars.mean_mps)
        robust = 1 / (1 + (off_mps**2).sum(axis=1) / (3 * _SIGMAS2))
        whitening = _block_diagonal(robust[:, None, None] * radars.whitening)
        changes, smooth = _smooth_rows(path)
        weights = sparse.diags(np.tile(1 / spread, len(smooth)))
        rows = [(whitening @ of_velocities, robust[:, None] * off_mps), (weights @ changes, smooth / spread)]
        for J, residual in rows if steps is None else [*rows, _step_rows(path, *steps)]:
            H, g = H + J.T @ J, g + J.T @ residual.ravel()
        if cells:
            of_planes, gradient = _plane_equations(poses, radars, cells * radars.cell_m, config, num_threads)
            H, g = H + of_poses.T @ of_planes @ of_poses, g + of_poses.T @ gradient
        solver = splu(H.tocsc())
        path = path.moved(-solver.solve(g))
    units = np.eye(len(held), K * _OWN, -num_path)
    blocks = solver.solve(units)[num_path:].reshape(K, _OWN, K, _OWN)
    covariance = np.stack([blocks[k, :7, k, :7] for k in range(K)])
    # Errors of velocities that change slowly pass for a delay where the speed changes slowly.
    at_s, apart_s = np.linspace(0.0, radars.times_s[-1], 2 * len(path.positions), retstep=True)
    v = path.motion(at_s).v
    change = np.linalg.norm(np.diff(v, axis=0), axis=1) / apart_s
    slow_s = _SLOW * np.linalg.norm(v, axis=1).mean() / np.sqrt((change**2).mean())
    covariance[information[:, 6] < _FIXED, 6, 6] += slow_s**2
    return path, covariance
