"""Calibration of several radars on one body: mountings and time offsets, from their Doppler and the surfaces that they share.

The trajectory is a cubic B-spline, estimated jointly with the mountings by the Gauss-Newton method. The velocity of radar k in its
own frame at a scan is, for a mounting of rotation M and lever arm l,

    v_k = M^T (v_body + omega x l)

and the returns of all radars lie on common planes, whose offsets and tilts are eliminated (Schur complement).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf._core import CommonPlanes
from radarsdf.arrays import Floats, Ints, Ints32
from radarsdf.checks import check, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.checked_scans import CheckedScans, checked_settings
from radarsdf.poses.consistency import Consistency
from radarsdf.poses.doppler import LEAST_MPS, SensorVelocities
from radarsdf.poses.imu import Inertial
from radarsdf.poses.motion import Motion, unsteadiness
from radarsdf.poses.odometry import odometry
from radarsdf.poses.planes import SensorReturns, plane_cell_m, planes_of, unbiased_normals
from radarsdf.poses.rigid import assembled, increments, moved, rotation, skew, step_vectors
from radarsdf.returns.ghosts import first_crossed
from radarsdf.returns.noise import rig_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.rig import Imu, Label, Rig
from radarsdf.scans import Scans, chosen

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
_BENT = 10.0  # most changes that count, medians: a straight path may bend at its ends, where an offset wrong by 70 ms was known to 3
_SLOW = 0.001  # standard deviation of slowly changing errors of velocities, share of the speed
_DIFFERENCE = 1e-3  # of numeric derivatives: m, rad, s
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
    knots_s: Floats
    positions: Floats  # (J, 3)
    turns: Floats  # (J, 3) rotation vectors, world
    first: RotationSpline  # that the turns refine
    mountings: Floats  # (K, 4, 4)
    late_s: Floats  # (K,)
    shares: Floats  # (K, 3)

    @classmethod
    def of(cls, times_s: Floats, poses: Floats, end_s: float, step_s: float, mountings: Floats) -> "BodyPath":
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

    def moved(self, step: Floats) -> "BodyPath":
        count = len(self.positions)
        path, own = step[: _PATH * count].reshape(count, _PATH), step[_PATH * count :].reshape(-1, _OWN)
        return replace(
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


def _pose_rows(path: BodyPath, radars: RadarsOfBody) -> tuple[Floats, Any]:
    """Poses (F, 4, 4) of the radars, and derivatives (6 F, U) of their increments."""
    at, M = path.motion(radars.times_s - path.late_s[radars.of_scan]), path.mountings[radars.of_scan]
    arm = np.einsum("fij,fj->fi", at.R, M[:, :3, 3])
    by_motion, own = np.tile(np.eye(6, 12), (len(M), 1, 1)), np.zeros((len(M), 6, _OWN))
    by_motion[:, :3, 3:6] = -skew(arm)
    own[:, :3, :3] = own[:, 3:, 3:6] = at.R
    return assembled(at.R @ M[:, :3, :3], at.p + arm), path.columns(at, by_motion, own, radars.of_scan)


def _velocity_rows(path: BodyPath, radars: RadarsOfBody) -> tuple[Floats, Any]:
    """Velocities (F, 3) of the radars in their own frames, and derivatives (3 F, U)."""
    at, M = path.motion(radars.times_s - path.late_s[radars.of_scan]), path.mountings[radars.of_scan]
    arm = np.einsum("fij,fj->fi", at.R, M[:, :3, 3])
    in_body = np.einsum("fji,fj->fi", at.R, at.v) + np.cross(at.omega, M[:, :3, 3])
    velocities = np.einsum("fji,fj->fi", M[:, :3, :3], in_body)
    speeds = np.linalg.norm(velocities, axis=1)[:, None]
    back, from_body = (at.R @ M[:, :3, :3]).swapaxes(1, 2), M[:, :3, :3].swapaxes(1, 2)
    by_motion = np.concatenate([0 * back, back @ skew(at.v), back, -back @ skew(arm)], axis=2)
    by_mounting = from_body @ skew(at.omega), from_body @ skew(in_body), np.zeros((len(M), 3, 1))
    own = np.concatenate([*by_mounting, speeds[:, None] * np.eye(3)], axis=2)
    return velocities + speeds * path.shares[radars.of_scan], path.columns(at, by_motion, own, radars.of_scan)


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
    before, after = (_block_diagonal(jacobian / spread[:, :, None]) for jacobian in steps.jacobians(poses)[1])
    return before @ columns[:-6] + after @ columns[6:], steps.errors(poses) / spread


def _plane_equations(
    poses: Floats, radars: RadarsOfBody, cell_m: float, config: FitConfig
) -> tuple[Any, Floats]:
    """Normal equations of increments of the poses (F, 4, 4) of the radars from common planes: (6 F, 6 F), sparse, and (6 F,)."""
    rays, num_threads = radars.returns.posed(poses), config.num_threads
    surfels = Surfels.of(rays, cell_m / LEAVES_PER_SURFEL, num_threads)
    planes = planes_of(rays, surfels, num_threads)
    noise = rig_noise(surfels, rays, config.returns, num_threads)
    # Ghosts of the ground turned a radar that looks aside over a car park by 0.8 degrees.
    planes[first_crossed(surfels, np.flatnonzero(surfels.is_flat()), rays, noise, num_threads) >= 0] = -1
    # Of one or two returns of a radar on a plane of another, chance and the cell decide: they turned a simulated radar by 0.8 degrees.
    on = np.flatnonzero(planes >= 0)
    plane, radar = planes[on], radars.of_scan[rays.scans[on]]
    counts = np.zeros((len(surfels.centres), rays.num_sensors), np.int64)
    np.add.at(counts, (plane, radar), 1)
    few = (counts[plane, radar] < _FEWEST) & (np.count_nonzero(counts, axis=1)[plane] > 1)
    planes[on[few]] = -1
    of_rays = rays.points, rays.directions, rays.ranges_m, rays.scans, planes
    of_scans = poses[:, :3, 3] - rays.origin, rays.up_of_scan
    of_planes = surfels.centres, unbiased_normals(surfels, num_threads)
    of_noise = noise.of_scans(rays)
    common = CommonPlanes(*of_rays, *of_scans, *of_planes, cell_m, of_noise, len(poses), num_threads)
    diagonal, gradient, coupling, scans, first = common.equations
    shape = 3 * (len(first) - 1), 6 * len(poses)
    C = sparse.bsr_matrix((coupling.reshape(-1, 3, 6), scans, first), shape)
    return (_block_diagonal(diagonal.reshape(-1, 6, 6)) - C.T @ C) / _IN_COMMON, gradient / _IN_COMMON


def _variances(J: Any, covariance: Floats) -> Floats:
    """Return the diagonal (N,) of J C Jᵀ for a sparse J (N, U) and covariance C (U, U)."""
    return np.asarray(J.multiply(J @ covariance).sum(axis=1)).ravel()


def _of_path_errors(path: BodyPath, radars: RadarsOfBody, whitening: Any, covariance: Floats) -> Floats:
    """Return half the expected squares of the errors of velocities caused by those of the path, of covariance (U, U): their first and
    second derivatives (2, K, 10) by lever arms, rotations and time offsets."""
    K, count = len(path.mountings), len(covariance)

    def expected(step: Floats) -> Floats:
        moved_path = path.moved(np.append(np.zeros(count), np.tile(step, K)))
        J = (whitening @ _velocity_rows(moved_path, radars)[1]).tocsr()[:, :count]
        of_scans = _variances(J, covariance).reshape(-1, 3).sum(axis=1) / 2
        return np.bincount(radars.of_scan, of_scans, K).astype(np.float64)

    here, found = expected(np.zeros(_OWN)), np.zeros((2, K, _OWN))
    for i, step in enumerate(_DIFFERENCE * np.eye(7, _OWN)):
        above, below = expected(step), expected(-step)
        found[:, :, i] = (above - below) / (2 * _DIFFERENCE), (above - 2 * here + below) / _DIFFERENCE**2
    return found


def estimate_mountings(
    path: BodyPath, radars: RadarsOfBody, steps: tuple[Motion, Floats] | None, config: FitConfig
) -> tuple[BodyPath, Floats]:
    """Return the estimates and covariances (K, 7, 7) of lever arm, rotation and time offset. `steps`: given ones, at times (F,)."""
    given, num_path, K = path.mountings, _PATH * len(path.positions), len(path.mountings)
    information = np.tile(1 / PRIOR**2, (K, 1))
    information[radars.reference, :7] = _FIXED
    # Includes the noise of the first trajectory: an overestimate, until the errors of the path are known.
    spread = np.sqrt((_smooth_rows(path)[1] ** 2).mean(axis=0)) + _LEAST_CHANGE
    for cells in _CELLS:
        # Velocities alone do not observe the turns of the body: at first, its trajectory is kept.
        held = np.concatenate([np.full(num_path, _WEAK if cells else _FIXED), information.ravel()])
        H, g = sparse.diags(held).tocsr(), np.zeros(len(held))
        off = [increments(given, path.mountings), path.late_s[:, None], path.shares]
        g[num_path:] = (information * np.concatenate(off, axis=1)).ravel()
        poses, of_poses = _pose_rows(path, radars)
        velocities, of_velocities = _velocity_rows(path, radars)
        off_mps = np.einsum("fij,fj->fi", radars.whitening, velocities - radars.mean_mps)
        robust = 1 / (1 + (off_mps**2).sum(axis=1) / (3 * _SIGMAS2))
        whitening = _block_diagonal(robust[:, None, None] * radars.whitening)
        changes, smooth = _smooth_rows(path)
        weights = sparse.diags(np.tile(1 / spread, len(smooth)))
        rows = [(whitening @ of_velocities, robust[:, None] * off_mps), (weights @ changes, smooth / spread)]
        for J, residual in rows if steps is None else [*rows, _step_rows(path, *steps)]:
            H, g = H + J.T @ J, g + J.T @ residual.ravel()
        if cells:
            of_planes, gradient = _plane_equations(poses, radars, cells * radars.cell_m, config)
            H, g = H + of_poses.T @ of_planes @ of_poses, g + of_poses.T @ gradient
            covariance = splu(H[:num_path, :num_path].tocsc()).solve(np.eye(num_path))
            of_errors = _variances(changes[:, :num_path], covariance).reshape(-1, 6)
            spread = np.sqrt((smooth**2 + of_errors).mean(axis=0)) + _LEAST_CHANGE
        observed = H
        if cells == _CELLS[-1]:
            # The most probable path is smoother than the true one, which lengthened lever arms by up to 0.4 m. So they are
            # estimated for all paths that the data leave possible: the marginal likelihood, by the method of Laplace.
            slope, curvature = _of_path_errors(path, radars, whitening, covariance)
            g[num_path:] += slope.ravel()
            H = H + sparse.diags(np.append(np.zeros(num_path), np.maximum(curvature, 0.0)))
        path = path.moved(-splu(H.tocsc()).solve(g))
    # Curvature speeds convergence, but observes nothing.
    of_radars = np.eye(len(held), K * _OWN, -num_path)
    blocks = splu(observed.tocsc()).solve(of_radars)[num_path:].reshape(K, _OWN, K, _OWN)
    covariance = np.stack([blocks[k, :7, k, :7] for k in range(K)])
    # Errors of velocities that change slowly pass for a delay where the speed changes slowly.
    at_s, apart_s = np.linspace(0.0, radars.times_s[-1], 2 * len(path.positions), retstep=True)
    v = path.motion(at_s).v
    change = np.linalg.norm(np.diff(v, axis=0), axis=1) / apart_s
    change = np.minimum(change, _BENT * np.median(change))
    slow_s = _SLOW * np.linalg.norm(v, axis=1).mean() / np.sqrt((change**2).mean())
    covariance[information[:, 6] < _FIXED, 6, 6] += slow_s**2
    return path, covariance


_ROUNDING = 1e-11  # covariances of what is fixed
_MOST_KNOTS = 200
_ANY_MPS2 = 1e12  # variance of an unknown velocity
_UNOBSERVED = np.repeat([0.1, np.radians(2.0), 0.02], [3, 3, 1])  # standard deviations: m, rad, s
# Names, units, and why a drive does not show them.
_COMPONENTS = (
    ("lever arm along {}", 1.0, "m", "the drive turns too little about other axes"),
    ("rotation about {}", np.degrees(1.0), "degrees", "it is kept as given, since nothing shows it"),
    ("time offset", 1.0, "s", "the velocity changes too little"),
)


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
    def of(cls, given: Floats, T: Floats, covariance: Floats, late_s: float) -> "Mounting":
        """Build from a covariance (7, 7) that includes the time offset, without what it leaves open."""
        covariance = np.where(np.abs(covariance) < _ROUNDING, 0.0, covariance)
        sigmas = np.sqrt(covariance.diagonal())
        unknown = sigmas > _UNOBSERVED
        found = np.where(unknown | (sigmas == 0), 0.0, np.append(increments(given, T), late_s))
        T = moved(given, found[:6])
        T[:3, 3][unknown[:3]] = np.nan
        if unknown[3:6].all():
            T[:3, :3] = np.nan
        why = []
        for i in np.flatnonzero(unknown):
            name, scale, unit, reason = _COMPONENTS[i // 3]
            many = f"a deviation of {scale * sigmas[i]:.2g} {unit} for {scale * _UNOBSERVED[i]:.2g} {unit}"
            why.append(f"{name.format('xyz'[i % 3])}: {many}: {reason}")
        covariance[unknown], covariance[:, unknown] = np.nan, np.nan
        late_s = np.nan if unknown[6] else float(found[6])
        return cls(T, covariance[:6, :6], late_s, float(np.sqrt(covariance[6, 6])), tuple(why))


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
    config = checked_settings(config)
    rig, limits = instance(scans, Scans, "scans").rig, config.returns
    several = rig is not None and len(np.unique(rig.of_scan)) > 1
    check(several, "calibrate needs scans of several radars: Scans(..., sensors=labels)")
    check((times_s := scans.times_s) is not None, "times_s are missing: the time of each scan, s")
    assert rig is not None
    assert times_s is not None
    order = np.argsort(times_s, kind="stable")
    scans, rig, times_s = scans.select(order), rig.select(order), times_s[order]
    labels, reference, mountings = rig.labels, int(rig.of_scan[0]), rig.T_body_sensor
    if mountings is None:
        mountings = np.tile(np.eye(4), (len(labels), 1, 1))
    imu = scans.imu if imu is None else imu
    if imu is not None and imu.R_sensor_imu is not None:
        imu = replace(imu, R_sensor_imu=mountings[reference, :3, :3].T @ imu.R_sensor_imu)
    checked, undecided = CheckedScans.of_radars(scans, None, None, mounted=False)[1], Consistency(doubts=())
    radars = [undecided.corrected(radar.signed()) for radar in checked]
    of_radars = {labels[rig.of_scan[radar.rows[0]]]: radar for radar in radars}
    notes = [f"{label}: {note}" for label, radar in of_radars.items() for note in radar.notes]
    static = {i: scan for radar in radars for i, scan in zip(radar.rows.tolist(), radar.scans, strict=True)}
    mean_mps, whitening = _velocities(radars, len(times_s))
    first = np.flatnonzero(rig.of_scan == reference)
    at_s, path, given, on_path = _body_path(scans, first, times_s[first], mountings[reference], imu, config)
    interval_s = float(np.median(np.diff(times_s[first])))
    # The part that turns most.
    turned = np.append(0.0, np.cumsum(np.linalg.norm(step_vectors(path)[:, 3:], axis=1)))
    last = np.searchsorted(at_s, at_s + _MOST_KNOTS * interval_s, side="right") - 1
    begin = int(np.argmax(turned[last] - turned))
    begin_s, end_s = at_s[[begin, last[begin]]].tolist()
    kept = np.flatnonzero((times_s >= begin_s) & (times_s <= end_s))
    points, of_scan = [static[i] for i in kept.tolist()], rig.of_scan[kept]
    returns = SensorReturns.of(points, limits.min_range_m, limits.max_range_m, Rig(labels, of_scan, None))
    cell_m, velocities = plane_cell_m(points, config.leaf_size_m), (mean_mps[kept], whitening[kept])
    measured = RadarsOfBody(of_scan, times_s[kept] - begin_s, returns, *velocities, cell_m, reference)
    body = BodyPath.of(at_s - begin_s, path, end_s - begin_s, interval_s, mountings)
    steps = None
    if given:
        rows = (at_s >= begin_s) & (at_s <= end_s)
        motion = Motion.of(path[rows], *unsteadiness(path[rows], at_s[rows]), at_s[rows])
        steps = motion, at_s[rows] - begin_s
    body, covariance = estimate_mountings(body, measured, steps, config)
    each = zip(mountings, body.mountings, covariance, body.late_s, strict=True)
    found = {label: Mounting.of(*own) for label, own in zip(labels, each, strict=True)}
    own = of_radars[labels[reference]].velocities
    of_imu, on_imu = _imu_mounting(imu, own, times_s[first], mountings[reference])
    return Calibration(found, of_imu, str(labels[reference]), [*notes, *on_path, *on_imu])


def _velocities(radars: Sequence[CheckedScans], count: int) -> tuple[Floats, Floats]:
    """Return velocities by Doppler (F, 3) of `count` scans in their sensor frames, and matrices (F, 3, 3) that whiten them."""
    mean, covariance = np.zeros((count, 3)), np.tile(_ANY_MPS2 * np.eye(3), (count, 1, 1))
    for radar in radars:
        # Those of single scans have no prior of the vertical: a sensor may be mounted in any direction.
        each = () if radar.velocities is None else radar.velocities.of_scans
        for i, velocity in zip(radar.rows, each, strict=False):
            if velocity.found:
                mean[i], covariance[i] = radar.sign * velocity.velocity_mps, velocity.covariance
    least = np.full((count, 3), LEAST_MPS)
    least[:, 2] = np.hypot(LEAST_MPS, PRIOR[-1] * np.linalg.norm(mean, axis=1))
    information = np.linalg.inv(covariance + least[:, :, None] ** 2 * np.eye(3))
    return mean, np.linalg.cholesky(information).swapaxes(1, 2)


def _body_path(
    scans: Scans, rows: Ints, times_s: Floats, T_body_sensor: Floats, imu: Imu | None, config: FitConfig
) -> tuple[Floats, Floats, bool, list[str]]:
    """Return ascending times and poses of the body at scans `rows` (K,) of one radar, at `times_s` (K,), whether they are given,
    else by odometry, and notes."""
    given, notes = True, list[str]()
    try:
        path = scans.poses[rows]
    except ValueError:
        own, doppler_mps = [scans.points[i] for i in rows], chosen(scans.doppler_mps, rows)
        options: dict[str, Any] = {"imu": imu, "config": config, "progress": False}
        found = odometry(own, doppler_mps=doppler_mps, times_s=times_s, **options)
        part = found.longest_segment()
        given, notes, times_s = False, found.report["notes"], times_s[part]
        path = found.poses[part] @ np.linalg.inv(T_body_sensor)
    rising = np.append(True, np.diff(times_s) > 0)
    return times_s[rising], path[rising], given, notes


def _imu_mounting(
    imu: Imu | None, velocities: SensorVelocities | None, times_s: Floats, T_body_sensor: Floats
) -> tuple[Mounting | None, tuple[str, ...]]:
    """Align the IMU with a radar of known mounting, and return its mounting and notes."""
    inertial = Inertial.of(imu, velocities, times_s - times_s[0], float(times_s[0]))
    if (found := inertial.alignment) is None:
        return None, inertial.notes
    T = assembled(T_body_sensor[:3, :3] @ found.R_sensor_imu)
    lever_m = T[:3, :3] @ found.lever_m
    T[:3, 3] = T_body_sensor[:3, 3] - lever_m
    J = np.eye(7)
    J[:3, :3], J[3:6, 3:6], J[:3, 3:6] = -T[:3, :3], T[:3, :3], skew(lever_m[None])[0] @ T[:3, :3]
    # The alignment states the delay of scans in the clock of the IMU.
    return Mounting.of(T, T, J @ found.covariance @ J.T, -found.time_offset_s), inertial.notes
