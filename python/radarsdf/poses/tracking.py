"""Tracking without poses: each scan is registered with the planes of the previous ones."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from radarsdf.arrays import Floats
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.motion import PredictedStep
from radarsdf.poses.planes import SensorReturns
from radarsdf.poses.registration import PlaneMap, apart_m, thin
from radarsdf.poses.rigid import covariance_in, rotation, rotation_vector
from radarsdf.returns.noise import sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels

# Local map. With 60 scans, simulated drives were no better, and wrong poses persisted longer. The noise determines a deviation to
# a percent from 10,000 returns; from 5,000, a sparse recorded drive fell into segments.
WINDOW = 25  # scans
_NOISE_AT = 1, 4, 16, 64  # numbers of scans at which the noise of the sensor is re-estimated
_NOISE_RETURNS = 10_000  # of the last scans, for this estimate

# Search, where the prediction is less certain than Gauss-Newton requires. Acceptance by a gain over chance alone, or over rivals alone,
# split three of five recorded drives into more segments.
_SCORED_RETURNS = 250  # of a scan
_BEST = 12  # candidates to register
_UNRELATED = 500  # poses, for the agreement by chance
_ERRORS = 3.0  # standard errors by which more returns agree at an accepted pose
_MOST_RADII = 10.0  # maximum standard deviation of a predicted translation, median ranges: beyond, candidates miss the overlap
_MOST_RECKONED_M = 1e4  # and for a segment to begin at the dead-reckoned pose: over a day, that is useless


@dataclass
class Tracked:
    """Tracked scan."""

    pose: Floats  # (4, 4) T_world_sensor, in the frame of its segment
    covariance: Floats  # (6, 6) of the step to this scan: translation, m, rotation vector, rad, world axes
    agreeing: float  # share of inliers on planes of previous scans, in [0, 1]. NaN if it starts a segment
    segment: int  # number of its segment of the drive
    turn: Floats  # (3,) rotation vector of the step in the previous frame, rad; may exceed half a turn
    # Share of the predicted variance that the returns removed, of translation and rotation, in the least certain direction.
    observed: tuple[float, float] = (0.0, 0.0)


def begin_segment(pose: Floats, segment: int = 0) -> Tracked:
    """Return the first scan of a segment, at this pose (4, 4)."""
    return Tracked(pose, np.zeros((6, 6)), np.nan, segment, np.zeros(3))


@dataclass
class Tracker:
    """Local map of planes of the last scans, and the last pose."""

    cell_size_m: float  # edge of the cell of a map's surfel, m
    config: ReturnsConfig
    num_threads: int = 0
    window: int = WINDOW  # scans in the map
    last: Tracked = field(init=False)
    _planes: PlaneMap = field(init=False)
    # Scans (N, 3), sensor frame, their poses, and the points as added to the planes, for an exact removal.
    _recent: deque[tuple[Floats, Floats, Floats]] = field(default_factory=deque)
    _scans: int = 0

    def register(self, scan: Floats, predicted: PredictedStep | None) -> Tracked:
        """Register a scan (N, 3), sensor frame, m, with the map, near the predicted step. None: the first scan."""
        if predicted is None or not self._scans:
            return begin_segment(np.eye(4))
        scan = thin(scan)
        if len(scan) == 0:
            return self._dead_reckon(predicted)
        radius_m = float(np.median(np.linalg.norm(scan, axis=1)))
        capture_m = self._planes.capture_m
        if predicted.spread_m(radius_m) <= capture_m:
            return self._fit_pose(scan, predicted, predicted.turn.mean)
        spread_m = predicted.spread_m(0.0)
        if spread_m <= _MOST_RADII * radius_m:
            found = self._search_pose(scan, predicted, capture_m, radius_m)
            if found is not None:
                return found
            # Without a clear match, a scan whose position is predicted is no more lost than one without returns.
            if spread_m <= capture_m:
                return self._dead_reckon(predicted)
        # Tracking is lost: the maps before and after cannot be joined.
        begin = self.last.pose @ predicted.pose() if spread_m <= _MOST_RECKONED_M else self.last.pose
        return begin_segment(begin, self.last.segment + 1)

    def add(self, scan: Floats, found: Tracked) -> None:
        """Add a registered scan to the map, without the oldest."""
        if not self._scans or found.segment != self.last.segment:
            self._planes = PlaneMap(self.cell_size_m)
            self._recent.clear()
            self._scans = 0
        points = np.ascontiguousarray(np.einsum("ij,nj->ni", found.pose[:3, :3], scan) + found.pose[:3, 3])
        oldest = self._recent.popleft() if len(self._recent) == self.window else None
        self._planes.add(points)
        if oldest is not None:
            self._planes.add(oldest[2], -1)
        self._recent.append((scan, found.pose, points))
        self.last = found
        self._scans += 1
        if self._scans in _NOISE_AT:
            self._planes.variances = self._estimate_variances()

    def _estimate_variances(self) -> list[float]:
        counts = np.cumsum([len(scan) for scan, *_ in reversed(self._recent)])
        last = list(self._recent)[-max(2, int(np.searchsorted(counts, _NOISE_RETURNS, side="right"))) :]
        scans, poses, _ = zip(*last, strict=True)
        rays = SensorReturns.of(scans, 0.0, None).posed(np.stack(poses))
        surfels = Surfels.of(rays, self.cell_size_m / LEAVES_PER_SURFEL, self.num_threads)
        return sensor_noise(surfels, rays, self.config, self.num_threads).variances

    def _dead_reckon(self, predicted: PredictedStep) -> Tracked:
        pose, turn = self.last.pose @ predicted.pose(), predicted.turn.mean
        covariance = covariance_in(predicted.covariance(), self.last.pose[:3, :3])
        return Tracked(pose, covariance, 0.0, self.last.segment, turn)

    def _fit_pose(
        self, scan: Floats, predicted: PredictedStep, turn: Floats, start: Floats | None = None
    ) -> Tracked:
        """Fit the pose, starting from `start`, with the prior of a sensor that turned by `turn`."""
        last_R, mean = self.last.pose[:3, :3], self.last.pose @ predicted.pose(turn)
        found = self._planes.fit(scan, mean, covariance_in(predicted.covariance(turn), last_R), start)
        turn = rotation_vector(last_R.T @ found.pose[:3, :3], turn)
        return Tracked(found.pose, found.covariance, found.agreeing, self.last.segment, turn, found.observed)

    def _search_pose(
        self, scan: Floats, predicted: PredictedStep, capture_m: float, radius_m: float
    ) -> Tracked | None:
        """Search many poses for the best, if the returns agree there significantly better than elsewhere and than by chance."""
        sample = thin(scan, _SCORED_RETURNS)

        def score(poses: Floats) -> Floats:
            return self._planes.coarse.scores(sample, np.ascontiguousarray(poses), self._planes.variances)

        turns, steps = predicted.candidates(capture_m, radius_m)
        poses = np.einsum("ij,kjl->kil", self.last.pose, steps)
        means = score(poses).mean(axis=1)
        rows = _best(means)
        # In a self-similar scene, the best candidates may all lie near a wrong place.
        elsewhere = np.flatnonzero(apart_m(poses, poses[rows[0]], radius_m) > 2 * capture_m)
        rows = np.concatenate([rows, elsewhere[_best(means[elsewhere])]])
        found = [self._fit_pose(scan, predicted, turns[i], poses[i]) for i in rows]
        at = np.stack([one.pose for one in found])
        scores, by_chance = score(at), score(self._draw_unrelated(radius_m))
        first = int(np.argmax(scores.mean(axis=1)))
        rivals = scores[apart_m(at, at[first], radius_m) > capture_m]
        gains = scores[first] - np.concatenate([by_chance[_best(by_chance.mean(axis=1))], rivals])
        clear = gains.mean(axis=1) > _ERRORS * gains.std(axis=1) / np.sqrt(len(sample))
        return found[first] if clear.all() else None

    def _draw_unrelated(self, reach_m: float) -> Floats:
        """Draw upright poses (_UNRELATED, 4, 4) near those of the last scans, with other headings."""
        rng = np.random.default_rng(0)
        known = np.stack([pose for _, pose, _ in self._recent])
        up = self.last.pose[:3, 2]
        poses = known[rng.integers(0, len(known), _UNRELATED)]
        turns = rotation(rng.uniform(np.pi / 6, 2 * np.pi - np.pi / 6, _UNRELATED)[:, None] * up)
        poses[:, :3, :3] = np.einsum("kij,kjl->kil", turns, poses[:, :3, :3])
        shifts = rng.uniform(-reach_m, reach_m, (_UNRELATED, 3))
        poses[:, :3, 3] += shifts - np.einsum("ki,i->k", shifts, up)[:, None] * up
        return poses


def _best(scores: Floats) -> NDArray[np.intp]:
    return np.argsort(-scores, kind="stable")[:_BEST]
