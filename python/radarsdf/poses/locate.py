"""Localisation of scans in a map made before."""

import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from radarsdf.arrays import Array, ArrayLike, Floats, Ints
from radarsdf.checks import check_pose, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.map.map import Map
from radarsdf.poses.agreement import Gain
from radarsdf.poses.checked_scans import checked_settings
from radarsdf.poses.motion import MotionRate, PredictedStep
from radarsdf.poses.odometry import check_observed, track_scans
from radarsdf.poses.planes import PlaneMap, SensorReturns, Tracked, least_certain, plane_cell_m, thin
from radarsdf.poses.refine import WEAK, JointEstimator
from radarsdf.poses.rigid import between, covariance_in, increments, skew, transform
from radarsdf.poses.search import SUBMAP_SCANS, Lost, SurfaceIndex, search_near, search_scans
from radarsdf.poses.tracking import Drive
from radarsdf.returns.noise import SensorNoise, sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.rig import Imu
from radarsdf.scans import Scans
from radarsdf.threads import resolve_num_threads

# Cells of planes for the last estimate: larger ones bend poles and corners, 4 to 17 cm, not 1 to 6.
_FINE_CELLS = 0.5
_FEWEST = 6  # scans to search
# Least agreement of a part of the drive that is where it seems, relative to that found first. Of a part after a jump of 20 m, fitted to
# other surfaces: 0.64; of others 0.8 to 1.
_LEAST_AGREEING = 0.75
_STILL = np.zeros(3)
# Jump of a radar that is moved, with standard deviations of 2 m and 0.3 rad.
_MOVED = PredictedStep(MotionRate(_STILL, np.diag([0, 0, 0.09])), _STILL, _STILL, np.diag([4.0, 4, 0]), 1.0)
_NEAR, _COMPARED = 30, 500  # scans before and after a few that are compared elsewhere, and returns of a scan
_BY_CHANCE = 1e-3  # significance level of a jump
_SHARING = 3.0  # edge of the cells in which returns share errors of the map, surfel cells
_PLACE_RAD = 0.1  # standard deviation of the rotation of a place that was found
_HEIGHT_M = 2.0  # of its height, m: the search compares only the best height of each place
_GUESS_SIGMAS = np.repeat([0.5, 0.05], 3)  # standard deviations of a guess, m and rad

# A scan, its pose (4, 4) as found, and standard deviations (6,) of that.
_Near: TypeAlias = tuple[int, Floats, Floats]


@dataclass(frozen=True)
class Localisation:
    """Poses of scans in the world of a map."""

    poses: Floats
    """(F, 4, 4) T_map_sensor, m; of a rig, T_map_body. NaN where the scan is lost."""
    covariance: Floats
    """(F, 6, 6) as in :class:`RefinedPoses`, but in the world of the map. NaN where the scan is lost."""
    explained: Floats
    """(F,) share of the returns of each scan on surfaces of the map, in [0, 1]. NaN where it is lost."""
    segments: Ints
    """(F,) segment of the drive of each scan, each found by itself; -1 where it is lost."""
    report: dict[str, Any]
    """`verdict` in words; `found`, number of scans; `lost`, a sentence for each segment that was not found; `notes`; `seconds`."""


def locate(
    radar_map: Map | SurfaceIndex,
    points: Iterable[ArrayLike] | Scans,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    times_s: ArrayLike | None = None,
    imu: Imu | None = None,
    guess: ArrayLike | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
) -> Localisation:
    """Localise scans in a map made before (global localisation, relocalisation).

    Tracks the scans as :func:`odometry` does, searches the whole map for a submap of the first of them, and estimates all poses
    jointly from the surfaces of the map, those that scans share, and the measured motion. Where tracking is lost, as of a
    kidnapped robot, the scans from there on are searched anew.

    Parameters
    ----------
    radar_map : Map or SurfaceIndex
        Of this or another radar. Its z axis must be about vertical. The index of a large map, ``radarsdf.SurfaceIndex.of(map)``,
        serves any number of calls, and can be saved.
    points : iterable of F arrays, or Scans
        (N_i, 3) each, with `doppler_mps`, `times_s` and `imu` as in :func:`odometry`.
    guess : (4, 4) array_like, optional
        T_map_sensor of the first scan, to about 0.5 m and 3 degrees, instead of a search for it. It is tested against the other
        places of the map. Where the returns cannot tell, a note says so, and the covariances are at least that of the guess.
    config : FitConfig, optional
        Settings, of which ranges, leaf cells and threads are used.
    progress : bool, optional
        Whether to show a progress bar. Default: only on a terminal.

    Returns
    -------
    Localisation
        Poses in the world of the map.

    Raises
    ------
    Lost
        If no scan is found: the scans agree with the map nowhere, in several places, or clearly better elsewhere than at the
        guess. These are its `places`. A ValueError.
    TypeError, ValueError
        As :func:`odometry`, and if the map has no surface.

    Notes
    -----
    A place is accepted if the objects in a submap of several scans agree with the map there, at odds of 1000 to 1 to each other
    place and to chance. Along a tunnel or between equal buildings, no such place exists.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.hugin(frames=24)
    >>> radar_map = radarsdf.fit(scans.points, scans.poses, config=radarsdf.FitConfig.quick())
    >>> motion = radarsdf.simulate.measured_motion(scans)
    >>> found = radarsdf.locate(radar_map, scans.points, doppler_mps=motion.doppler_mps, times_s=motion.times_s)
    >>> bool(abs(found.poses - scans.poses).max() < 0.1)
    True
    """
    begin = time.perf_counter()
    index = radar_map
    if not isinstance(index, SurfaceIndex):
        index = SurfaceIndex.of(instance(index, Map, "radar_map"))  # type: ignore[type-abstract]
    config = checked_settings(config)
    start = None if guess is None else check_pose(guess, "guess")
    drive, tracked, _, checked = track_scans(points, doppler_mps, times_s, imu, config, progress)
    checked.notes.extend(check_observed(tracked, drive, checked.notes, turns=False))  # the map shows turns
    count = len(tracked)
    poses, covariance = np.full((count, 4, 4), np.nan), np.full((count, 6, 6), np.nan)
    explained, segments = np.full(count, np.nan), np.full(count, -1)
    why: list[Lost] = []
    localiser = _Localiser(index, drive, tracked, config, checked.notes)
    followed = np.array([found.segment for found in tracked])
    parts = [np.flatnonzero(followed == segment) for segment in range(followed[-1] + 1)]
    while parts:
        part = parts.pop(0)
        try:
            rows, jumps, *found = localiser.locate(part, start if part[0] == 0 else None)
        except Lost as refused:
            why.append(refused)
            continue
        if not jumps:
            poses[rows], covariance[rows], explained[rows] = found
            segments[rows] = segments.max() + 1
            # The others do not agree there: the radar may have been moved, or left the map.
        others = np.split(part, jumps) if jumps else [part[part < rows[0]], part[part > rows[-1]]]
        parts = [*(rest for rest in others if len(rest) >= _FEWEST), *parts]
    if segments.max() < 0:
        raise why[0]
    localiser.lose_moved(poses, segments)
    for of_scans in (poses, covariance, explained):
        of_scans[segments < 0] = np.nan
    poses[:, :3, 3] += index.origin
    report = {
        "verdict": _summarize(segments, explained),
        "found": int((segments >= 0).sum()),
        "lost": [str(each) for each in why],
        "notes": checked.notes,
        "seconds": time.perf_counter() - begin,
    }
    return Localisation(poses, covariance, explained, segments, report)


def _summarize(segments: Ints, explained: Floats) -> str:
    found = segments >= 0
    words = f"{found.sum()} of {len(found)} scans were found, the map explains {np.nanmedian(explained):.0%} of a scan's returns."
    if found.all():
        return words
    gone = np.flatnonzero(~found)
    runs = np.split(gone, np.flatnonzero(np.diff(gone) > 1) + 1)
    return f"{words} Lost: scans {', '.join(f'{run[0]} to {run[-1]}' for run in runs)}."


@dataclass(frozen=True)
class _Localiser:
    """Finds the segments of a tracked drive in a map."""

    index: SurfaceIndex
    drive: Drive
    tracked: list[Tracked]
    config: FitConfig
    notes: list[str]
    noises: list[SensorNoise] = field(default_factory=list)  # of each segment

    def locate(self, part: Ints, guess: Floats | None) -> tuple[Ints, list[int], Floats, Floats, Floats]:
        """Return those of the scans `part` (K,) that are found together, where to split it, poses, covariances and explained shares."""
        rows, own = part, np.stack([self.tracked[i].pose for i in part])
        rig = None if self.drive.rig is None else self.drive.rig.select(rows)
        limits, scans = self.config.returns, [self.drive.scans[i] for i in rows]
        returns = SensorReturns.of(scans, limits.min_range_m, limits.max_range_m, rig)
        if len(returns) == 0:
            msg = "the scans have no returns"
            raise Lost(msg)
        poses, submap, first, undecided = self._place(returns, own, guess)
        thinned = every = [thin(scan) for scan in scans]
        reach_m = float(np.percentile(returns.ranges_m, 99))
        planes = self.index.near(poses[:, :3, 3], 1.5 * reach_m)
        rays = returns.posed(poses)
        surfels = Surfels.of(rays, self.index.cell_m / LEAVES_PER_SURFEL, self.config.num_threads)
        noise = sensor_noise(surfels, rays, limits, self.config.num_threads)
        planes.variances = noise.variances
        self.noises.append(noise)
        poses, kept = self._follow(planes, thinned, poses, rows, submap)
        rows, poses, thinned = rows[kept], poses[kept], thinned[kept]
        scans, rig = scans[kept], None if rig is None else rig.select(kept)
        # The horizontal place is known to the capture range of the planes: nothing is alike farther away.
        row = min(max((submap.start + submap.stop) // 2 - kept.start, 0), len(rows) - 1)
        near = row, poses[row], np.array([planes.capture_m] * 2 + [_HEIGHT_M] + [_PLACE_RAD] * 3)
        if first is not None and kept.start == 0:
            near = 0, first, _GUESS_SIGMAS
        anchor = self._anchor(noise, thinned, poses, 1.5 * reach_m, near)
        if len(rows) < 2:
            information = anchor(poses)[0] + WEAK * np.eye(6)
            covariance = np.linalg.inv(information).astype(np.float64)
        else:
            turns = np.stack([self.tracked[i].turn for i in rows[1:]])
            motions = self.drive.motions(poses, turns, slice(rows[0], rows[-1] + 1))
            returns = SensorReturns.of(scans, limits.min_range_m, limits.max_range_m, rig)
            cell_m = plane_cell_m(scans, self.config.leaf_size_m)
            estimator = JointEstimator(returns, motions, cell_m, self.config)
            found = estimator.estimate(poses, anchor=anchor)
            poses, covariance = found.poses, found.covariance
        jumps, doubt = self._jumps(planes, every, poses, kept, own)
        covariance = covariance + doubt[kept]
        if undecided:  # poses are as uncertain as the guess of the first one
            J = np.tile(np.eye(6), (len(poses), 1, 1))
            J[:, :3, 3:] = -skew(poses[:, :3, 3] - poses[0, :3, 3])
            covariance = covariance + np.einsum("fij,j,fkj->fik", J, _GUESS_SIGMAS**2, J)
        explained = anchor.agreeing(poses) / [max(len(scan), 1) for scan in thinned]
        return rows, jumps, poses, covariance, explained

    def _place(
        self, returns: SensorReturns, poses: Floats, guess: Floats | None
    ) -> tuple[Floats, slice, Floats | None, bool]:
        """Move poses (K, 4, 4) to their place in the map, relative to the origin of the index.

        Also returns the scans that were found there, the guess if the place agrees with it, and whether only the guess tells the place.
        """
        origin, note, first = transform(np.zeros(3), -self.index.origin), "", None
        if guess is None:
            T_map_own, submap = search_scans(self.index, returns, poses, self.config.num_threads)
        else:
            T_map_own, submap = guess @ np.linalg.inv(poses[0]), slice(0, 1)
            T_map_own, note = search_near(self.index, returns, poses, T_map_own, self.config.num_threads)
            self.notes.extend([note] if note else [])
            if (np.abs(increments(guess, T_map_own @ poses[0])) < 3 * _GUESS_SIGMAS).all():
                first = origin @ guess
        return origin @ T_map_own @ poses, submap, first, bool(note)

    def _follow(
        self, planes: PlaneMap, scans: list[Floats], poses: Floats, rows: Ints, submap: slice
    ) -> tuple[Floats, slice]:
        """Correct the drift of poses (K, 4, 4) by registering parts of the drive with the planes, from the submap outwards.

        Also returns the scans that agree with the planes as those of the submap do.
        """
        # Parts of several scans: single sparse ones follow wrong planes, and the next ones follow them.
        found, parts = poses.copy(), np.array_split(np.arange(len(poses)), max(len(poses) // SUBMAP_SCANS, 1))
        middle = next(i for i, part in enumerate(parts) if part[-1] >= (submap.start + submap.stop) // 2)
        radius_m = float(np.median(np.linalg.norm(np.concatenate(scans), axis=1)))
        wide = np.diag(np.repeat([planes.capture_m / 2, planes.capture_m / 2 / radius_m], 3) ** 2)
        ends, needed = [0, 0], 0.0
        for k, order in enumerate((parts[middle:], parts[: middle + 1][::-1])):
            correction, prior = np.eye(4), wide
            for part in order:
                own = poses[part[len(part) // 2]]
                back = np.linalg.inv(own)
                points, mean = thin(_posed([scans[i] for i in part], back @ poses[part])), correction @ own
                registered = planes.discount_chance(points, prior, planes.fit(points, mean, prior))
                # Along the least certain axis, a step by chance is discounted as its information is.
                axis, pose = least_certain(registered.covariance), registered.pose.copy()
                pose[:3, 3] -= (1 - registered.observed[0]) * (axis @ (pose - mean)[:3, 3]) * axis
                both = np.stack([mean, pose])
                agreeing = planes.fine.scores(points, both, planes.variances).mean(axis=1).tolist()
                pose = pose if agreeing[1] >= agreeing[0] else mean
                needed = needed or _LEAST_AGREEING * max(agreeing)
                if max(agreeing) < needed:
                    break
                correction, ends[k] = pose @ back, int(part[0 if k else -1])
                found[part] = np.einsum("ij,fjk->fik", correction, poses[part])
                drift = np.sum([self.tracked[rows[i]].covariance for i in part], axis=0)
                prior = registered.covariance + covariance_in(drift, pose[:3, :3])
        return found, slice(ends[1], ends[0] + 1)

    def _jumps(
        self, planes: PlaneMap, scans: list[Floats], poses: Floats, kept: slice, own: Floats
    ) -> tuple[list[int], Floats]:
        """Test whether successive ones of K scans, tracked at `own` (K, 4, 4), agree better elsewhere: whether the radar was moved.

        `poses` are those of the scans `kept`. Returns where to split, and covariances (K, 6, 6) due to a doubtful jump.
        """
        count, half, capture_m = len(own), SUBMAP_SCANS // 2, planes.capture_m
        nearest = np.clip(np.arange(count), kept.start, kept.stop - 1)
        poses = poses[nearest - kept.start] @ between(own[nearest], own)
        scans = [thin(scan, _COMPARED) for scan in scans]
        numbers = np.repeat(np.arange(count), [len(scan) for scan in scans])
        returns = _posed(scans, poses)
        shown = self.index.outlines(returns, capture_m)  # outside of the map, they tell nothing
        radius_m = float(np.median(np.linalg.norm(np.concatenate(scans), axis=1)))
        moves = _MOVED.candidates(capture_m, radius_m)[1]
        prior = np.diag(np.repeat([capture_m, capture_m / radius_m], 3) ** 2)
        scores, begins = _scores(planes, scans, poses), range(0, count, half)
        most, first, last, gains, others = 0.0, 0, 0, np.zeros(len(numbers)), poses
        for begin in begins:
            middle = min(begin + half // 2, count - 1)
            window, near = slice(begin, begin + half), slice(max(begin - _NEAR, 0), begin + _NEAR)
            points = thin(_posed(scans[window], np.linalg.inv(poses[middle]) @ poses[window]))
            if len(points) == 0:
                continue
            tried, there = np.ascontiguousarray(poses[middle] @ moves), poses.copy()
            agreeing = planes.coarse.scores(thin(points, _COMPARED), tried, planes.variances).mean(axis=1)
            other = planes.fit(points, tried[agreeing.argmax()], prior).pose
            there[near] = other @ between(own[[middle]], own[near])
            low, high = np.searchsorted(numbers, [near.start, near.stop])
            gained = np.zeros(len(numbers))
            gained[low:high] = _scores(planes, scans[near], there[near]) - scores[low:high]
            gained *= shown
            total, *run = _largest_sum(np.bincount(numbers, gained, count))
            if total > most:
                most, (first, last), gains, others = total, run, gained, there

        def clear(begin: int, end: int, gains: Floats, tests: float = 1.0) -> bool:
            of = shown & (numbers >= begin) & (numbers < end)
            return bool(of.any() and self._gain(gains[of], returns[of]).excess(_BY_CHANCE / tests) > 1)

        tests = len(begins) * count * (count + 1) / 2
        off = np.zeros((count, 6))
        off[first:last] = clear(first, last, gains) * increments(poses[first:last], others[first:last])
        sides = ((first, 0, first), (last, last, count)) if clear(first, last, gains, tests) else ()
        jumps = [k for k, one, end in sides if 0 < k < count and clear(one, end, -gains, tests)]
        return jumps, np.einsum("fi,fj->fij", off, off)

    def lose_moved(self, poses: Floats, segments: Ints) -> None:
        """Set segments to -1 of scans next to a jump that agree better with the map as tracked from its other side."""
        reach_m = 1.5 * float(np.percentile(np.linalg.norm(np.concatenate(self.drive.scans), axis=1), 99))
        pairs = [*itertools.pairwise(np.flatnonzero(segments >= 0))]
        for end, other in [*pairs, *(pair[::-1] for pair in pairs)]:
            if segments[end] == segments[other] or self.tracked[end].segment != self.tracked[other].segment:
                continue
            own = np.flatnonzero(segments == segments[end])
            rows = own[np.argsort(abs(own - end))][:SUBMAP_SCANS]  # nearest to the jump first
            scans, tracked = ([of[i] for i in rows] for of in (self.drive.scans, self.tracked))
            T_map_own = poses[other] @ np.linalg.inv(self.tracked[other].pose)
            there = T_map_own @ np.stack([found.pose for found in tracked])
            planes = self.index.near(poses[rows, :3, 3], reach_m)
            planes.variances = self.noises[-1].variances
            gains = _scores(planes, scans, there) - _scores(planes, scans, poses[rows])
            ends = np.cumsum([len(scan) for scan in scans])
            last = int(np.cumsum(gains)[ends - 1].argmax())
            returns = _posed(scans, poses[rows])[: ends[last]]
            if self._gain(gains[: len(returns)], returns).excess(_BY_CHANCE / len(rows)) > 1:
                segments[rows[: last + 1]] = -1

    def _gain(self, gains: Floats, returns: Floats) -> Gain:
        """Return the mean of gains (N,) of returns (N, 3). In one cell, these share the errors of the map."""
        cells = np.floor(returns / (_SHARING * self.index.cell_m))
        return Gain.by_groups(gains, np.unique(cells, axis=0, return_inverse=True)[1].ravel())

    def _anchor(
        self, noise: SensorNoise, scans: list[Floats], poses: Floats, reach_m: float, near: _Near
    ) -> "_Anchor":
        """Build the anchor of scans (N_i, 3) at about these poses (K, 4, 4), with ranges up to `reach_m`."""
        planes = self.index.near(poses[:, :3, 3], reach_m, _FINE_CELLS)
        planes.variances = noise.variances
        facing, cells, workers = [], [], resolve_num_threads(self.config.num_threads)
        for scan, pose in zip(scans, poses, strict=True):
            rays = np.einsum("ij,nj->ni", pose[:3, :3], scan)
            # Thin walls and trunks have two sides, of which the map may show the other one.
            _, nearest = self.index.tree.query(rays + pose[:3, 3], workers=workers)
            seen = np.einsum("ni,ni->n", rays, self.index.surface.normals[nearest]) < 0
            facing.append(np.ascontiguousarray(scan[seen]))
            cells.append(np.floor((rays[seen] + pose[:3, 3]) / (_SHARING * self.index.cell_m)))
        number = sum(map(len, facing))
        alike = number / max(len(np.unique(np.concatenate(cells), axis=0)), 1)
        ranges_m = np.linalg.norm(np.concatenate(facing), axis=1).astype(np.float32)
        variance_m2 = float(noise.mean_variances_m2(ranges_m).mean()) if number else 1.0
        weight = 1 / (1 + alike * self.index.surface.thickness_m**2 / variance_m2)
        axis, chance = planes.information_by_chance(facing, poses)
        kept = np.eye(6)
        kept[:3, :3] -= (1 - np.sqrt(1 - chance)) * np.outer(axis, axis)
        return _Anchor(planes, facing, np.sqrt(weight) * kept, near)


@dataclass(frozen=True)
class _Anchor:
    """Planes of a map, with which all scans agree, and the place that was found or guessed."""

    planes: PlaneMap
    scans: list[Floats]  # (N_i, 3) returns on visible sides of surfaces, sensor frame, m
    # (6, 6) square root of the share of information that is kept: returns share the errors of the map, and agree by chance.
    kept: Floats
    near: _Near

    def __call__(self, poses: Floats) -> tuple[Floats, Floats]:
        parts = [self.planes.normal_equations(s, p) for s, p in zip(self.scans, poses, strict=True)]
        hessians, gradients = (np.stack(each) for each in list(zip(*parts, strict=True))[:2])
        hessians = self.kept @ hessians @ self.kept
        gradients = gradients @ (self.kept @ self.kept)
        row, pose, sigmas = self.near
        hessians[row] += np.diag(sigmas**-2.0)
        gradients[row] += sigmas**-2.0 * increments(pose, poses[row])
        return hessians, gradients

    def agreeing(self, poses: Floats) -> Floats:
        """Return the number (F,) of returns of each scan that agree with the planes."""
        each = zip(self.scans, poses, strict=True)
        return np.array([self.planes.normal_equations(scan, pose)[2] for scan, pose in each])


def _posed(scans: Sequence[Floats], poses: Floats) -> Floats:
    """Return the returns (N, 3) of scans (N_i, 3) at poses (F, 4, 4)."""
    return np.concatenate([scan @ T[:3, :3].T + T[:3, 3] for scan, T in zip(scans, poses, strict=True)])


def _scores(planes: PlaneMap, scans: Sequence[Floats], poses: Floats) -> Floats:
    """Return the agreement (N,) of the returns of scans (N_i, 3) at poses (F, 4, 4), in [0, 1]."""
    each = zip(scans, poses[:, None], strict=True)
    return np.concatenate([planes.fine.scores(scan, T, planes.variances)[0] for scan, T in each])


def _largest_sum(values: Array) -> tuple[float, int, int]:
    """Return the largest sum of successive values (K,), the first of them, and the end."""
    sums = np.append(0.0, np.cumsum(values))
    rises = sums - np.minimum.accumulate(sums)
    end = int(rises.argmax())
    return float(rises[end]), int(sums[: end + 1].argmin()), end
