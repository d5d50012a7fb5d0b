"""Drives without poses: prediction of each step, registration with the previous scans, and passes that learn the motion prior."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from radarsdf.arrays import Floats, NDArray
from radarsdf.checks import hides_bar
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import YAW_STEP_RAD
from radarsdf.poses.doppler import BodyVelocities, DopplerMotion, SensorVelocities
from radarsdf.poses.imu import Inertial
from radarsdf.poses.motion import (
    Motion,
    MotionPrior,
    MotionRate,
    PredictedStep,
    Priors,
    SteadyMotion,
    usual_duration_s,
)
from radarsdf.poses.planes import PlaneMap, SensorReturns, Tracked, apart_m, plane_cell_m, thin
from radarsdf.poses.rigid import covariance_in, rotation, rotation_vector
from radarsdf.returns.noise import sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.rig import Rig

# Local map. With 60 scans, simulated drives were no better, and wrong poses persisted longer. The noise determines a deviation to
# a percent from 10,000 returns; from 5,000, a sparse recorded drive fell into segments.
WINDOW = 25  # scans
_NOISE_AT = 1, 4, 16, 64  # numbers of scans at which the noise of the sensor is re-estimated
_NOISE_RETURNS = 10_000  # of the last scans, for this estimate

# Search, where the prediction is less certain than Gauss-Newton requires. Acceptance by a gain over chance alone, or over rivals alone,
# split three of five recorded drives into more segments.
_FEW, _SCORED, _FITTED = 64, 250, 500  # returns: to score all, to score the likely, to register the best
_LIKELY = 1024  # candidates
_BEST = 12  # candidates to register
_UNRELATED = 500  # poses, for the agreement by chance
_ERRORS = 3.0  # standard errors by which more returns agree at an accepted pose
_MOST_RADII = 10.0  # maximum standard deviation of a predicted translation, median ranges: beyond, candidates miss the overlap
_MOST_RECKONED_M = 1e4  # and for a segment to begin at the dead-reckoned pose: over a day, that is useless


@dataclass
class Tracker:
    """Local map of planes of the last scans, and the last pose."""

    cell_size_m: float  # edge of the cell of a map's surfel, m
    config: FitConfig
    window: int = WINDOW  # scans in the map
    last: Tracked = field(init=False)
    _planes: PlaneMap = field(init=False)
    # Scans (N, 3), sensor frame, their poses, and the points as added to the planes, for an exact removal.
    _recent: deque[tuple[Floats, Floats, Floats]] = field(default_factory=deque)
    _scans: int = 0

    def register(self, scan: Floats, predicted: PredictedStep) -> Tracked:
        """Register a scan (N, 3), sensor frame, m, with the map, near the predicted step."""
        scan = thin(scan)
        if len(scan) == 0:
            return self._dead_reckon(predicted)
        radius_m = float(np.median(np.linalg.norm(scan, axis=1)))
        capture_m = self._planes.capture_m
        if predicted.spread_m(radius_m) <= capture_m:
            prior = self._prior(predicted, predicted.turn.mean)
            return self._place(scan, prior[1], self._planes.fit(scan, *prior), predicted.turn.mean)
        spread_m = predicted.spread_m(0.0)
        if spread_m <= _MOST_RADII * radius_m:
            if (found := self._search_pose(scan, predicted, radius_m)) is not None:
                return found
            # Without a clear match, a scan whose position is predicted is no more lost than one without returns.
            if spread_m <= capture_m:
                return self._dead_reckon(predicted)
        # Tracking is lost: the maps before and after cannot be joined.
        begin = self.last.pose @ predicted.pose() if spread_m <= _MOST_RECKONED_M else self.last.pose
        return Tracked(begin, segment=self.last.segment + 1)

    def add(self, scan: Floats, found: Tracked) -> None:
        """Add a registered scan to the map, without the oldest."""
        if not self._scans or found.segment != self.last.segment:
            self._planes = PlaneMap(self.cell_size_m)
            self._recent.clear()
            self._scans = 0
        points = np.ascontiguousarray(np.einsum("ij,nj->ni", found.pose[:3, :3], scan) + found.pose[:3, 3])
        self._planes.add(points)
        self._recent.append((scan, found.pose, points))
        if len(self._recent) > self.window:
            self._planes.add(self._recent.popleft()[2], -1)
        self.last = found
        self._scans += 1
        if self._scans not in _NOISE_AT:
            return
        counts = np.cumsum([len(scan) for scan, *_ in reversed(self._recent)])
        last = list(self._recent)[-max(2, int(np.searchsorted(counts, _NOISE_RETURNS, side="right"))) :]
        scans, poses, _ = zip(*last, strict=True)
        rays = SensorReturns.of(scans, 0.0, None).posed(np.stack(poses))
        num_threads = self.config.num_threads
        surfels = Surfels.of(rays, self.cell_size_m / LEAVES_PER_SURFEL, num_threads)
        self._planes.variances = sensor_noise(surfels, rays, self.config.returns, num_threads).variances

    def _dead_reckon(self, predicted: PredictedStep) -> Tracked:
        pose, turn = self.last.pose @ predicted.pose(), predicted.turn.mean
        covariance = covariance_in(predicted.covariance(), self.last.pose[:3, :3])
        return Tracked(pose, covariance, 0.0, self.last.segment, turn)

    def _prior(self, predicted: PredictedStep, turn: Floats) -> tuple[Floats, Floats]:
        """Return mean poses (..., 4, 4) of a sensor that turned by `turn` (..., 3), and their covariances (..., 6, 6)."""
        last = self.last.pose
        return last @ predicted.pose(turn), covariance_in(predicted.covariance(turn), last[:3, :3])

    def _place(self, scan: Floats, prior: Floats, found: Tracked, turn: Floats) -> Tracked:
        found = self._planes.discount_chance(scan, prior, found)
        turn = rotation_vector(self.last.pose[:3, :3].T @ found.pose[:3, :3], turn)
        return replace(found, segment=self.last.segment, turn=turn)

    def _search_pose(self, scan: Floats, predicted: PredictedStep, radius_m: float) -> Tracked | None:
        """Search many poses for the best, if the returns agree there significantly better than elsewhere and than by chance."""
        planes, capture_m = self._planes, self._planes.capture_m
        few, sample, more = (thin(scan, most) for most in (_FEW, _SCORED, _FITTED))

        def score(points: Floats, poses: Floats) -> Floats:
            return planes.coarse.scores(points, poses, planes.variances, self.config.num_threads)

        turns, steps = predicted.candidates(capture_m, radius_m)
        poses = np.ascontiguousarray(np.einsum("ij,kjl->kil", self.last.pose, steps))
        likely = _best(score(few, poses).mean(axis=1), _LIKELY)
        turns, poses = turns[likely], poses[likely]
        agreeing = score(sample, poses).mean(axis=1)
        rows = _best(agreeing)
        # In a self-similar scene, the best candidates may all lie near a wrong place.
        elsewhere = np.flatnonzero(apart_m(poses, poses[rows[0]], radius_m) > 2 * capture_m)
        rows = np.concatenate([rows, elsewhere[_best(agreeing[elsewhere])]])
        means, covariances = self._prior(predicted, turns[rows])
        starts = zip(means, covariances, poses[rows], strict=True)
        at = np.stack([planes.fit(more, *start, finely=False).pose for start in starts])
        scores, by_chance = score(sample, at), score(sample, self._draw_unrelated(radius_m))
        first = int(np.argmax(scores.mean(axis=1)))
        rivals = scores[apart_m(at, at[first], radius_m) > capture_m]
        gains = scores[first] - np.concatenate([by_chance[_best(by_chance.mean(axis=1))], rivals])
        clear = gains.mean(axis=1) > _ERRORS * gains.std(axis=1) / np.sqrt(len(sample))
        found = planes.fit(scan, means[first], covariances[first], at[first])
        return self._place(scan, covariances[first], found, turns[rows[first]]) if clear.all() else None

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


def _best(scores: Floats, count: int = _BEST) -> NDArray[np.intp]:
    return np.argsort(-scores, kind="stable")[:count]


_PASSES = 3
# Initial priors, until the drive's own rates replace them. With 1 rad/s, first steps of sparse real scans were wrong by up to 9 degrees.
TURNS = MotionPrior(np.full(3, 0.3**2), np.full(3, 0.3**2), True)
MOVES = MotionPrior(np.full(3, 5.0**2), np.full(3, 2.0**2), False)
# Standard deviation of the lateral acceleration: at high speed, turns are slow. Vehicles on roads: about 1; drones and hands: 2.
LATERAL_MPS2 = 2.0
# Maximum standard deviation of a turn rate that may remain unobserved between scans, that of a sensor faster than 20 m/s: the joint
# estimate and the covariance are valid for small rotations.
SLOW_TURN_RAD_S = 0.1
_GYROSCOPE_RAD = 0.003  # initial deviation of a step's rotation by a gyroscope


class Rates(NamedTuple):
    """Rates of a step, in the sensor frame."""

    turn: MotionRate | None = None  # rad/s. None: unknown
    move: MotionRate | None = None  # m/s
    duration_s: float = 0.0  # of the step. 0: unknown


@dataclass(frozen=True)
class Drive:
    """Measurements of a drive without poses."""

    scans: list[Floats]  # (N_i, 3) static returns, frame of the poses, m
    times_s: Floats
    velocities: SensorVelocities | None
    turns: MotionPrior = TURNS  # in the sensor frame
    moves: MotionPrior = MOVES
    # The same for the joint estimate. Tracked rates are damped where returns hardly measure them, and so are priors of their means:
    # a sparse simulated radar rolled half as much as it did. Tracking keeps those, which limit its searches.
    steady: Priors = MOVES, TURNS
    first_turn: MotionRate | None = None  # learnt: from 0, scans at 1 rad/s began 16 degrees off
    inertial: Inertial = field(default_factory=Inertial)
    yaws: Floats | None = None  # as :attr:`CheckedScans.yaws`
    rig: Rig | None = None  # of several radars. The poses are those of its body

    def predict(self, i: int, rates: Rates) -> PredictedStep:
        """Predict the step to scan `i` from the rates of one that ends at the scan before it."""
        duration_s = float(self.times_s[i] - self.times_s[i - 1])
        elapsed_s = (duration_s + rates.duration_s) / 2
        if self.inertial.gyroscope is not None:
            turned = self.inertial.gyroscope.step(i - 1)
        else:
            turned = self.turns.after(rates.turn, elapsed_s).integrate(duration_s)
            if self.yaws is not None and np.isfinite(yaw := self.yaws[0, i - 1]):
                before = turned.covariance.copy()
                if self.turns is TURNS:  # not learnt yet, and expects slower turns
                    before[2, 2] = np.pi**2
                gain = before[:, 2] / (before[2, 2] + YAW_STEP_RAD**2 / 4)
                mean = turned.mean + gain * (yaw - turned.mean[2])
                turned = MotionRate(mean, before - np.outer(gain, before[2]))
        if self.velocities is None:
            velocity = self.moves.after(rates.move, elapsed_s)
            covariance = velocity.integrate(duration_s).covariance
            return PredictedStep(turned, velocity.mean, velocity.mean, covariance, duration_s)
        if isinstance(self.velocities, BodyVelocities):
            turned = self.velocities.turn_given(turned, i - 1, duration_s)
        covariance = self.velocities.step_covariance(i - 1, duration_s)
        begin, end, lever = (each[i - 1] for each in self.velocities.of_steps)
        return PredictedStep(turned, begin, end, covariance, duration_s, lever)

    @property
    def window(self) -> int:
        """Number of scans in the map by which the next ones are tracked."""
        return WINDOW * (1 if self.rig is None else len(self.rig.labels))

    @property
    def usual_turn_rad_s(self) -> float:
        """Prior standard deviation of the turn rate, given the velocities, rad/s."""
        usual = float(np.sqrt(TURNS.usual.max()))
        if self.velocities is None:
            return usual
        speed_mps = np.sqrt((self.velocities.mean_mps**2).sum(axis=1).mean())
        return min(usual, LATERAL_MPS2 / max(float(speed_mps), 1e-9))

    def motions(self, poses: Floats, turns: Floats, rows: slice) -> list[Motion]:
        """Return the measured motions between the K scans of `rows`, with tracked poses (K, 4, 4) and turns (K - 1, 3)."""
        times_s = self.times_s[rows]
        durations_s = np.diff(times_s)
        # A vehicle that turns on the spot, or laps fast, turns more than its speed lets expect.
        shown = np.square(turns).sum(axis=0).max() / max(np.square(durations_s).sum(), 1e-9)
        usual = np.array([self.moves.usual.max(), max(self.usual_turn_rad_s**2, shown)])
        duration_s, turn_sigma_rad_s = usual_duration_s(durations_s), np.full(3, self.usual_turn_rad_s)
        gyroscope = self.inertial.gyroscope
        measured = np.repeat([self.velocities is not None, gyroscope is not None], 3)
        motions: list[Motion] = [SteadyMotion.by(self.steady, usual, times_s, poses, measured)]
        if gyroscope is not None:
            turned = Motion.of(poses, 0.0, _GYROSCOPE_RAD, times_s)
            turned.shares[:, :3] = np.inf
            vectors = [gyroscope.step(i).mean for i in range(rows.start, rows.stop - 1)]
            turned.steps[:, :3, :3] = rotation(np.stack(vectors))
            turn_sigma_rad_s = np.sqrt(gyroscope.bias.covariance.diagonal())
            motions.insert(0, turned)
        if self.velocities is None:
            return motions
        # The error of predicted turns that few returns hardly correct is common to all steps.
        common = np.concatenate([np.zeros(3), turn_sigma_rad_s * duration_s])
        motions[0] = replace(motions[0], bias_sigma=common)
        return [*motions, DopplerMotion.by(self.velocities.select(rows), times_s, poses, turns)]


def track_drive(
    drive: Drive, config: FitConfig, progress: bool | None = False
) -> tuple[Drive, list[Tracked]]:
    """Track a drive in several passes; return it with its learnt motion prior, and the scans of the last pass."""
    inertial, drive = drive.inertial, replace(drive, inertial=Inertial())
    cell_m, durations_s = plane_cell_m(drive.scans, config.leaf_size_m), np.diff(drive.times_s)
    tracked: list[Tracked] = []
    for i in tqdm(range(_PASSES), desc="odometry", unit="pass", disable=hides_bar(progress)):
        found = [*track_once(drive, Tracker(cell_m, config, drive.window))]
        tracked, rates = [step for step, _ in found], [rates for _, rates in found[1:]]
        turn_rates, move_rates = [step.turn for step in rates], [step.move for step in rates]
        turns, moves = drive.turns, drive.moves
        if i == 0 and drive.usual_turn_rad_s < SLOW_TURN_RAD_S and tracked[-1].segment > 0:
            # Tracking was lost. Narrow the search of the next passes.
            usual = np.full(3, drive.usual_turn_rad_s**2)
            turns = MotionPrior(usual, usual, True)
        steady_moves = moves.learnt(move_rates, durations_s, with_errors=True)
        steady_turns = turns.learnt(turn_rates, durations_s, with_errors=True)
        turns, moves = turns.learnt(turn_rates, durations_s), moves.learnt(move_rates, durations_s)
        turn = turns.after(next(reversed(turn_rates[:WINDOW]), None), float(durations_s[:WINDOW].sum()))
        drive = replace(drive, turns=turns, moves=moves, steady=(steady_moves, steady_turns), first_turn=turn)
        if i == 0 and isinstance(drive.velocities, BodyVelocities):
            drive = replace(drive, velocities=drive.velocities.learnt(turn_rates))
        if i == 0:
            # Rotations tracked with the gyroscope would not reveal its bias.
            drive = replace(drive, inertial=inertial.learnt(turn_rates))
    return drive, tracked


def track_once(drive: Drive, tracker: Tracker) -> Iterator[tuple[Tracked, Rates]]:
    """Track all scans in one pass: yield each, and the rates of the step to it; of the first one, the known ones."""
    now, last = Tracked(np.eye(4)), Rates(drive.first_turn)
    for i, scan in enumerate(drive.scans):
        if i:
            before, predicted = now, drive.predict(i, last)
            now = tracker.register(scan, predicted)
            if now.segment != before.segment:
                last = Rates()
            elif predicted.duration_s > 0:
                last = rates_of(before.pose, now, predicted.duration_s)
            else:  # two radars measured at once
                last = last._replace(duration_s=0.0)
        tracker.add(scan, now)
        yield now, last


def rates_of(before: Floats, now: Tracked, duration_s: float) -> Rates:
    """Compute the rates of the step from pose `before` (4, 4)."""
    back = before[:3, :3].T
    half = rotation(0.5 * now.turn).T @ back
    of_way = half @ now.covariance[:3, :3] @ half.T / duration_s**2
    of_turn = back @ now.covariance[3:, 3:] @ back.T / duration_s**2
    translation = half @ (now.pose[:3, 3] - before[:3, 3])
    move = MotionRate(translation / duration_s, of_way)
    return Rates(MotionRate(now.turn / duration_s, of_turn), move, duration_s)
