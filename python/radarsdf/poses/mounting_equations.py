"""Equations of the velocities, changes, steps and common planes of several radars on one body, by its path and their mountings.

The velocity of radar k in its own frame at a scan is, for a mounting of rotation M and lever arm l,

    v_k = M^T (v_body + omega x l)

and the returns of all radars lie on common planes, whose offsets and tilts are eliminated (Schur complement).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from radarsdf.arrays import Floats, Ints32
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import CommonPlanes
from radarsdf.poses.body_path import OF_RADAR, BodyPath
from radarsdf.poses.motion import Motion
from radarsdf.poses.planes import SensorReturns, planes_of, unbiased_normals
from radarsdf.poses.rigid import assembled, skew
from radarsdf.returns.ghosts import first_crossed
from radarsdf.returns.noise import errors_with, rig_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels

_FEWEST = 3  # returns of a radar on a plane that it shares with others
# Factor of the variances of returns on planes: which plane a return belongs to depends on its error, and so do the planes. Measured on
# simulated drives with ghosts: without it, errors are 3 times their deviations, and Doppler is overruled.
_IN_COMMON = 10.0


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


def block_diagonal(blocks: Floats) -> Any:
    return sparse.bsr_matrix((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)))


def motion_rows(path: BodyPath, radars: RadarsOfBody) -> tuple[Floats, Any, Floats, Any]:
    """Poses (F, 4, 4) and velocities (F, 3), own frames, of the radars, each followed by its derivatives (6 F, U) and (3 F, U)."""
    at, M = path.motion(radars.times_s - path.late_s[radars.of_scan]), path.mountings[radars.of_scan]
    arm = np.einsum("fij,fj->fi", at.R, M[:, :3, 3])
    by_motion, own = np.tile(np.eye(6, 12), (len(M), 1, 1)), np.zeros((len(M), 6, OF_RADAR))
    by_motion[:, :3, 3:6] = -skew(arm)
    own[:, :3, :3] = own[:, 3:, 3:6] = at.R
    of_poses = path.columns(at, by_motion, own, radars.of_scan)
    in_body = np.einsum("fji,fj->fi", at.R, at.v) + np.cross(at.omega, M[:, :3, 3])
    velocities = np.einsum("fji,fj->fi", M[:, :3, :3], in_body)
    speeds = np.linalg.norm(velocities, axis=1)[:, None]
    back, from_body = (at.R @ M[:, :3, :3]).swapaxes(1, 2), M[:, :3, :3].swapaxes(1, 2)
    by_motion = np.concatenate([0 * back, back @ skew(at.v), back, -back @ skew(arm)], axis=2)
    by_mounting = from_body @ skew(at.omega), from_body @ skew(in_body), np.zeros((len(M), 3, 1))
    own = np.concatenate([*by_mounting, speeds[:, None] * np.eye(3)], axis=2)
    velocities += speeds * path.shares[radars.of_scan]
    of_velocities = path.columns(at, by_motion, own, radars.of_scan)
    return assembled(at.R @ M[:, :3, :3], at.p + arm), of_poses, velocities, of_velocities


def smooth_rows(path: BodyPath) -> tuple[Any, Floats]:
    """Derivatives and residuals (G, 6) of changes of velocity, m/s, and turn rate, rad/s, from knot to knot."""
    at = path.motion((path.knots_s[3:-4] + path.knots_s[4:-3]) / 2)
    by_motion = np.zeros((len(at.v), 6, 12))
    by_motion[:, :3, 6:9], by_motion[:, 3:, 9:] = np.eye(3), at.R.swapaxes(1, 2)
    columns = path.columns(at, by_motion)
    return columns[6:] - columns[:-6], np.diff(np.concatenate([at.v, at.omega], axis=1), axis=0)


def step_rows(path: BodyPath, steps: Motion, times_s: Floats) -> tuple[Any, Floats]:
    """Derivatives and residuals (F - 1, 6) of the steps of the body at `times_s` (F,) against given ones, normalised."""
    at = path.motion(times_s)
    poses = assembled(at.R, at.p)
    spread = np.sqrt(np.repeat(steps.variances, 3) * steps.shares)
    columns = path.columns(at, np.tile(np.eye(6, 12), (len(at.p), 1, 1)))
    before, after = (block_diagonal(jacobian / spread[:, :, None]) for jacobian in steps.jacobians(poses)[1])
    return before @ columns[:-6] + after @ columns[6:], steps.errors(poses) / spread


def plane_equations(
    poses: Floats, radars: RadarsOfBody, cell_m: float, config: FitConfig
) -> tuple[Any, Floats]:
    """Normal equations of increments of the poses (F, 4, 4) of the radars from common planes: (6 F, 6 F), sparse, and (6 F,)."""
    rays, num_threads = radars.returns.posed(poses), config.num_threads
    surfels = Surfels.of(rays, cell_m / LEAVES_PER_SURFEL, num_threads)
    noise = rig_noise(surfels, rays, config.returns, num_threads)
    planes = planes_of(rays, surfels, num_threads, noise)
    # Ghosts of the ground turned a radar that looks aside over a car park by 0.8 degrees.
    planes[first_crossed(surfels, np.flatnonzero(surfels.is_flat()), rays, noise, num_threads) >= 0] = -1
    # Of one or two returns of a radar on a plane of another, chance and the cell decide: they turned a simulated radar by 0.8 degrees.
    on = np.flatnonzero(planes >= 0)
    plane, radar = planes[on], radars.of_scan[rays.scans[on]]
    counts = np.zeros((len(surfels.centres), rays.num_sensors), np.int64)
    np.add.at(counts, (plane, radar), 1)
    few = (counts[plane, radar] < _FEWEST) & (np.count_nonzero(counts, axis=1)[plane] > 1)
    planes[on[few]] = -1
    # The lever arm of a return includes its error, which depends on that along the normal: walls turned two radars by 0.2 degrees.
    # That of its most probable position does not. Along the normal, the return stays.
    on = np.flatnonzero(planes >= 0)
    normals = unbiased_normals(surfels, num_threads)
    of_returns, points = normals[planes[on]], rays.points.copy()
    off = np.einsum("ni,ni->n", points[on] - surfels.centres[planes[on]], of_returns)[:, None]
    points[on] += (off * (of_returns - errors_with(rays, on, of_returns, noise))).astype(np.float32)
    of_rays = points, rays.directions, rays.ranges_m, rays.scans, planes
    of_scans = poses[:, :3, 3] - rays.origin, rays.up_of_scan
    of_planes = surfels.centres, normals
    of_noise = noise.of_scans(rays)
    common = CommonPlanes(*of_rays, *of_scans, *of_planes, cell_m, of_noise, len(poses), num_threads)
    diagonal, gradient, coupling, scans, first = common.equations
    shape = 3 * (len(first) - 1), 6 * len(poses)
    C = sparse.bsr_matrix((coupling.reshape(-1, 3, 6), scans, first), shape)
    return (block_diagonal(diagonal.reshape(-1, 6, 6)) - C.T @ C) / _IN_COMMON, gradient / _IN_COMMON
