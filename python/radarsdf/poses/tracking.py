"""Tracking of a drive without poses: each scan is registered with the planes of the previous ones."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh
from tqdm import tqdm

from radarsdf._core import LocalPlanes
from radarsdf.checks import hides_bar
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.doppler import YAW_STEP_RAD, DopplerMotion, SensorVelocities
from radarsdf.poses.imu import Gyroscope
from radarsdf.poses.motion import Motion, MotionPrior, MotionRate, PredictedStep, SteadyMotion
from radarsdf.poses.planes import SensorReturns, plane_cell_m, reduction
from radarsdf.poses.rigid import Floats, covariance_in, increments, moved, rotation, rotation_vector
from radarsdf.returns.noise import SensorNoise, sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels

WINDOW = 25
"""Number of scans in the local map. With 60, simulated drives were no better, and wrong poses persisted longer."""
_CELLS = (4.0, 2.0)  # cell edges, relative to a map's surfels
_ITERATIONS, _SETTLED = 8, 0.03  # Gauss-Newton at each cell size: maximum, tolerance in deviations
_MOST_RETURNS, _SEARCHED = 2000, 250  # maximum returns of a scan to register, to score in a search
_MOST_RADII = 10.0  # maximum standard deviation of a predicted translation for a search, median ranges
_MOST_RECKONED_M = 1e4  # and for a new segment to begin at the dead-reckoned pose
_FOLLOWED = 12  # best candidates of a search, refined
_ELSEWHERE = 500  # unrelated poses, for the agreement by chance
_ERRORS = 3.0  # standard errors by which more returns agree at an accepted pose
_NOISE_AT = (1, 4, 16, 64)  # numbers of scans at which the noise of the sensor is re-estimated
_NOISE_RETURNS = 10_000  # of the last scans, for this estimate: they determine a deviation to a percent
_SHIFTS = (0.0, 1.0, -1.0, 2.0, -2.0)  # cells, beyond the extent of single objects
_SURE = 0.05  # standard deviation of a predicted translation that needs no returns, cells
_LEAST_VARIANCE = 1e-12
# Initial priors, replaced by the drive's own rates after the first pass. With 1 rad/s, the first steps of sparse real
# scans were wrong by up to 9 degrees.
_TURNS = MotionPrior(np.full(3, 0.3**2), np.full(3, 0.3**2), True)
_MOVES = MotionPrior(np.full(3, 5.0**2), np.full(3, 2.0**2), False)
_PASSES = 3
# Minimum share of a step's prior variance that the returns must remove if nothing else measures the translation. Below half,
# the prior is more informative. Simulated walls: 0.08 and 0.10; all other scenes, seeds 81 and 82, and real drives: 0.58 to 0.95.
LEAST_OBSERVED = 0.5
# Standard deviation of the lateral acceleration: at high speed, turns are slow. Vehicles on roads: about 1; drones and hands: 2.
LATERAL_MPS2 = 2.0
# Maximum standard deviation of a turn rate that may remain unobserved between scans, that of a sensor faster than 20 m/s: the joint
# estimate and the covariance are valid for small rotations.
_SLOW_TURN_RAD_S = 0.1
_GYROSCOPE_RAD = 0.003  # initial deviation of a step's rotation by a gyroscope


@dataclass
class Tracked:
    """Tracked scan."""

    pose: Floats  # (4, 4) T_world_sensor, in the frame of its segment
    covariance: Floats  # (6, 6) of the step to this scan: translation, m, rotation vector, rad, world axes
    agreeing: float  # share of inliers on planes of previous scans, in [0, 1]. NaN if it starts a segment
    segment: int  # number of its segment of the drive
    turn: Floats  # (3,) rotation vector of the step in the previous frame, rad; may exceed half a turn
    # Share of the predicted variance that the returns removed, of translation and rotation, each in the least certain
    # direction.
    observed: tuple[float, float] = (0.0, 0.0)


@dataclass
class Tracker:
    """Local map of planes of the last scans, and the last pose."""

    cell_size_m: float  # edge of the cell of a map's surfel, m
    config: ReturnsConfig
    num_threads: int = 0
    last: Tracked = field(init=False)
    _planes: list[LocalPlanes] = field(default_factory=list)
    # Scans (N, 3), sensor frame, their poses, and the points as added to the planes, for an exact removal.
    _recent: deque[tuple[Floats, Floats, Floats]] = field(default_factory=deque)
    _variances: list[float] = field(default_factory=list)
    _scans: int = 0

    def follow(self, scan: Floats, expected: PredictedStep | None) -> Tracked:
        """Register the next scan (N, 3), sensor frame, m, near `expected`, and add it to the map. None: the first scan."""
        found = self.seek(scan, expected)
        self.keep(scan, found)
        return found

    def seek(self, scan: Floats, expected: PredictedStep | None) -> Tracked:
        """Register a scan like :meth:`follow`, without changing the map."""
        if expected is None or not self._planes:
            return begun(np.eye(4))
        # If tracking is lost, the maps before and after cannot be joined.
        if (found := self._sought(scan, expected)) is not None:
            return found
        # Dead reckoning over a day is useless.
        reckoned = expected.spread_m(0.0) <= _MOST_RECKONED_M
        return begun(self.last.pose @ expected.pose() if reckoned else self.last.pose, self.last.segment + 1)

    def keep(self, scan: Floats, found: Tracked) -> None:
        """Add a scan to the planes with which the next ones are registered."""
        if not self._planes or found.segment != self.last.segment:
            self._planes = [LocalPlanes(cells * self.cell_size_m) for cells in _CELLS]
            self._recent.clear()
            self._scans = 0
        points = np.ascontiguousarray(np.einsum("ij,nj->ni", found.pose[:3, :3], scan) + found.pose[:3, 3])
        gone = self._recent.popleft() if len(self._recent) == WINDOW else None
        for planes in self._planes:
            planes.add(points)
            if gone is not None:
                planes.add(gone[2], -1)
        self._recent.append((scan, found.pose, points))
        self.last = found
        self._scans += 1
        if self._scans in _NOISE_AT:
            self._variances = self._noise().variances

    def _noise(self) -> SensorNoise:
        counts = np.cumsum([len(scan) for scan, *_ in reversed(self._recent)])
        last = list(self._recent)[-max(2, int(np.searchsorted(counts, _NOISE_RETURNS, side="right"))) :]
        scans, poses = [scan for scan, *_ in last], [pose for _, pose, _ in last]
        rays = SensorReturns.of(scans, 0.0, None).posed(np.stack(poses))
        surfels = Surfels.of(rays, self.cell_size_m / LEAVES_PER_SURFEL, self.num_threads)
        return sensor_noise(surfels, rays, self.config, self.num_threads)

    def _sought(self, scan: Floats, expected: PredictedStep) -> Tracked | None:
        scan = thinned(scan, _MOST_RETURNS)
        if len(scan) == 0:
            return self._reckoned(expected)
        radius_m = float(np.median(np.linalg.norm(scan, axis=1)))
        capture_m = 0.5 * _CELLS[0] * self.cell_size_m
        if expected.spread_m(radius_m) <= capture_m:
            return self._fitted(scan, expected, expected.turn.mean)
        if expected.spread_m(0.0) > _MOST_RADII * radius_m:
            return None  # too few candidates to find an overlap with the previous scans, if any
        found = self._searched(scan, expected, capture_m, radius_m)
        # Without a clear match, a scan whose position is predicted is no more lost than one without returns.
        return self._reckoned(expected) if found is None and expected.spread_m(0.0) <= capture_m else found

    def _reckoned(self, expected: PredictedStep) -> Tracked:
        """Return the predicted step."""
        pose = self.last.pose @ expected.pose()
        return Tracked(
            pose, self._in_world(expected.covariance()), 0.0, self.last.segment, expected.turn.mean
        )

    def _in_world(self, covariance: Floats) -> Floats:
        found: Floats = covariance_in(covariance[None], self.last.pose[:3, :3])[0]
        return found

    def _fitted(
        self, scan: Floats, expected: PredictedStep, turn: Floats, start: Floats | None = None
    ) -> Tracked:
        """Register by Gauss-Newton from `start`, with the prior of a sensor that turned by `turn`."""
        middle = self.last.pose @ expected.pose(turn)
        prior = self._in_world(expected.covariance(turn)) + _LEAST_VARIANCE * np.eye(6)
        pose, covariance, agreeing = self._settled(scan, middle if start is None else start, middle, prior)
        covariance = self._without_chance(scan, pose, prior, covariance)
        turned = rotation_vector(self.last.pose[:3, :3].T @ pose[:3, :3], turn)
        move_share = _removed_share(prior[:3, :3], covariance[:3, :3])
        turn_share = _removed_share(prior[3:, 3:], covariance[3:, 3:])
        return Tracked(pose, covariance, agreeing, self.last.segment, turned, (move_share, turn_share))

    def _without_chance(self, scan: Floats, pose: Floats, prior: Floats, covariance: Floats) -> Floats:
        """Remove the spurious information along the least certain axis that returns have for any shift of the scan."""
        # In a tunnel, returns match the walls everywhere, and some matches constrain the scan by chance.
        cell_m = _CELLS[-1] * self.cell_size_m
        axis = np.linalg.eigh(covariance[:3, :3])[1][:, -1]
        before, left = axis @ prior[:3, :3] @ axis, axis @ covariance[:3, :3] @ axis
        if before < (_SURE * cell_m) ** 2:
            return covariance
        shifted = np.tile(pose, (len(_SHIFTS), 1, 1))
        shifted[:, :3, 3] += cell_m * np.outer(_SHIFTS, axis)
        matches = [self._planes[-1].agreement(scan, at, self._variances)[:3] for at in shifted]
        hessians = _reduced(*(np.stack(parts) for parts in zip(*matches, strict=True)))[0]
        variances = np.einsum("i,kij,j->k", axis, np.linalg.pinv(hessians, hermitian=True)[:, :3, :3], axis)
        information = np.divide(1.0, variances, out=np.zeros_like(variances), where=variances > 0)
        chance = min(1.0, float(np.mean(information[1:])) / max(float(information[0]), 1e-12))
        widened = 1 / (1 / before + (1 - chance) * max(1 / left - 1 / before, 0.0)) - left
        covariance = covariance.copy()
        covariance[:3, :3] += max(widened, 0.0) * np.outer(axis, axis)
        return covariance

    def _settled(
        self, scan: Floats, pose: Floats, middle: Floats, prior: Floats
    ) -> tuple[Floats, Floats, float]:
        """Iterate to convergence with a prior around `middle`; return the pose, its covariance, and the share of inliers."""
        information, weight, covariance = np.linalg.inv(prior), 0.0, prior
        for planes in self._planes:
            for _ in range(_ITERATIONS):
                *match, weight = planes.agreement(scan, pose, self._variances)
                hessian, gradient = _reduced(*match)
                total = hessian + information
                off = increments(middle[None], pose[None])[0]
                step = -np.linalg.solve(total, gradient + information @ off)
                pose = moved(pose[None], step[None])[0]
                covariance = np.linalg.inv(total)
                if step @ total @ step < 6 * _SETTLED**2:
                    break
        return pose, covariance, weight / len(scan)

    def _searched(
        self, scan: Floats, expected: PredictedStep, capture_m: float, radius_m: float
    ) -> Tracked | None:
        """Search many poses for the best, if the returns agree there significantly better than elsewhere and than by chance."""
        coarse, sample = self._planes[0], thinned(scan, _SEARCHED)

        def scores(poses: Floats) -> Floats:
            found: Floats = coarse.scores(sample, np.ascontiguousarray(poses), self._variances)
            return found

        turns, steps = expected.candidates(capture_m, radius_m)
        poses = np.einsum("ij,kjl->kil", self.last.pose, steps)
        means = scores(poses).mean(axis=1)
        best = _best(means)
        # In a self-similar scene, the best candidates may all lie near a wrong place.
        elsewhere = np.flatnonzero(_apart_m(poses, poses[best[0]], radius_m) > 2 * capture_m)
        best += elsewhere[_best(means[elsewhere])].tolist()
        found = [self._fitted(scan, expected, turns[i], poses[i]) for i in best]
        at = np.stack([one.pose for one in found])
        chance = scores(self._elsewhere(radius_m))
        of_found, by_chance = scores(at), chance[_best(chance.mean(axis=1))]
        first = int(np.argmax(of_found.mean(axis=1)))
        rivals = of_found[_apart_m(at, at[first], radius_m) > capture_m]
        gains = of_found[first] - np.concatenate([by_chance, rivals])
        clear = gains.mean(axis=1) > _ERRORS * gains.std(axis=1) / np.sqrt(len(sample))
        return found[first] if clear.all() else None

    def _elsewhere(self, reach_m: float) -> Floats:
        """Draw upright poses (_ELSEWHERE, 4, 4) near those of the last scans, with other headings."""
        rng = np.random.default_rng(0)
        known = np.stack([pose for _, pose, _ in self._recent])
        up = self.last.pose[:3, 2]
        poses = known[rng.integers(0, len(known), _ELSEWHERE)]
        turns = rotation(rng.uniform(np.pi / 6, 2 * np.pi - np.pi / 6, _ELSEWHERE)[:, None] * up)
        poses[:, :3, :3] = np.einsum("kij,kjl->kil", turns, poses[:, :3, :3])
        shifts = rng.uniform(-reach_m, reach_m, (_ELSEWHERE, 3))
        poses[:, :3, 3] += shifts - np.einsum("ki,i->k", shifts, up)[:, None] * up
        return poses


def begun(pose: Floats, segment: int = 0) -> Tracked:
    """Return the first scan of a segment, at this pose (4, 4)."""
    return Tracked(pose, np.zeros((6, 6)), np.nan, segment, np.zeros(3))


def _reduced(hessian: Floats, gradient: Floats, doubt: Floats) -> tuple[Floats, Floats]:
    """Return Hessians (..., 6, 6) and gradients (..., 6) without the contribution of errors of the normals."""
    # Along a wall, slightly tilted normals would seem to observe the position along it.
    M = reduction(hessian, doubt)
    found: Floats = np.einsum("...ij,...j->...i", M @ M, gradient)
    return M @ hessian @ M.swapaxes(-1, -2), found


def _removed_share(prior: Floats, covariance: Floats) -> float:
    """Return the share of the prior variance removed, in the direction where it is smallest."""
    return max(1 - float(eigh(covariance, prior, eigvals_only=True)[-1]), 0.0)


def _best(scores: Floats) -> list[int]:
    """Return the rows of the highest scores."""
    rows: list[int] = np.argsort(-scores, kind="stable")[:_FOLLOWED].tolist()
    return rows


def _apart_m(poses: Floats, pose: Floats, radius_m: float) -> Floats:
    """Return upper bounds (K,) of the displacement, m, of a return at range `radius_m` between poses (K, 4, 4) and `pose`."""
    off = increments(np.broadcast_to(pose, poses.shape), poses)
    apart: Floats = np.linalg.norm(off[:, :3], axis=1) + radius_m * np.linalg.norm(off[:, 3:], axis=1)
    return apart


def thinned(scan: Floats, most: int) -> Floats:
    """Subsample a scan evenly to about `most` returns."""
    return np.ascontiguousarray(scan[:: max(1, -(-len(scan) // most))])


@dataclass(frozen=True)
class Drive:
    """Measurements of a drive without poses."""

    scans: list[Floats]  # (N_i, 3) static returns, sensor frame, m
    times_s: Floats
    velocities: SensorVelocities | None
    gyroscope: Gyroscope | None
    turns: MotionPrior = _TURNS  # in the sensor frame
    moves: MotionPrior = _MOVES
    # The same for the joint estimate. Tracked rates are damped where returns hardly measure them, and so are priors of their means:
    # a sparse simulated radar rolled half as much as it did. Tracking keeps those, which limit its searches.
    steady: tuple[MotionPrior, MotionPrior] = _MOVES, _TURNS
    # (2, F - 1) rough yaws between scans of a sensor that turns fast, for the sign of the Doppler and its reverse. NaN if unknown.
    yaws: Floats | None = None

    def expected(self, i: int, turn: MotionRate | None, move: MotionRate | None) -> PredictedStep:
        """Predict the step to scan `i` from the rates of the previous one; None if unknown."""
        duration_s = float(self.times_s[i] - self.times_s[i - 1])
        before_s = float(self.times_s[i - 1] - self.times_s[i - 2]) if i > 1 else 0.0
        elapsed_s = (duration_s + before_s) / 2
        if self.gyroscope is not None:
            by = self.gyroscope.step(i - 1)
        elif self.yaws is not None and np.isfinite(self.yaws[0, i - 1]):
            variance = self.turns.usual * duration_s**2
            variance[2] = YAW_STEP_RAD**2 / 4
            by = MotionRate(np.array([0.0, 0.0, self.yaws[0, i - 1]]), np.diag(variance))
        else:
            rate = self.turns.after(turn, elapsed_s)
            by = MotionRate(rate.mean * duration_s, rate.covariance * duration_s**2)
        if self.velocities is not None:
            covariance = self.velocities.step_covariance(i - 1, duration_s)
            begin, end = self.velocities.mean_mps[i - 1 : i + 1]
            return PredictedStep(by, begin, end, covariance, duration_s)
        rate = self.moves.after(move, elapsed_s)
        return PredictedStep(by, rate.mean, rate.mean, rate.covariance * duration_s**2, duration_s)

    @property
    def usual_turn_rad_s(self) -> float:
        """Prior standard deviation of the turn rate, given the velocities, rad/s."""
        usual = float(np.sqrt(_TURNS.usual[0]))
        if self.velocities is None:
            return usual
        speed_mps = np.sqrt((self.velocities.mean_mps**2).sum(axis=1).mean())
        return min(usual, LATERAL_MPS2 / max(float(speed_mps), 1e-9))

    @property
    def turns_slowly(self) -> bool:
        """Whether the sensor is so fast that it hardly turns between scans."""
        return self.usual_turn_rad_s < _SLOW_TURN_RAD_S

    def motions(self, tracked: Sequence[Tracked], rows: slice) -> list[Motion]:
        """Return the measured motions between the scans of `rows`."""
        times_s, poses = self.times_s[rows], np.stack([found.pose for found in tracked[rows]])
        turns = np.stack([found.turn for found in tracked[rows][1:]])
        duration_s, turn_sigma_rad_s = float(np.median(np.diff(times_s))), np.full(3, self.usual_turn_rad_s)
        usual = np.array([self.moves.usual.max(), self.usual_turn_rad_s**2])
        measured = np.repeat([self.velocities is not None, self.gyroscope is not None], 3)
        motions: list[Motion] = [SteadyMotion.by(self.steady, usual, times_s, poses, measured)]
        if self.gyroscope is not None:
            turned = Motion.of(poses, 0.0, _GYROSCOPE_RAD, times_s)
            turned.shares[:, :3] = np.inf
            vectors = [self.gyroscope.step(i).mean for i in range(rows.start, rows.stop - 1)]
            turned.steps[:, :3, :3] = rotation(np.stack(vectors))
            turn_sigma_rad_s = np.sqrt(self.gyroscope.bias.covariance.diagonal())
            motions.insert(0, turned)
        if self.velocities is None:
            return motions
        # The error of predicted turns that few returns hardly correct is common to all steps.
        common = np.concatenate([np.zeros(3), turn_sigma_rad_s * duration_s])
        motions[0] = dataclasses.replace(motions[0], bias_sigma=common)
        return [*motions, DopplerMotion.by(self.velocities.select(rows), times_s, poses, turns)]


def rates_of(before: Floats, now: Tracked, duration_s: float) -> tuple[MotionRate, MotionRate]:
    """Compute the rates of rotation and translation, in the sensor frame."""
    back = before[:3, :3].T
    half = rotation(0.5 * now.turn).T @ back
    way = half @ (now.pose[:3, 3] - before[:3, 3])
    of_way, of_turn = (
        matrix @ now.covariance[rows, rows] @ matrix.T / duration_s**2
        for matrix, rows in ((half, slice(0, 3)), (back, slice(3, 6)))
    )
    return MotionRate(now.turn / duration_s, of_turn), MotionRate(way / duration_s, of_way)


Rates = tuple[MotionRate, MotionRate] | tuple[None, None]  # rotation, rad/s, and translation, m/s, if known


def tracked_once(drive: Drive, tracker: Tracker) -> tuple[list[Tracked], list[Rates]]:
    """Track all scans in one pass; return them, and the rates of each step."""
    tracked = [tracker.follow(drive.scans[0], None)]
    rates: list[Rates] = []
    last: Rates = None, None
    for i in range(1, len(drive.scans)):
        expected = drive.expected(i, *last)
        before, now = tracked[-1], tracker.follow(drive.scans[i], expected)
        followed = now.segment == before.segment and expected.duration_s > 0
        last = rates_of(before.pose, now, expected.duration_s) if followed else (None, None)
        rates.append(last)
        tracked.append(now)
    return tracked, rates


def followed(
    drive: Drive, config: FitConfig, num_threads: int, progress: bool | None = False
) -> tuple[Drive, list[Tracked]]:
    """Track a drive in several passes; return it with its learnt motion prior, and the scans of the last pass."""
    gyroscope, drive = drive.gyroscope, dataclasses.replace(drive, gyroscope=None)
    cell_m, durations_s = plane_cell_m(drive.scans, config.leaf_size_m), np.diff(drive.times_s)
    tracked: list[Tracked] = []
    for i in tqdm(range(_PASSES), desc="odometry", unit="pass", disable=hides_bar(progress)):
        tracked, rates = tracked_once(drive, Tracker(cell_m, config.returns, num_threads))
        turn_prior = drive.turns
        if i == 0 and drive.turns_slowly and tracked[-1].segment > 0:
            # Tracking was lost. Narrow the search of the next passes.
            usual = np.full(3, drive.usual_turn_rad_s**2)
            turn_prior = MotionPrior(usual, usual, True)
        turn_rates, move_rates = [turn for turn, _ in rates], [move for _, move in rates]
        steady = (
            drive.moves.learnt(move_rates, durations_s, with_errors=True),
            turn_prior.learnt(turn_rates, durations_s, with_errors=True),
        )
        turns, moves = turn_prior.learnt(turn_rates, durations_s), drive.moves.learnt(move_rates, durations_s)
        drive = dataclasses.replace(drive, turns=turns, moves=moves, steady=steady)
        if i == 0 and gyroscope is not None:
            # Rotations tracked with the gyroscope would not reveal its bias.
            lost = MotionRate(np.full(3, np.nan), np.eye(3))
            known = [turn or lost for turn in turn_rates]
            vectors = np.stack([turn.mean for turn in known]) * durations_s[:, None]
            covariance = np.stack([turn.covariance for turn in known]) * durations_s[:, None, None] ** 2
            drive = dataclasses.replace(drive, gyroscope=gyroscope.learnt(vectors, covariance))
    return drive, tracked
