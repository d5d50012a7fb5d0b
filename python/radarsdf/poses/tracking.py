# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Tracking: each scan is fitted to the planes of those before it."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf._core import LocalPlanes
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.motion import ExpectedStep
from radarsdf.poses.planes import SensorReturns
from radarsdf.poses.rigid import Floats, moved, rotation_vector
from radarsdf.returns.noise import SensorNoise, sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels

WINDOW = 25
"""Scans whose planes are kept. With 60, nothing was better on simulated drives, and wrong poses were remembered longer."""
_CELLS = (4.0, 2.0)  # edges of cells, in those of a map's surfels
_ITERATIONS, _SETTLED = 8, 0.03  # of Gauss and Newton's method, in each cell size; in standard deviations
_MOST_RETURNS = 2000  # of a scan that are held against planes, evenly spread
_SEARCHED = 250  # likewise, of a search
_MOST_RADII = 10.0  # median ranges: deviation of an expected translation, up to which a search may meet the scans before
_MOST_RECKONED_M = 1e4  # likewise, up to which a new piece begins where dead reckoning leads
_FOLLOWED = 12  # best poses of a search
_ELSEWHERE = 500  # poses that tell what agrees by chance
_ERRORS = 3.0  # standard errors by which more returns agree at a pose that is believed
_NOISE_AT = (1, 4, 16, 64)  # scans, at which the noise of the sensor is estimated anew
# Of the last scans, that it is estimated from: so many tell a deviation to a percent. With all 25 scans of 2,000 returns, it took
# three times as long as a scan.
_NOISE_RETURNS = 10_000
_SHIFTS = (0.0, 1.0, -1.0, 2.0, -2.0)  # cells: further than returns of one thing reach
_SURE = 0.05  # cells: deviation of an expected translation that needs no returns
_LEAST_VARIANCE = 1e-12
_PARTS = slice(0, 3), slice(3, 6)  # of an increment: translation, rotation


@dataclass
class Tracked:
    """One scan, where it was found."""

    pose: Floats
    """(4, 4) T_world_sensor, in the frame of its piece."""
    covariance: Floats
    """(6, 6) of the step that led here: translation, m, and rotation vector, rad, in world axes."""
    agreeing: float
    """Share of the returns that lie on planes of the scans before it, in [0, 1]. NaN: it begins a piece."""
    piece: int
    """Number of the piece of the drive that it is part of."""
    turn: Floats
    """(3,) rotation vector of the step that led here, in the frame of the scan before, rad. It may be more than half a turn."""
    told: tuple[float, float] = (0.0, 0.0)
    """Share of the expected step's variance that the returns took away, of the translation and of the rotation, each in the
    direction that they tell least of. 0: nothing."""


@dataclass(frozen=True)
class _Kept:
    """A scan whose planes are kept."""

    scan: Floats
    """(N, 3) sensor frame, m."""
    pose: Floats
    """(4, 4)."""
    world: Floats
    """(N, 3) as they were added to the planes: taken out again, they leave nothing."""


@dataclass
class Tracker:
    """The last scans' planes, and where the last scan was."""

    cell_size_m: float
    """Edge of the cell of a map's surfel, m."""
    config: ReturnsConfig
    num_threads: int = 0
    last: Tracked | None = None
    _planes: list[LocalPlanes] = field(default_factory=list)
    _recent: deque[_Kept] = field(default_factory=deque)
    _noise: SensorNoise | None = None
    _scans: int = 0

    def follow(self, scan: Floats, expected: ExpectedStep | None) -> Tracked:
        """The next scan (N, 3), sensor frame, m, is where its returns agree, near `expected`. None: it is the first."""
        found = self.seek(scan, expected)
        self.keep(scan, found)
        return found

    def seek(self, scan: Floats, expected: ExpectedStep | None) -> Tracked:
        """Where :meth:`follow` would put a scan. Nothing changes."""
        if expected is None or self.last is None:
            return begun(np.eye(4))
        # Where a drive was lost, what was mapped before and after cannot be joined.
        if (found := self._sought(scan, expected)) is not None:
            return found
        # Nor where dead reckoning leads after a day.
        reckoned = expected.spread_m(0.0) <= _MOST_RECKONED_M
        return begun(self.last.pose @ expected.pose() if reckoned else self.last.pose, self.last.piece + 1)

    def keep(self, scan: Floats, found: Tracked) -> None:
        """The scan was there. The next ones are held against its planes, too."""
        if self.last is None or found.piece != self.last.piece:
            self._planes = [LocalPlanes(cells * self.cell_size_m) for cells in _CELLS]
            self._recent.clear()
            self._scans = 0
        points = np.ascontiguousarray(np.einsum("ij,nj->ni", found.pose[:3, :3], scan) + found.pose[:3, 3])
        gone = self._recent.popleft() if len(self._recent) == WINDOW else None
        for planes in self._planes:
            planes.add(points)
            if gone is not None:
                planes.add(gone.world, -1)
        self._recent.append(_Kept(scan, found.pose, points))
        self.last = found
        self._scans += 1
        if self._scans in _NOISE_AT:
            self._noise = self._estimated_noise()

    def _estimated_noise(self) -> SensorNoise:
        counts = np.cumsum([len(kept.scan) for kept in reversed(self._recent)])
        last = list(self._recent)[-max(2, int(np.searchsorted(counts, _NOISE_RETURNS, side="right"))) :]
        scans, poses = [kept.scan for kept in last], [kept.pose for kept in last]
        rays = SensorReturns.of(scans, 0.0, None).posed(np.stack(poses))
        surfels = Surfels.of(rays, self.cell_size_m / LEAVES_PER_SURFEL, self.num_threads)
        return sensor_noise(surfels, rays, self.config, self.num_threads)

    def _sought(self, scan: Floats, expected: ExpectedStep) -> Tracked | None:
        assert self.last is not None
        assert self._noise is not None
        scan = thinned(scan, _MOST_RETURNS)
        if len(scan) == 0:
            return self._as_expected(expected)
        radius_m = float(np.median(np.linalg.norm(scan, axis=1)))
        capture_m = 0.5 * _CELLS[0] * self.cell_size_m
        if expected.spread_m(radius_m) <= capture_m:
            return self._fitted(scan, expected, expected.turn.mean)
        if expected.spread_m(0.0) > _MOST_RADII * radius_m:
            return None  # where the scans so far are seen, if at all, is not among a search's few poses
        return self._searched(scan, expected, capture_m, radius_m)

    def _as_expected(self, expected: ExpectedStep) -> Tracked:
        assert self.last is not None
        pose = self.last.pose @ expected.pose()
        covariance = self._in_world(expected.covariance())
        return Tracked(pose, covariance, 0.0, self.last.piece, expected.turn.mean)

    def _in_world(self, covariance: Floats) -> Floats:
        assert self.last is not None
        both = np.kron(np.eye(2), self.last.pose[:3, :3])
        found: Floats = both @ covariance @ both.T
        return found

    def _fitted(
        self, scan: Floats, expected: ExpectedStep, turn: Floats, start: Floats | None = None
    ) -> Tracked:
        """By Gauss and Newton's method from `start`, with what is expected of a sensor that turned by `turn`."""
        assert self.last is not None
        middle = self.last.pose @ expected.pose(turn)
        prior = self._in_world(expected.covariance(turn)) + _LEAST_VARIANCE * np.eye(6)
        pose, covariance, agreeing = self._settled(scan, middle if start is None else start, middle, prior)
        covariance = self._without_chance(scan, pose, prior, covariance)
        turned = rotation_vector(self.last.pose[:3, :3].T @ pose[:3, :3], turn)
        told = tuple(_taken_away(prior[part, part], covariance[part, part]) for part in _PARTS)
        return Tracked(pose, covariance, agreeing, self.last.piece, turned, (told[0], told[1]))

    def _without_chance(self, scan: Floats, pose: Floats, prior: Floats, covariance: Floats) -> Floats:
        """The covariance without what returns seem to say along the least certain axis wherever the scan is put.

        Along a tunnel, returns match walls everywhere, and some of the matches hold the scan by chance.
        """
        assert self._noise is not None
        cell_m = _CELLS[-1] * self.cell_size_m
        axis = np.linalg.eigh(covariance[:3, :3])[1][:, -1]
        before, left = axis @ prior[:3, :3] @ axis, axis @ covariance[:3, :3] @ axis
        if before < (_SURE * cell_m) ** 2:
            return covariance
        information = []
        for shift in _SHIFTS:
            shifted = pose.copy()
            shifted[:3, 3] += shift * cell_m * axis
            hessian, gradient, doubt, _ = self._planes[-1].beside(scan, shifted, self._noise.variances)
            hessian, _ = _without_normal_errors(hessian, gradient, doubt)
            information.append(1 / (axis @ np.linalg.pinv(hessian, hermitian=True)[:3, :3] @ axis))
        chance = min(1.0, float(np.mean(information[1:])) / max(information[0], 1e-12))
        widened = 1 / (1 / before + (1 - chance) * max(1 / left - 1 / before, 0.0)) - left
        covariance = covariance.copy()
        covariance[:3, :3] += max(widened, 0.0) * np.outer(axis, axis)
        return covariance

    def _settled(
        self, scan: Floats, pose: Floats, middle: Floats, prior: Floats
    ) -> tuple[Floats, Floats, float]:
        """The pose that the returns and a prior round `middle` lead to, its covariance, and the share of returns that agree."""
        assert self._noise is not None
        information, weight, covariance = np.linalg.inv(prior), 0.0, prior
        for planes in self._planes:
            for _ in range(_ITERATIONS):
                hessian, gradient, doubt, weight = planes.beside(
                    scan, np.ascontiguousarray(pose), self._noise.variances
                )
                hessian, gradient = _without_normal_errors(hessian, gradient, doubt)
                off = np.concatenate(
                    [pose[:3, 3] - middle[:3, 3], rotation_vector(pose[:3, :3] @ middle[:3, :3].T)]
                )
                total = hessian + information
                increment = -np.linalg.solve(total, gradient + np.einsum("ij,j->i", information, off))
                pose = moved(pose[None], increment[None])[0]
                covariance = np.linalg.inv(total)
                if np.einsum("i,ij,j->", increment, total, increment) < 6 * _SETTLED**2:
                    break
        return pose, covariance, weight / len(scan)

    def _searched(
        self, scan: Floats, expected: ExpectedStep, capture_m: float, radius_m: float
    ) -> Tracked | None:
        """The best of many poses, if the returns agree there clearly better than at any other place and where it cannot be."""
        assert self.last is not None
        assert self._noise is not None
        coarse, variances = self._planes[0], self._noise.variances
        asked = thinned(scan, _SEARCHED)
        turns, steps = expected.candidates(capture_m, radius_m)
        poses = np.ascontiguousarray(np.einsum("ij,kjl->kil", self.last.pose, steps))
        scores = coarse.scores(asked, poses, variances).mean(axis=1)
        best = _best(scores)
        # In a scene that repeats itself, the best poses may all be near one place, and the true one be another.
        elsewhere = np.flatnonzero(_apart_m(poses, poses[best[0]], radius_m) > 2 * capture_m)
        best += elsewhere[_best(scores[elsewhere])].tolist()
        found = [self._fitted(scan, expected, turns[i], poses[i]) for i in best]
        at = np.stack([one.pose for one in found])
        chance = self._elsewhere()
        chance = chance[_best(coarse.scores(asked, chance, variances).mean(axis=1))]
        of_found, by_chance = (coarse.scores(asked, tried, variances) for tried in (at, chance))
        first = int(np.argmax(of_found.mean(axis=1)))
        rivals = of_found[_apart_m(at, at[first], radius_m) > capture_m]
        gains = of_found[first] - np.concatenate([by_chance, rivals])
        clear = gains.mean(axis=1) > _ERRORS * gains.std(axis=1) / np.sqrt(len(asked))
        return found[first] if clear.all() else None

    def _elsewhere(self) -> Floats:
        """(_ELSEWHERE, 4, 4) upright poses among those of the last scans, that look anywhere but where they looked."""
        assert self.last is not None
        rng = np.random.default_rng(0)
        known = np.stack([kept.pose for kept in self._recent])
        reach_m = float(np.median(np.linalg.norm(self._recent[-1].scan, axis=1)))
        poses = known[rng.integers(0, len(known), _ELSEWHERE)]
        turns = Rotation.from_rotvec(
            rng.uniform(np.pi / 6, 2 * np.pi - np.pi / 6, _ELSEWHERE)[:, None] * self.last.pose[:3, 2]
        ).as_matrix()
        poses[:, :3, :3] = np.einsum("kij,kjl->kil", turns, poses[:, :3, :3])
        shifts = rng.uniform(-reach_m, reach_m, (_ELSEWHERE, 3))
        up = self.last.pose[:3, 2]
        poses[:, :3, 3] += shifts - np.einsum("ki,i->k", shifts, up)[:, None] * up
        return np.ascontiguousarray(poses)


def begun(pose: Floats, piece: int = 0) -> Tracked:
    """A scan that a piece of the drive begins with, at this pose (4, 4)."""
    return Tracked(pose, np.zeros((6, 6)), np.nan, piece, np.zeros(3))


def _taken_away(prior: Floats, covariance: Floats) -> float:
    """Share of the variance before that is gone, in the direction where it is least."""
    root = np.linalg.cholesky(prior)
    left = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    return max(1 - float(np.linalg.eigvalsh(left)[-1]), 0.0)


def _best(scores: Floats) -> list[int]:
    """Rows of the highest scores."""
    rows: list[int] = np.argsort(-scores, kind="stable")[:_FOLLOWED].tolist()
    return rows


def _apart_m(poses: Floats, pose: Floats, radius_m: float) -> Floats:
    """(K,) by how far poses (K, 4, 4) move a return at this range from where another pose puts it, m, at most."""
    turns = Rotation.from_matrix(np.einsum("kij,lj->kil", poses[:, :3, :3], pose[:3, :3])).magnitude()
    apart: Floats = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) + radius_m * turns
    return apart


def _without_normal_errors(hessian: Floats, gradient: Floats, doubt: Floats) -> tuple[Floats, Floats]:
    """Hessian and gradient without the share that errors of the normals make (errors in variables, Fuller 1987).

    Along a wall, normals that point a little along it would tell where the sensor is.
    """
    values, axes = np.linalg.eigh(hessian)
    root = np.sqrt(np.maximum(values, 1e-12 * max(values[-1], 1e-12)))
    white = axes / root
    shares, turned = np.linalg.eigh(np.einsum("ij,ik,kl->jl", white, doubt, white))
    kept = np.maximum(1 - shares, 0.0)
    into = np.einsum("ij,jk->ik", axes * root, turned)
    back = np.einsum("ij,jk->ik", white, turned)
    hessian = np.einsum("ij,j,kj->ik", into, kept, into)
    return hessian, np.einsum("ij,j,kj,k->i", into, kept, back, gradient)


def thinned(scan: Floats, most: int) -> Floats:
    """At most about so many returns, evenly spread over the scan."""
    return np.ascontiguousarray(scan[:: max(1, -(-len(scan) // most))])


def pieces_of(tracked: Sequence[Tracked]) -> list[slice]:
    """The scans of each piece."""
    number = np.array([found.piece for found in tracked])
    edges = np.flatnonzero(np.diff(number, prepend=-1, append=number[-1] + 1))
    return [slice(int(low), int(high)) for low, high in itertools.pairwise(edges)]
