"""Registration of a scan with planes by Gauss-Newton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh

from radarsdf._core import LocalPlanes
from radarsdf.arrays import Floats
from radarsdf.poses.planes import reduction
from radarsdf.poses.rigid import increments, moved

_CELLS = 4.0, 2.0  # cell edges, coarse to fine, relative to a map's surfels
# Along the least certain axis, shifted scans of tunnels have 0.6 to 1.2 times the information, those of nine other kinds of scenes
# 0.02 to 0.19 times.
_ITERATIONS = 8  # maximum at each cell size
_SETTLED = 0.3, 0.03  # tolerances at these, standard deviations: coarse cells only lead to the fine ones
_MOST_RETURNS = 2000  # of a scan
_LEAST_VARIANCE = 1e-12  # of a prior, m² and rad²
_SHIFTS = 0.0, 1.0, -1.0, 2.0, -2.0  # cells, beyond the extent of single objects
_SURE = 0.05  # standard deviation of a translation of the prior that needs no returns, cells


@dataclass(frozen=True)
class Registered:
    """Pose of a registered scan."""

    pose: Floats  # (4, 4) T_world_sensor
    covariance: Floats  # (6, 6) translation, m, rotation vector, rad, world axes
    agreeing: float  # share of inliers on the planes, in [0, 1]
    # Share of the variance of the prior that the returns removed, of translation and rotation, in the least certain direction.
    observed: tuple[float, float]

    @property
    def least_certain(self) -> Floats:
        """(3,) axis of the least certain translation."""
        return _least_certain(self.covariance)


@dataclass
class PlaneMap:
    """Planes in coarse and fine cells."""

    cell_size_m: float  # edge of the cell of a map's surfel, m
    variances: list[float] = field(default_factory=list)  # of a return, as :attr:`SensorNoise.variances`

    def __post_init__(self) -> None:
        self.coarse, self.fine = (LocalPlanes(cells * self.cell_size_m) for cells in _CELLS)

    @property
    def capture_m(self) -> float:
        """Error of a pose, at its returns, from which :meth:`fit` converges, m."""
        return 0.5 * _CELLS[0] * self.cell_size_m

    def add(self, points: Floats, sign: int = 1) -> None:
        """Add points (N, 3), world, m; sign -1 removes them exactly."""
        for planes in (self.coarse, self.fine):
            planes.add(points, sign)

    def normal_equations(self, scan: Floats, pose: Floats) -> tuple[Floats, Floats, float]:
        """Return Hessian (6, 6), gradient (6,) and number of inliers of a scan (N, 3), sensor frame, at a pose (4, 4)."""
        *equations, inliers = self.fine.agreement(scan, pose, self.variances)
        return *_discount_tilts(*equations), inliers

    def fit(self, scan: Floats, mean: Floats, prior: Floats, start: Floats | None = None) -> Registered:
        """Fit the pose of a scan (N, 3), sensor frame, m, coarse to fine, given that of the prior and its covariance (6, 6)."""
        prior = prior + _LEAST_VARIANCE * np.eye(6)
        information, pose = np.linalg.inv(prior), mean if start is None else start
        for planes, settled in zip((self.coarse, self.fine), _SETTLED, strict=True):
            for _ in range(_ITERATIONS):
                *equations, inliers = planes.agreement(scan, pose, self.variances)
                hessian, gradient = _discount_tilts(*equations)
                total = hessian + information
                off = gradient + information @ increments(mean, pose)
                step = -np.linalg.solve(total, off).astype(np.float64)
                pose = moved(pose, step)
                if step @ total @ step < 6 * settled**2:
                    break
        covariance = self._discount_chance(scan, pose, prior, np.linalg.inv(total))
        moved_share = _removed_share(prior[:3, :3], covariance[:3, :3])
        observed = moved_share, _removed_share(prior[3:, 3:], covariance[3:, 3:])
        return Registered(pose, covariance, inliers / len(scan), observed)

    def _discount_chance(self, scan: Floats, pose: Floats, prior: Floats, covariance: Floats) -> Floats:
        """Remove the spurious information along the least certain axis that returns have for any shift of the scan."""
        # In a tunnel, returns match the walls everywhere, and some matches constrain the scan by chance.
        cell_m = _CELLS[-1] * self.cell_size_m
        axis = _least_certain(covariance)
        before, left = (float(axis @ each[:3, :3] @ axis) for each in (prior, covariance))
        if before < (_SURE * cell_m) ** 2:
            return covariance
        chance = self._chance([scan], pose[None], axis)
        widened = 1 / (1 / before + (1 - chance) * max(1 / left - 1 / before, 0.0)) - left
        covariance = covariance.copy()
        covariance[:3, :3] += max(widened, 0.0) * np.outer(axis, axis)
        return covariance

    def information_by_chance(self, scans: Sequence[Floats], poses: Floats) -> tuple[Floats, float]:
        """Return the axis (3,) along which scans (N_i, 3) at `poses` (F, 4, 4) are least certain, and the share of their
        information there that any shifted scans have, too."""
        hessian = np.sum([self.normal_equations(s, p)[0] for s, p in zip(scans, poses, strict=True)], axis=0)
        axis = np.linalg.eigh(hessian[:3, :3])[1][:, 0]
        return axis, self._chance(scans, poses, axis)

    def _chance(self, scans: Sequence[Floats], poses: Floats, axis: Floats) -> float:
        """Return the information along `axis` (3,) of shifted scans, relative to that of scans at `poses` (F, 4, 4)."""
        information: list[float] = []
        for shift in _SHIFTS:
            shifted = poses.copy()
            shifted[:, :3, 3] += _CELLS[-1] * self.cell_size_m * shift * axis
            hessian = np.sum(
                [self.normal_equations(s, p)[0] for s, p in zip(scans, shifted, strict=True)], axis=0
            )
            variance = axis @ np.linalg.pinv(hessian, hermitian=True)[:3, :3] @ axis
            information.append(1 / float(variance) if variance > 0 else 0.0)
        return min(1.0, float(np.mean(information[1:])) / max(information[0], 1e-12))


def _least_certain(covariance: Floats) -> Floats:
    return np.linalg.eigh(covariance[:3, :3])[1][:, -1]


def _discount_tilts(hessian: Floats, gradient: Floats, doubt: Floats) -> tuple[Floats, Floats]:
    """Return Hessian (6, 6) and gradient (6,) without the contribution (6, 6) of errors of the normals."""
    # Along a wall, slightly tilted normals would seem to observe the position along it.
    try:
        np.linalg.cholesky(hessian - doubt)
    except np.linalg.LinAlgError:
        M = reduction(hessian, doubt)
        return M @ hessian @ M.T, M @ M @ gradient
    return hessian - doubt, gradient - doubt @ np.linalg.solve(hessian, gradient)


def _removed_share(prior: Floats, covariance: Floats) -> float:
    """Return the share of the prior variance removed, in the direction where it is smallest."""
    return max(1 - float(eigh(covariance, prior, eigvals_only=True)[-1]), 0.0)


def apart_m(poses: Floats, pose: Floats, radius_m: float) -> Floats:
    """Return upper bounds (K,) of the displacement, m, of a return at range `radius_m` between poses (K, 4, 4) and `pose`."""
    off = increments(np.broadcast_to(pose, poses.shape), poses)
    moved_m, turned_rad = (np.linalg.norm(of, axis=1) for of in (off[:, :3], off[:, 3:]))
    return moved_m + radius_m * turned_rad


def thin(scan: Floats, most: int = _MOST_RETURNS) -> Floats:
    """Subsample a scan evenly to about `most` returns."""
    return np.ascontiguousarray(scan[:: max(1, -(-len(scan) // most))])
