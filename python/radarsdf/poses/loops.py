"""Test whether returns of revisited places agree."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from radarsdf.arrays import Floats, Ints
from radarsdf.poses.agreement import NEIGHBOURS, Gain, density, median_apart_m
from radarsdf.poses.planes import SensorReturns
from radarsdf.returns.noise import SensorNoise

_MOST_RETURNS = 50_000  # maximum number of returns compared
# In median ranges: edge of a part of the path, distance of two parts at one place, length of the path between them, and of a visit.
_PART, _SAME_PLACE, _AWAY, _LONGEST = 0.5, 0.5, 4.0, 4.0
_SHIFT = 3.0  # standard deviations of the distance between returns of one surface
_ANGLES = np.arange(8) * (np.pi / 4)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(8)], axis=1)  # of shifts
_FEWEST_SCANS = 3  # of a visit that is judged
_ERRORS = 3.0  # minimum agreement, standard errors


def open_loops(returns: SensorReturns, poses: Floats, noise: SensorNoise, first_scan: int = 0) -> list[str]:
    """Return a note for each later visit of a place whose returns agree no better with earlier ones than if they are shifted."""
    visits = list(_visits(poses[:, :3, 3], float(np.median(returns.ranges_m))))
    if not visits:
        return []
    returns = returns.every(-(-len(returns) // _MOST_RETURNS))
    points = returns.posed(poses).points.astype(np.float64)
    variances_m2 = noise.mean_variances_m2(returns.ranges_m)
    notes = []
    for later, earlier in visits:
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


def _visits(positions: Floats, range_m: float) -> Iterator[tuple[Ints, Ints]]:
    """Yield the scans of each later visit of a place and those of earlier ones, from positions (F, 3)."""
    lengths_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(lengths_m)])
    _, first, part = np.unique(np.floor(path_m / (_PART * range_m)), return_index=True, return_inverse=True)
    pairs = cKDTree(positions[first]).query_pairs(_SAME_PLACE * range_m, output_type="ndarray")
    pairs = pairs[path_m[first[pairs[:, 1]]] - path_m[first[pairs[:, 0]]] > _AWAY * range_m]
    later = np.unique(pairs[:, 1])
    runs = np.split(later, np.flatnonzero(np.diff(later) > 1) + 1) if len(later) else []
    for run in runs:
        for visit in np.array_split(run, max(1, int(len(run) * _PART / _LONGEST))):
            earlier = pairs[np.isin(pairs[:, 1], visit), 0]
            earlier = earlier[path_m[first[earlier]] < path_m[first[visit[0]]] - _AWAY * range_m]
            yield np.flatnonzero(np.isin(part, visit)), np.flatnonzero(np.isin(part, earlier))
