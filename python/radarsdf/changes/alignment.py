"""Registration of two maps by their surfaces."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2, qmc

from radarsdf.arrays import Floats, Ints
from radarsdf.changes.probability import PARALLEL, PlacedMap, odds_of_differences, posterior, share_of_changes
from radarsdf.core import LocalPlanes
from radarsdf.map.mesh import across_triangles
from radarsdf.poses.agreement import Verdict
from radarsdf.poses.rigid import moved, rotation_vector, skew
from radarsdf.poses.search import Lost, OrientedPoints, SurfaceIndex, search
from radarsdf.products import transformed, turned
from radarsdf.returns.evidence import CELLS_OF_SURFACE
from radarsdf.threads import resolve_num_threads

# Prior standard deviations of the offset between the frames of two maps: translation, m, and rotation vector, rad.
_PRIOR_SIGMAS = np.array([3.0, 3.0, 0.5, 0.02, 0.02, 0.15])
_ITERATIONS = 15
_MAX_POINTS = 10_000  # sampled on the later surface
_PATCH_M = 4.0  # edge of a patch within which errors are correlated
_SIGNIFICANCE = 1e-3  # significance level
# Largest standard error of a determined axis, in leaf cells: fields reach two cells.
_MAX_SIGMA_CELLS = 0.5
_COINCIDENT_CELLS = 0.25  # surfaces within this distance coincide
_SEARCH_CELLS = 8.0  # edge of the cells of the coarse search, in leaf cells
_SAMPLES = 500  # points of a search
_SEARCH_POSES, _BEST_POSES = 8192, 200  # poses of the coarse search, and the best of them, which are compared
_TIE_SIGMAS = 3.0  # poses within these standard errors agree about equally well


@dataclass(frozen=True)
class Alignment:
    """Pose of one map in the frame of another."""

    T_before_after: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4) m
    covariance: Floats = field(default_factory=lambda: np.zeros((6, 6)))  # of offsets about the `centre`
    centre: Floats = field(default_factory=lambda: np.zeros(3))  # (3,) world of the earlier map, m
    words: str = "The maps were taken as they are."  # the verdict in one sentence

    def sigma_m(self, x: Floats, normals: Floats) -> Floats:
        """(N,) standard error of the alignment at places (N, 3) along their normals (N, 3), m."""
        rows = _jacobian(x - self.centre, np.nan_to_num(normals))
        return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", rows, self.covariance, rows), 0))


def align(before: PlacedMap, after: PlacedMap) -> Alignment:
    """Register the later map to the surface of the earlier one, if the offset between them is significant.

    The test is on the offset over its standard errors: along a surface, it brings the surfaces no nearer, however large it is.
    """
    if min(len(before.faces), len(after.faces)) < CELLS_OF_SURFACE:
        return Alignment()
    surface = _Surface.of(after)

    def far(pose: Floats) -> Floats:
        """(N,) logarithms of the distances between the surfaces, about equal where the surfaces coincide."""
        near_m, _, distance_m = before.nearest(transformed(surface.points, pose))
        distance_m = np.where(near_m <= before.reach_m, distance_m, near_m)
        return np.log(np.hypot(distance_m, _COINCIDENT_CELLS * before.leaf_m))

    def nearer(first: Floats, second: Floats) -> bool:
        return Verdict.by_groups(far(first) - far(second), surface.patches).improved

    own, T_near, assumed = surface, np.eye(4), ""
    found = _constrained_pose(before, surface, np.eye(4))
    searched = _constrained_pose(before, surface, _coarse_pose(before, surface))
    if nearer(found[0], searched[0]):
        found = searched
    try:
        place = _place(before, after)
    except Lost as lost:
        assumed = f" Assumed: the offset is small; {lost}." if len(lost.places) > 1 else ""
    else:
        points, normals = transformed(surface.points, place), turned(surface.normals, place[:3, :3])
        near = replace(surface, points=points, normals=normals, centre=points.mean(axis=0))
        searched = _constrained_pose(before, near, np.eye(4))
        if nearer(found[0], searched[0] @ place):
            found, own, T_near = searched, near, place
    pose, covariance, undetermined = found
    offset, pose = own.offset(pose), pose @ T_near
    sigmas = np.sqrt(np.einsum("i,ij,j->", offset, np.linalg.inv(covariance), offset))
    by_chance = np.sqrt(chi2.isf(_SIGNIFICANCE, len(offset)))
    if (own is surface and sigmas <= by_chance) or far(pose).mean() >= far(np.eye(4)).mean():
        words = "The frames were taken as they are: surfaces do not show an offset between them."
        return Alignment(covariance=covariance, centre=own.centre, words=words + assumed)
    moved_m = np.sqrt(((transformed(surface.points, pose) - surface.points) ** 2).sum(1).mean())
    how = f"{sigmas:.1f} standard errors" if own is surface else "to the only place where it fits"
    words = (
        f"The later map was moved by {moved_m:.3f} m, {how}; "
        f"surfaces do not determine {undetermined} of 6 axes, along which its pose was kept."
    )
    return Alignment(pose, covariance, own.centre + offset[:3], words + assumed)


@dataclass(frozen=True)
class _Surface:
    """Points of the later surface, in its original frame."""

    points: Floats  # (N, 3) m
    normals: Floats  # (N, 3)
    sigma_m: Floats  # (N,) standard errors, m
    patches: Ints  # (N,) index of each point's patch
    centre: Floats  # (3,) m
    radius_m: float  # root mean square distance of the points from the centre

    @classmethod
    def of(cls, placed: PlacedMap) -> "_Surface":
        """Sample points on triangles: vertices lie on the lattice of cells, and would align with that of the other map."""
        rng = np.random.default_rng(0)
        _, areas = across_triangles(placed.vertices, placed.faces)
        chosen = rng.choice(len(areas), min(len(areas), _MAX_POINTS), p=areas / areas.sum())
        corners, shares = placed.faces[chosen], rng.dirichlet(np.ones(3), len(chosen))
        points = np.einsum("nk,nki->ni", shares, placed.vertices[corners])
        normals = np.einsum("nk,nki->ni", shares, placed.normals[corners])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
        sigma_m = np.einsum("nk,nk->n", shares, placed.sigma_m[corners])
        patches = np.unique(np.floor(points / _PATCH_M), axis=0, return_inverse=True)[1].ravel()
        centre = points.mean(axis=0)
        radius_m = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()))
        return cls(points, normals, sigma_m, patches, centre, radius_m)

    def offset(self, pose: Floats) -> Floats:
        """(6,) translation of the centre, m, and rotation vector, rad, of a pose (4, 4)."""
        shift = np.einsum("ij,j->i", pose[:3, :3], self.centre) + pose[:3, 3] - self.centre
        return np.concatenate([shift, rotation_vector(pose[:3, :3])])

    def pose(self, offset: Floats) -> Floats:
        """Inverse of :meth:`offset`."""
        found: Floats = moved(np.eye(4)[None], offset[None])[0]
        found[:3, 3] += self.centre - np.einsum("ij,j->i", found[:3, :3], self.centre)
        return found


def _place(before: PlacedMap, after: PlacedMap) -> Floats:
    """Search the whole earlier surface for the later one, if its frame is another; no prior limits the offset."""
    earlier, later = (
        OrientedPoints(placed.vertices, placed.normals, float(np.nanmedian(placed.sigma_m)))
        for placed in (before, after)
    )
    index = SurfaceIndex.of_surface(earlier, earlier.centre, before.leaf_m)
    return search(index, later, resolve_num_threads(before.radar_map.config.num_threads))


def _coarse_pose(before: PlacedMap, surface: _Surface) -> Floats:
    """Search coarsely; of the poses that fit the earlier surface about equally well, return the one nearest to the identity."""
    planes = LocalPlanes(_SEARCH_CELLS * before.leaf_m)
    planes.add(np.ascontiguousarray(before.vertices - surface.centre))
    points = np.ascontiguousarray((surface.points - surface.centre)[:: -(-len(surface.points) // _SAMPLES)])
    # A quasi-random sequence leaves smaller gaps than random numbers (Sobol 1967).
    offsets = qmc.MultivariateNormalQMC(np.zeros(6), seed=0).random(_SEARCH_POSES) * _PRIOR_SIGMAS
    poses = moved(np.tile(np.eye(4), (_SEARCH_POSES, 1, 1)), offsets)
    width_m = 0.25 * _SEARCH_CELLS * before.leaf_m
    scores = planes.scores(points, poses, [width_m**2, *[(width_m / surface.radius_m) ** 2] * 2])
    best = np.argsort(-scores.mean(axis=1))[:_BEST_POSES]
    losses = scores[best[0]] - scores[best]
    alike = offsets[best[losses.mean(axis=1) <= _TIE_SIGMAS * losses.std(axis=1) / np.sqrt(len(points))]]
    return surface.pose(alike[((alike / _PRIOR_SIGMAS) ** 2).sum(axis=1).argmin()])


def _constrained_pose(before: PlacedMap, surface: _Surface, start: Floats) -> tuple[Floats, Floats, int]:
    """The pose that fits the surfaces, its covariance, and the number of undetermined axes, along which the pose is kept."""
    pose, covariance = _gauss_newton(before, surface, start)
    lever_m = np.repeat([1.0, surface.radius_m], 3)
    variances, axes = np.linalg.eigh(covariance * np.outer(lever_m, lever_m))
    most = (_MAX_SIGMA_CELLS * before.leaf_m) ** 2
    unsure = axes[:, variances > most]
    offset = surface.offset(pose) * lever_m
    offset -= np.einsum("ik,jk,j->i", unsure, unsure, offset)
    # Larger variances would turn errors of the normals into errors of all surfaces.
    covariance = np.einsum("ik,k,jk->ij", axes, np.minimum(variances, most), axes)
    return surface.pose(offset / lever_m), covariance / np.outer(lever_m, lever_m), unsure.shape[1]


def _gauss_newton(before: PlacedMap, surface: _Surface, pose: Floats) -> tuple[Floats, Floats]:
    """Fit the pose by Gauss-Newton, with its covariance. Weights are probabilities that points did not change."""
    # Errors of the normals of the two maps are independent, so products of normals from both show which axes the
    # surfaces determine (instrumental variables). Errors are correlated within a patch, so the scatter of its sums
    # is the covariance of the equations (Hansen 1982).
    prior = np.diag(_PRIOR_SIGMAS**-2.0)
    covariance = np.linalg.inv(prior)
    for _ in range(_ITERATIONS):
        there, own = transformed(surface.points, pose), turned(surface.normals, pose[:3, :3])
        offset = surface.offset(pose)
        near_m, rows, distance_m = before.nearest(there)
        normals = before.normals[rows]
        sigma_m = np.hypot(surface.sigma_m, before.sigma_m[rows])
        known = (near_m <= before.reach_m) & np.isfinite(sigma_m)
        known &= np.einsum("ni,ni->n", normals, own) >= PARALLEL
        if known.sum() < CELLS_OF_SURFACE:
            break
        distance_m, sigma_m, patches = distance_m[known], sigma_m[known], surface.patches[known]
        arms = there[known] - surface.centre - offset[:3]
        odds = odds_of_differences(distance_m, sigma_m, before.reach_m)
        weights = (1 - posterior(odds, share_of_changes(odds))) / sigma_m**2
        of_target, of_own = _jacobian(arms, normals[known]), _jacobian(arms, own[known])
        slope = np.einsum("ni,n,nj->ij", of_own, weights, of_target)
        parts = np.stack([np.bincount(patches, column * weights * distance_m) for column in of_own.T])
        scatter = np.einsum("ip,jp->ij", parts, parts)
        scatter += CELLS_OF_SURFACE * np.einsum("ni,n,nj->ij", of_own, weights, of_own) + np.eye(6)
        weighted = np.linalg.solve(scatter, slope).T
        covariance = np.linalg.inv(np.einsum("ij,jk->ik", weighted, slope) + prior)
        gradient = np.einsum("ij,j->i", weighted, parts.sum(axis=1)) + np.einsum("ij,j->i", prior, offset)
        step = -np.einsum("ij,j->i", covariance, gradient)
        pose = surface.pose(offset + step)
        if np.einsum("i,i->", step, -gradient) < 0.01:
            break
    return pose, np.asarray(covariance, np.float64)


def _jacobian(from_centre: Floats, normals: Floats) -> Floats:
    """(N, 6) derivatives of positions along their normals by a translation, and by a rotation about a centre."""
    turns = np.einsum("ni,nij->nj", normals, -skew(from_centre))
    return np.concatenate([normals, turns], axis=1)
