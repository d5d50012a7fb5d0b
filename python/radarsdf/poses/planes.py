"""Planes shared by scans at given poses, and registration of a scan with planes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import eigh, lapack
from scipy.spatial import cKDTree

from radarsdf.arrays import Bools, Floats, Floats32, Ints32
from radarsdf.config.groups import ReturnsConfig
from radarsdf.core import CellBlocks, CommonPlanes, LocalPlanes
from radarsdf.poses.rigid import increments, moved
from radarsdf.returns.noise import SensorNoise, errors_with, rig_noise, sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, NEIGHBOUR_WEIGHT, Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import merged_keys
from radarsdf.rig import Rig

# Log2 of the edge of a region, cells. Large regions have many planes, and estimate errors well: with 8 cells, the standard
# deviation along simulated walls was 5 times too small, with 16 to 64 correct.
_DOUBLINGS = 4

# Width of the factored band, scans. 16 to 128 take the same time, since fewer need more iterations.
_TOGETHER = 32
_LEAST_RANGE_M = 1e-6  # against division by zero
# Cells are at least a quarter of the spacing of returns in a scan: with 40 returns over 150 m, smaller cells have too few. Radars
# of 500 to 2,000 returns a scan have a spacing of 0.2 to 0.5 m, so that their cells are those of a map.
_CELLS_APART = 4
_SAMPLED_SCANS = 16


def unbiased_normals(surfels: Surfels, num_threads: int) -> Floats:
    """Return unit normals (P, 3) of the surfels, corrected for the spread caused by their errors.

    Along a wall, normals are slightly tilted along it by chance, as if returns observed the position along it. In each region, the
    spread of the normals is reduced by the contribution of their errors (errors in variables, Fuller 1987). With any normals, a
    joint motion of the scans has no cost.
    """
    assert surfels.widest is not None
    planes = np.flatnonzero(surfels.is_flat())
    if len(planes) == 0:
        return surfels.normals
    cells = surfels.cell_of_plane[planes]
    normals, widest = surfels.normals[planes], surfels.widest[planes].astype(np.float64)
    across = np.cross(widest, normals)
    thickness, *widths = surfels.variances[planes].T
    weights = surfels.counts[cells] / thickness
    # Variances of the two slopes of a plane fit.
    of_across, of_widest = (weights * thickness / (surfels.support[cells] * width) for width in widths)
    spread = np.einsum("n,ni,nj->nij", weights, normals, normals)
    errors = np.einsum("n,ni,nj->nij", of_across, across, across)
    errors += np.einsum("n,ni,nj->nij", of_widest, widest, widest)
    sums = np.concatenate([spread, errors], axis=1).reshape(-1, 18)
    keys = surfels.keys[cells]
    for _ in range(_DOUBLINGS):
        keys = merged_keys(keys)
    regions, first, region = np.unique(keys, return_index=True, return_inverse=True)
    of_regions = np.add.reduceat(sums, first)
    of_regions = CellBlocks(regions).neighbour_sums(regions, of_regions, NEIGHBOUR_WEIGHT, num_threads)
    spread, errors = of_regions.reshape(-1, 2, 3, 3).transpose(1, 0, 2, 3)
    found = np.einsum("nij,nj->ni", reduction(spread, errors)[region], normals)
    lengths = np.sqrt(np.einsum("ni,ni->n", found, found))[:, None]
    # A normal explained by errors alone is not changed: the region has hardly any others.
    all_normals = surfels.normals.copy()
    all_normals[planes] = np.where(lengths > 0.5, found / np.maximum(lengths, 0.5), normals)
    return all_normals


def reduction(spread: Floats, errors: Floats) -> Floats:
    """Return linear maps M (..., K, K) with M spread Mᵀ = `spread` minus `errors`, or 0 where that is negative."""
    values, axes = np.linalg.eigh(spread)
    root = np.sqrt(np.maximum(values, 1e-12 * np.maximum(values[..., -1:], 1e-12)))[..., None, :]
    white = axes / root
    shares, turned = np.linalg.eigh(np.einsum("...ki,...kl,...lj->...ij", white, errors, white))
    kept = np.sqrt(np.maximum(1 - shares, 0.0))
    into = np.einsum("...ij,...jk->...ik", axes * root, turned)
    back = np.einsum("...ij,...jk->...ik", white, turned)
    return np.einsum("...ij,...j,...kj->...ik", into, kept, back)


def plane_cell_m(scans: Sequence[Floats], leaf_size_m: float) -> float:
    """Return the edge of the cell of a plane, m: that of a map's surfel, or larger for sparse scans (N_i, 3)."""
    sampled = [scan for scan in scans if len(scan) > 1]
    sampled = sampled[:: max(1, len(sampled) // _SAMPLED_SCANS)]
    apart_m = [float(np.median(cKDTree(scan).query(scan, 2)[0][:, 1])) for scan in sampled]
    return max(LEAVES_PER_SURFEL * leaf_size_m, float(np.median(apart_m or [0.0])) / _CELLS_APART)


@dataclass(frozen=True)
class SensorReturns:
    """Returns in the sensor frame, scan by scan."""

    directions: Floats32  # (N, 3) unit vectors
    ranges_m: Floats32  # (N,)
    scans: Ints32  # (N,) ascending
    rig: Rig | None = None  # radars of the scans, whose poses are then those of the body

    @classmethod
    def of(
        cls, scans: Sequence[Floats], min_range_m: float, max_range_m: float | None, rig: Rig | None = None
    ) -> "SensorReturns":
        """Build from scans (N_i, 3), frame of the poses, m, without returns outside these ranges."""
        scans = scans if rig is None else rig.in_sensors(scans)
        points = np.concatenate(scans)
        ranges_m = np.sqrt(np.einsum("ni,ni->n", points, points))
        number = np.repeat(np.arange(len(scans), dtype=np.int32), [len(scan) for scan in scans])
        kept = ranges_m >= max(min_range_m, _LEAST_RANGE_M)
        kept &= ranges_m <= (np.inf if max_range_m is None else max_range_m)
        directions = points[kept] / ranges_m[kept, None]
        return cls(directions.astype(np.float32), ranges_m[kept].astype(np.float32), number[kept], rig)

    def __len__(self) -> int:
        return len(self.scans)

    @property
    def median_range_m(self) -> float:
        return float(np.median(self.ranges_m))

    def select(self, part: Bools) -> "SensorReturns":
        return SensorReturns(self.directions[part], self.ranges_m[part], self.scans[part], self.rig)

    def every(self, step: int) -> "SensorReturns":
        return self.select(np.arange(len(self)) % step == 0)

    def posed(self, poses: Floats) -> Rays:
        """Convert to rays at poses (F, 4, 4), in a local frame at the mean position."""
        poses = poses if self.rig is None else self.rig.sensor_poses(poses)
        origin = poses[:, :3, 3].mean(axis=0)
        first = np.searchsorted(self.scans, np.arange(len(poses) + 1))
        directions = np.empty_like(self.directions)
        for i, R in enumerate(poses[:, :3, :3].astype(np.float32)):
            rows = slice(first[i], first[i + 1])
            np.einsum("ij,nj->ni", R, self.directions[rows], out=directions[rows])
        positions = (poses[:, :3, 3] - origin).astype(np.float32)
        points = directions * self.ranges_m[:, None] + positions[self.scans]
        up = poses[:, :3, 2].copy()
        radars = (None, 1) if self.rig is None else (self.rig.of_scan, len(self.rig.labels))
        return Rays(origin, points, directions, self.ranges_m, None, self.scans, up, len(self), *radars)


def common_planes(
    returns: SensorReturns,
    poses: Floats,
    window: int,
    cell_m: float,
    noise: SensorNoise | None,
    config: ReturnsConfig,
    num_threads: int = 0,
    *,
    shifted: bool = False,
) -> tuple[CommonPlanes, SensorNoise]:
    """Build the normal equations of poses (F, 4, 4) from common planes, and the noise of the sensor, estimated unless given.

    The planes, in cells of `cell_m`, are those of windows of consecutive scans, which may be shifted by half of one.
    """
    rays = returns.posed(poses)
    planes = np.full(len(rays), -1, np.int32)
    centres, normals, noises = list[Floats](), [], []
    begin = -(window // 2) if shifted and window < len(poses) else 0
    for k in range(begin, len(poses), window):
        low, high = max(0, k), min(len(poses), k + window)
        if high - low < 2:
            continue
        rows = slice(*np.searchsorted(rays.scans, [low, high]).tolist())
        part = rays.select(rows)
        surfels = Surfels.of(part, cell_m / LEAVES_PER_SURFEL, num_threads)
        found = planes_of(part, surfels, num_threads)
        planes[rows] = np.where(found >= 0, found + np.int32(sum(map(len, centres))), np.int32(-1))
        centres.append(surfels.centres)
        normals.append(unbiased_normals(surfels, num_threads))
        if noise is None:
            estimate = sensor_noise if returns.rig is None else rig_noise
            noises.append(estimate(surfels, part, config, num_threads))
    if noise is None:  # of short windows, that of all radars
        noise = noises[0] if len(noises) == 1 else SensorNoise.median(noises)
    of_rays = rays.points, rays.directions, rays.ranges_m, rays.scans, planes
    of_scans = poses[:, :3, 3] - rays.origin, rays.up_of_scan
    of_planes = np.concatenate(centres), np.ascontiguousarray(np.concatenate(normals))
    together = min(window, _TOGETHER), num_threads
    return CommonPlanes(*of_rays, *of_scans, *of_planes, cell_m, noise.of_scans(rays), *together), noise


def planes_of(rays: Rays, surfels: Surfels, num_threads: int, noise: SensorNoise | None = None) -> Ints32:
    """Return the flat surfel (N,) of each return: that of the cell of its projection onto the surface; -1: none.

    With `noise`, the projection is the most probable position, which is independent of the distance from the surface.
    """
    # Noise moves returns across surfaces into other cells. By the cells of the returns themselves, it would be truncated at cell
    # borders, differently for near and far returns, and rotate poses.
    points = rays.points
    planes = surfels.flat_planes_at(points, num_threads)
    on = np.flatnonzero(planes >= 0)
    normals = surfels.normals[planes[on]]
    off = np.einsum("ni,ni->n", points[on] - surfels.centres[planes[on]], normals)
    along = normals if noise is None else errors_with(rays, on, normals, noise)
    feet = np.ascontiguousarray(points[on] - (off[:, None] * along).astype(np.float32))
    beneath = surfels.flat_planes_at(feet, num_threads)
    planes[on] = np.where(beneath >= 0, beneath, planes[on])
    # The faces of a wall may share a cell. As one surface, those of a hall made a lap round them 1 % smaller.
    behind = np.einsum("ni,ni->n", rays.directions[on], surfels.normals[planes[on]]) > 0
    most = np.bincount(planes[on], 2.0 * behind - 1, len(surfels.centres)) > 0
    planes[on[behind != most[planes[on]]]] = -1
    return planes


_CELLS = 4.0, 2.0  # cell edges, coarse to fine, relative to a map's surfels
_ITERATIONS = 8  # maximum at each cell size
_SETTLED = 0.3, 0.03  # tolerances at these, standard deviations: coarse cells only lead to the fine ones
_MOST_RETURNS = 2000  # of a scan
_LEAST_VARIANCE = 1e-12  # of a prior, m² and rad²
_SHIFTS = 0.0, 1.0, -1.0, 2.0, -2.0  # cells, beyond the extent of single objects
# Minimum share of a step's prior variance that the returns must remove if nothing else measures the translation. Below half,
# the prior is more informative. Simulated walls: 0.08 and 0.10; all other scenes, seeds 81 and 82, and real drives: 0.58 to 0.95.
LEAST_OBSERVED = 0.5
_SURE = 0.05  # standard deviation of a translation of the prior that needs no returns, cells


@dataclass
class Tracked:
    """Scan registered with planes, and its place in a tracked drive."""

    pose: Floats  # (4, 4) T_world_sensor, in the frame of its segment
    # (6, 6) of the step to this scan: translation, m, rotation vector, rad, world axes.
    covariance: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    agreeing: float = np.nan  # share of inliers on planes of previous scans. NaN if it starts a segment
    segment: int = 0  # number of its segment of the drive
    # (3,) rotation vector of the step in the previous frame, rad; may exceed half a turn.
    turn: Floats = field(default_factory=lambda: np.zeros(3))
    # Share of the predicted variance that the returns removed, of translation and rotation, in the least certain direction.
    observed: tuple[float, float] = (0.0, 0.0)


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

    def fit(
        self, scan: Floats, mean: Floats, prior: Floats, start: Floats | None = None, *, finely: bool = True
    ) -> Tracked:
        """Fit the pose of a scan (N, 3), sensor frame, m, coarse to fine, given that of the prior and its covariance (6, 6)."""
        information = np.linalg.inv(prior + _LEAST_VARIANCE * np.eye(6))
        pose = mean if start is None else start
        for planes, settled in [*zip((self.coarse, self.fine), _SETTLED, strict=True)][: 1 + finely]:
            for _ in range(_ITERATIONS):
                *equations, inliers = planes.agreement(scan, pose, self.variances)
                hessian, gradient = _discount_tilts(*equations)
                total = hessian + information
                off = gradient + information @ increments(mean, pose)
                step = -lapack.dgesv(total, off)[2]
                pose = moved(pose, step)
                if step @ total @ step < 6 * settled**2:
                    break
        return Tracked(pose, np.linalg.inv(total), inliers / len(scan))

    def discount_chance(self, scan: Floats, prior: Floats, found: Tracked) -> Tracked:
        """Remove the spurious information along the least certain axis that returns have for any shift of the scan."""
        # In a tunnel, returns match the walls everywhere, and some matches constrain the scan by chance: shifted scans have 0.6 to 1.2
        # times the information, those of nine other kinds of scenes 0.02 to 0.19 times.
        prior, covariance = prior + _LEAST_VARIANCE * np.eye(6), found.covariance.copy()
        axis = least_certain(covariance)
        before, left = (float(axis @ each[:3, :3] @ axis) for each in (prior, covariance))
        if before >= (_SURE * _CELLS[-1] * self.cell_size_m) ** 2:
            chance = min(1.0, float(self._chance([scan], found.pose[None], axis).mean()))
            widened = 1 / (1 / before + (1 - chance) * max(1 / left - 1 / before, 0.0)) - left
            covariance[:3, :3] += max(widened, 0.0) * np.outer(axis, axis)
        moved_share = _removed_share(prior[:3, :3], covariance[:3, :3])
        observed = moved_share, _removed_share(prior[3:, 3:], covariance[3:, 3:])
        return replace(found, covariance=covariance, observed=observed)

    def information_by_chance(self, scans: Sequence[Floats], poses: Floats) -> tuple[Floats, float]:
        """Return the axis (3,) along which scans (N_i, 3) at `poses` (F, 4, 4) are least certain, and the share of their
        information there that any shifted scans have, too."""
        axis = np.linalg.eigh(self._information(scans, poses)[:3, :3])[1][:, 0]
        shares = self._chance(scans, poses, axis)
        # Where any shift has more, the mean of four underestimates chance: of steep surfaces alone, .98 left enough to hold the height.
        return axis, 1.0 if shares.max() > 1 else float(shares.mean())

    def _information(self, scans: Sequence[Floats], poses: Floats) -> Floats:
        return np.sum([self.normal_equations(s, p)[0] for s, p in zip(scans, poses, strict=True)], axis=0)

    def _chance(self, scans: Sequence[Floats], poses: Floats, axis: Floats) -> Floats:
        """Return the information along `axis` (3,) of scans at each shift, relative to that at `poses` (F, 4, 4)."""
        information: list[float] = []
        for shift in _SHIFTS:
            shifted = poses.copy()
            shifted[:, :3, 3] += _CELLS[-1] * self.cell_size_m * shift * axis
            hessian = self._information(scans, shifted)
            variance = axis @ np.linalg.pinv(hessian, hermitian=True)[:3, :3] @ axis
            information.append(1 / float(variance) if variance > 0 else 0.0)
        return np.array(information[1:]) / max(information[0], 1e-12)


def least_certain(covariance: Floats) -> Floats:
    """Return the axis (3,) of the least certain translation of a covariance (6, 6)."""
    return np.linalg.eigh(covariance[:3, :3])[1][:, -1]


def _discount_tilts(hessian: Floats, gradient: Floats, doubt: Floats) -> tuple[Floats, Floats]:
    """Return Hessian (6, 6) and gradient (6,) without the contribution (6, 6) of errors of the normals."""
    # Along a wall, slightly tilted normals would seem to observe the position along it.
    if lapack.dpotrf(hessian - doubt)[1] != 0:  # not positive definite
        M = reduction(hessian, doubt)
        return M @ hessian @ M.T, M @ M @ gradient
    return hessian - doubt, gradient - doubt @ lapack.dgesv(hessian, gradient)[2]


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
