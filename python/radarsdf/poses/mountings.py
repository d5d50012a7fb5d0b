"""Joint estimate of the path of a body and the mountings of its radars by the Gauss-Newton method."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from radarsdf.arrays import Floats
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses import mounting_equations as equations
from radarsdf.poses.body_path import OF_KNOT, OF_RADAR, BodyPath
from radarsdf.poses.doppler import SensorVelocities
from radarsdf.poses.motion import Motion
from radarsdf.poses.rigid import increments

# Standard deviations of the unknowns of a radar about the given mountings: m, rad, s. The error of elevations makes that of vertical
# velocities larger: on a motorway, those of two radars were wrong by 0.003 and 0.01.
_COMMON = SensorVelocities.common_sigma
PRIOR = np.array([*[0.5] * 3, *[0.2] * 3, 0.1, _COMMON, _COMMON, 0.01])
_FIXED = 1e12  # information that fixes the reference
_WEAK = 1e-4
# Cell edges by iteration, relative to a map's surfels; 0: Doppler alone.
_CELLS = (0, 0, 0, 2, 2, 1, 1, 1, 1, 1, 1, 1)
_SIGMAS2 = 4.0  # squared scale of the Geman-McClure weight
_BENT = 10.0  # most changes that count, medians: a straight path may bend at its ends, where an offset wrong by 70 ms was known to 3
_SLOW = 0.001  # standard deviation of slowly changing errors of velocities, share of the speed
_LEAST_CHANGE = 1e-3  # m/s and rad/s, between knots
# Standard deviation of the prior of changes, relative to theirs. The most probable path is smoother than the true one: with 1, lever
# arms were up to 0.4 m longer and a side radar rolled by 0.6 degrees. That error shrinks with the square of the factor.
_LOOSE = 5.0


def estimate_mountings(
    path: BodyPath, radars: equations.RadarsOfBody, steps: tuple[Motion, Floats] | None, config: FitConfig
) -> tuple[BodyPath, Floats]:
    """Return the estimates and covariances (K, 7, 7) of lever arm, rotation and time offset. `steps`: given ones, at times (F,)."""
    given, num_path, K = path.mountings, OF_KNOT * len(path.positions), len(path.mountings)
    information = np.tile(1 / PRIOR**2, (K, 1))
    information[radars.reference, :7] = _FIXED
    # Includes the noise of the first trajectory: an overestimate, until the errors of the path are known.
    spread = np.sqrt((equations.smooth_rows(path)[1] ** 2).mean(axis=0)) + _LEAST_CHANGE
    for cells in _CELLS:
        # Velocities alone do not observe the turns of the body: at first, its trajectory is kept.
        held = np.concatenate([np.full(num_path, _WEAK if cells else _FIXED), information.ravel()])
        H, g = sparse.diags(held).tocsr(), np.zeros(len(held))
        off = [increments(given, path.mountings), path.late_s[:, None], path.shares]
        g[num_path:] = (information * np.concatenate(off, axis=1)).ravel()
        poses, of_poses, velocities, of_velocities = equations.motion_rows(path, radars)
        off_mps = np.einsum("fij,fj->fi", radars.whitening, velocities - radars.mean_mps)
        robust = 1 / (1 + (off_mps**2).sum(axis=1) / (3 * _SIGMAS2))
        whitening = equations.block_diagonal(robust[:, None, None] * radars.whitening)
        changes, smooth = equations.smooth_rows(path)
        loose = _LOOSE * spread
        weights = sparse.diags(np.tile(1 / loose, len(smooth)))
        rows = [(whitening @ of_velocities, robust[:, None] * off_mps), (weights @ changes, smooth / loose)]
        for J, residual in rows if steps is None else [*rows, equations.step_rows(path, *steps)]:
            H, g = H + J.T @ J, g + J.T @ residual.ravel()
        if cells:
            of_planes, gradient = equations.plane_equations(poses, radars, cells * radars.cell_m, config)
            H, g = H + of_poses.T @ of_planes @ of_poses, g + of_poses.T @ gradient
            covariance = splu(H[:num_path, :num_path].tocsc()).solve(np.eye(num_path))
            J = changes[:, :num_path]  # the diagonal of J C Jᵀ:
            of_errors = np.asarray(J.multiply(J @ covariance).sum(axis=1)).reshape(-1, 6)
            spread = np.sqrt((smooth**2 + of_errors).mean(axis=0)) + _LEAST_CHANGE
        path = path.moved(-splu(H.tocsc()).solve(g))
    of_radars = np.eye(len(held), K * OF_RADAR, -num_path)
    blocks = splu(H.tocsc()).solve(of_radars)[num_path:].reshape(K, OF_RADAR, K, OF_RADAR)
    covariance = np.stack([blocks[k, :7, k, :7] for k in range(K)])
    # Errors of velocities that change slowly pass for a delay where the speed changes slowly.
    at_s, apart_s = np.linspace(0.0, radars.times_s[-1], 2 * len(path.positions), retstep=True)
    v = path.motion(at_s).v
    change = np.linalg.norm(np.diff(v, axis=0), axis=1) / apart_s
    change = np.minimum(change, _BENT * np.median(change))
    slow_s = _SLOW * np.linalg.norm(v, axis=1).mean() / np.sqrt((change**2).mean())
    covariance[information[:, 6] < _FIXED, 6, 6] += slow_s**2
    return path, covariance
