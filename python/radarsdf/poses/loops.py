"""Loops: whether returns of revisited places agree, and poses from which an estimate closes a loop."""

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from radarsdf.arrays import Floats, Ints
from radarsdf.poses.agreement import NEIGHBOURS, Gain, density, median_apart_m
from radarsdf.poses.planes import PlaneMap, SensorReturns, apart_m, thin
from radarsdf.poses.rigid import increments, lengths_of_steps_m, moved, rotation
from radarsdf.poses.search import OrientedPoints
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.planes import LEAVES_PER_SURFEL

_MOST_RETURNS = 50_000  # maximum number of returns compared
# In median ranges: edge of a part of the path, distance of two parts at one place, length of the path between them, and of a visit.
_PART, _SAME_PLACE, _AWAY, _LONGEST = 0.5, 0.5, 4.0, 4.0
_SHIFT = 3.0  # standard deviations of the distance between returns of one surface
_ANGLES = np.arange(8) * (np.pi / 4)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(8)], axis=1)  # of shifts
_FEWEST_SCANS = 3  # of a visit that is judged
_ERRORS = 3.0  # minimum agreement, standard errors
# Registration of a later visit with the planes of earlier scans.
_SCANS = 12  # of the visit: single ones match wrong planes
# In median ranges: path before the visit of scans that do not count, path after the earlier visit and distance of scans that do.
_BEFORE, _AFTER, _NEAR = 1.0, 2.0, 3.0
_PASSES = 3  # of Gauss-Newton, coarse to fine
Visit: TypeAlias = tuple[Ints, Ints]  # scans of a later visit of a place, and of earlier ones


def open_loops(returns: SensorReturns, poses: Floats, noise: SensorNoise, first_scan: int = 0) -> list[str]:
    """Return a note for each later visit of a place whose returns agree no better with earlier ones than if they are shifted."""
    revisited = visits(returns.median_range_m, poses)
    returns = returns.every(-(-len(returns) // _MOST_RETURNS))
    points = returns.posed(poses).points.astype(np.float64)
    variances_m2 = noise.mean_variances_m2(returns.ranges_m)
    notes = []
    for later, earlier in revisited:
        rows, known = (np.flatnonzero(np.isin(returns.scans, scans)) for scans in (later, earlier))
        if min(len(rows), len(known)) <= NEIGHBOURS:
            continue
        tree, of_scans = cKDTree(points[known]), returns.scans[known]
        # Between neighbours of one visit: those of two are farther apart where a loop is open.
        distances_m, found = tree.query(points[known], NEIGHBOURS)
        apart_m2 = median_apart_m(distances_m, of_scans[found] != of_scans[:, None]) ** 2
        shift_m = _SHIFT * float(np.sqrt(2 * np.median(variances_m2[rows]) + apart_m2))
        densities = []
        for shift in (np.zeros(3), *(shift_m * _DIRECTIONS)):
            distances_m, found = tree.query(points[rows] + shift, NEIGHBOURS)
            variances = variances_m2[rows, None] + apart_m2 + variances_m2[known][found]
            densities.append(density(distances_m, variances).sum(axis=1))
        here, shifted = densities[0], np.mean(densities[1:], axis=0)
        floor = float(np.median([here, shifted]))
        if floor == 0:  # they see different surfaces
            continue
        agreement = Gain.by_groups(np.log((here + floor) / (shifted + floor)), returns.scans[rows])
        if agreement.count >= _FEWEST_SCANS and agreement.mean < _ERRORS * agreement.error:
            now, then = (f"scans {of[0] + first_scan} to {of[-1] + first_scan}" for of in (later, earlier))
            what = f"their returns agree no better there than {shift_m:.1f} m to the side"
            notes.append(f"A loop is open: {now} seem to be where {then} were, but {what}.")
    return notes


def close_loop(
    returns: SensorReturns, poses: Floats, visit: Visit, prior: Floats, planes: PlaneMap, num_threads: int
) -> Floats | None:
    """Return the poses (F, 4, 4) with a visit registered with earlier scans, and the path to it bent. None if it is there already.

    `prior` (6, 6): covariance of the drift. `planes`: empty, for the earlier scans. The joint estimate from the result closes the loop.
    """
    later, earlier = visit
    path_m, range_m = np.append(0.0, lengths_of_steps_m(poses).cumsum()), returns.median_range_m
    later = np.arange(max(later[-1] - _SCANS + 1, 0), later[-1] + 1)
    own, begin_m = poses[later[len(later) // 2]], path_m[earlier[-1]]
    between_m = path_m[later[0]] - begin_m
    # Scans just before the visit drifted with it.
    before = path_m < min(begin_m + _AFTER * range_m, path_m[later[0]] - _BEFORE * range_m)
    before &= np.linalg.norm(poses[:, :3, 3] - own[:3, 3], axis=1) < _NEAR * range_m
    known, seen = returns.select(before[returns.scans]), returns.select(np.isin(returns.scans, later))
    if min(len(known), len(seen)) == 0 or between_m <= 0:
        return None
    # Surfels, not returns: the noise of few scans makes wrong planes, which attract them.
    leaf_m = planes.cell_size_m / LEAVES_PER_SURFEL
    surfaces = [OrientedPoints.of_returns(part, poses, leaf_m, num_threads).points for part in (known, seen)]
    if min(map(len, surfaces)) == 0:
        return None
    planes.add(surfaces[0])
    scan = thin((surfaces[1] - own[:3, 3]) @ own[:3, :3])
    radius_m = float(np.median(np.linalg.norm(scan, axis=1)))
    pose = own
    for _ in range(_PASSES):
        pose = planes.fit(scan, own, prior, pose).pose
    if apart_m(pose[None], own, radius_m)[0] < planes.cell_size_m:
        return None
    share = np.clip((path_m - begin_m) / between_m, 0, 1)[:, None]
    moved_m, turned = np.split(share * increments(own, pose), 2, axis=1)
    arms_m = poses[:, :3, 3] - own[:3, 3]
    moved_m += np.einsum("fij,fj->fi", rotation(turned), arms_m) - arms_m
    return moved(poses, np.concatenate([moved_m, turned], axis=1))


def visits(range_m: float, poses: Floats) -> Iterator[Visit]:
    """Yield the scans of each later visit of a place, and those of earlier ones, given the median range."""
    path_m = np.append(0.0, lengths_of_steps_m(poses).cumsum())
    _, first, part = np.unique(np.floor(path_m / (_PART * range_m)), return_index=True, return_inverse=True)
    first[-1] = len(poses) - 1  # where a lap meets its start
    pairs = cKDTree(poses[first, :3, 3]).query_pairs(_SAME_PLACE * range_m, output_type="ndarray")
    pairs = pairs[path_m[first[pairs[:, 1]]] - path_m[first[pairs[:, 0]]] > _AWAY * range_m]
    later = np.unique(pairs[:, 1])
    runs = np.split(later, np.flatnonzero(np.diff(later) > 1) + 1) if len(later) else []
    for run in runs:
        for visit in np.array_split(run, max(1, int(len(run) * _PART / _LONGEST))):
            earlier = pairs[np.isin(pairs[:, 1], visit), 0]
            earlier = earlier[path_m[first[earlier]] < path_m[first[visit[0]]] - _AWAY * range_m]
            yield np.flatnonzero(np.isin(part, visit)), np.flatnonzero(np.isin(part, earlier))
