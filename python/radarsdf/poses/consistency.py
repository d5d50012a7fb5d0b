"""Consistency of Doppler and times with the returns of a drive, by window of scans."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from radarsdf.arrays import Bools, Floats, Ints
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import LEAST_M, Gain, of_neighbours
from radarsdf.poses.displacements import (
    BY_CHANCE,
    FEWEST_STEPS,
    MOST_LATE,
    Clock,
    OtherMotion,
    delay_of,
    delayed_words,
    runs_of,
    windows_of,
)
from radarsdf.poses.doppler import NOT_USED, DopplerMotion, SensorVelocities
from radarsdf.poses.planes import plane_cell_m
from radarsdf.poses.rigid import assembled, rotation, steps
from radarsdf.poses.tracking import Drive, Tracker, track_once

_SAMPLED, _PAIRS = 100, 48  # returns of a scan, and maximum number of pairs of scans to compare
_DELAYED = 24  # steps to compare with delayed ones
_COMPARED_M = 1.5  # minimum motion between them: of less, the noise of the returns hides a tenth
# Prior deviations of velocities, share of the speed: along them, so that returns of most scenes converge from half or twice the true
# ones, and across.
_FREE_SCALE, _FREE_ACROSS = 0.15, 0.04
_SCALES = np.geomspace(0.4, 2.5, 17)
_SAME = len(_SCALES) // 2
_SAME_TRACKED = 0.05  # relative difference of tracked steps and right Doppler: simulated scenes up to 0.02
_SHIFTS_M = np.concatenate(
    [np.outer([sign * 4.0, sign * 2.0, sign], axis) for sign in (1, -1) for axis in np.eye(3)[:2]]
)
# Ratio of the speeds by returns and by Doppler that the estimate may be wrong by: 1.06 for a sparse radar.
_SAME_SCALE = 1.1
_MEASURED = 0.2  # relative difference from the Doppler beyond which confidence limits leave its scale open
_UNKNOWN_SCALE = 0.5  # standard deviation of the scale without evidence: half or twice the speed
_MOSTLY = 0.8  # share of steps without motion by Doppler from which on returns must confirm it
_LEAST_SEEN = 0.5  # share of a step's prior variance that the returns remove, if their difference counts
_STILL_MPS = 0.1  # slower Doppler, in which compensation for ego motion leaves only noise, tells no direction


@dataclass(frozen=True)
class Consistency:
    """Comparison of a drive's Doppler with its returns."""

    delay: int = 0  # of the Doppler, scans, where one explains the returns significantly better
    possible_delays: tuple[int, ...] = ()  # not excluded
    contradicted: OtherMotion | None = None  # in a window
    clock: Clock | None = None
    doubts: tuple[OtherMotion, ...] | None = None  # not excluded. None: too few scans with motion

    @classmethod
    def of_returns(cls, drive: Drive, config: FitConfig, num_threads: int) -> Consistency:
        """Compare scans, tracked with velocities that are hardly known; without enough of them, nothing is known."""
        durations_s, velocities = np.diff(drive.times_s), drive.velocities
        if velocities is None or len(durations_s) < FEWEST_STEPS:
            return cls()
        lengths_m = np.linalg.norm(velocities.mean_mps[:-1], axis=1) * durations_s
        most_apart = max(len(lengths_m) // (2 * FEWEST_STEPS), 1)
        every = int(np.clip(_COMPARED_M / max(np.median(lengths_m), 1e-9), 1, most_apart))
        rows = np.arange(0, len(durations_s) + 1, every)
        compared, times_s = velocities.select(rows), drive.times_s[rows]
        scans = [drive.scans[i] for i in rows]
        free = compared.scaled(1.0, _FREE_SCALE)
        free.covariance[:] += (_FREE_ACROSS * compared.usual_mps) ** 2 * np.eye(3)
        tracker = Tracker(plane_cell_m(scans, config.leaf_size_m), config.returns, num_threads)
        yaws = drive.yaws if every == 1 else None
        tracked, _ = track_once(Drive(scans, times_s, free, None, yaws=yaws), tracker)
        seen = np.array([len(scan) > 0 for scan in scans])
        usable = (np.diff(runs_of(times_s)) == 0) & seen[1:] & seen[:-1]
        if usable.sum() < FEWEST_STEPS:
            return cls()
        followed = usable & (np.diff([found.segment for found in tracked]) == 0)
        poses = np.stack([found.pose for found in tracked])
        motion = DopplerMotion.by(compared, times_s, poses)
        own, shown, axes = motion.steps[:, :3, 3], steps(poses)[:, :3, 3], poses[:-1, :3, :3]
        in_world = np.stack([found.covariance[:3, :3] for found in tracked[1:]])
        covariance = np.einsum("fji,fjk,fkl->fil", axes, in_world, axes)  # of `shown`, m²
        along = np.where(followed, _relative_differences(shown, covariance, motion, free), np.nan)
        rows_of_pairs = np.flatnonzero(usable)  # also where tracking was lost: by wrong Doppler, it may be
        rows_of_pairs = rows_of_pairs[:: -(-len(rows_of_pairs) // _PAIRS)]
        pairs = _Pairs.of(scans, motion, along, rows_of_pairs, None if yaws is None else yaws[1])
        delay, possible = 0, tuple[int, ...]()
        if every <= MOST_LATE:
            # The fastest steps: of slow ones, errors of the returns seem delays.
            lengths_m, count = np.linalg.norm(own, axis=1) * usable, min(_DELAYED, len(usable))
            begin = int(np.argmax(np.convolve(lengths_m, np.ones(count), "valid")))
            fastest = followed & (np.abs(np.arange(len(usable)) - begin - (count - 1) / 2) < count / 2)
            before = free.step_covariances(motion.durations_s).diagonal(axis1=1, axis2=2)
            seen = (1 - covariance.diagonal(axis1=1, axis2=2) / before).clip(0, 1)
            runs = runs_of(drive.times_s)
            delay, possible = delay_of(velocities, runs, rows, motion, shown, covariance, seen, fastest)
        shown = own * (1 + np.nan_to_num(along)[:, None])
        clock = Clock.of(times_s, shown, own, np.isfinite(along)) if every == 1 else None
        found, doubts = _judged(pairs, rows[np.append(rows_of_pairs, rows_of_pairs[-1] + 1)])
        known = found is not None or (~pairs.slow).sum() >= FEWEST_STEPS
        return cls(delay, possible, found, clock, doubts if known else None)

    def widened(self, poses: Floats, covariance: Floats, segments: Ints, drive: Drive) -> Floats:
        """Return covariances (F, 6, 6), relative to the middle scan of each segment, that include motions in doubt."""
        assert drive.velocities is not None
        covariance, scans, velocities = covariance.copy(), np.arange(len(poses)), drive.velocities.mean_mps
        moving = velocities[np.linalg.norm(velocities, axis=1) >= _STILL_MPS]
        delays = np.array([0, *self.possible_delays])[:, None]  # equally likely
        delayed = velocities[np.clip(scans + delays, 0, scans[-1])]
        errors_mps = [*(delayed - velocities) / np.sqrt(len(delays))]
        for doubt in self.doubts or ():
            inside = ((scans > doubt.first) & (scans <= doubt.last))[:, None]
            other = np.median(moving, axis=0) if doubt.ratio is None else (doubt.ratio - 1) * velocities
            errors_mps.append(inside * other / norm.ppf(1 - BY_CHANCE))
        durations_s = np.diff(drive.times_s, prepend=drive.times_s[:1])[:, None]
        steps_m = durations_s * np.einsum("fij,dfj->dfi", poses[:, :3, :3], np.stack(errors_mps))
        off_m = np.cumsum(steps_m, axis=1)
        for segment in np.unique(segments):
            rows = np.flatnonzero(segments == segment)
            off = off_m[:, rows] - off_m[:, rows[len(rows) // 2], None]
            covariance[rows, :3, :3] += np.einsum("dfi,dfj->fij", off, off)
        return covariance

    def of_scans(self, rows: Ints) -> Consistency:
        """Return the same for the drive of which these scans, `rows` (K,), were compared."""

        def numbered(found: OtherMotion) -> OtherMotion:
            return dataclasses.replace(found, first=int(rows[found.first]), last=int(rows[found.last]))

        found, doubts = self.contradicted, self.doubts
        return dataclasses.replace(
            self,
            contradicted=None if found is None else numbered(found),
            doubts=None if doubts is None else tuple(map(numbered, doubts)),
        )

    def applied(self, velocities: SensorVelocities) -> tuple[SensorVelocities | None, list[str]]:
        """Return velocities with an open scale in their covariance, or None if returns contradict them; and notes."""
        if self.contradicted is not None:
            return None, [f"{NOT_USED}: {self.contradicted.words('the returns')}."]
        if self.delay:
            return None, [f"{NOT_USED}: {delayed_words('the returns', self.delay)}. Give each scan its own."]
        if self.doubts is None:
            velocities = dataclasses.replace(velocities, common_sigma=_UNKNOWN_SCALE)
            return velocities, ["Assumed: the Doppler is in m/s; too few scans with motion decide its scale."]
        if not self.doubts:
            return velocities, []
        scans = ", ".join(f"{doubt.first} to {doubt.last}" for doubt in self.doubts)
        return velocities, [f"Assumed: the Doppler is right; scans {scans} do not decide its scale."]


def _relative_differences(
    shown: Floats, covariance: Floats, motion: DopplerMotion, prior: SensorVelocities
) -> Floats:
    """Return differences (F - 1,) of tracked steps from those by Doppler, relative to these; NaN where returns hardly observe them."""
    own = motion.steps[:, :3, 3]
    along = np.einsum("ki,ki->k", shown - own, own) / np.maximum((own**2).sum(axis=1), 1e-12)
    before = np.einsum("ki,kij,kj->k", own, prior.step_covariances(motion.durations_s), own)
    left = np.einsum("ki,kij,kj->k", own, covariance, own)
    seen = 1 - left / np.maximum(before, 1e-30)
    # Without the share of the prior.
    return np.where(seen > _LEAST_SEEN, along / np.maximum(seen, _LEAST_SEEN), np.nan)


@dataclass(frozen=True)
class _Pairs:
    """K pairs of scans, and how well their returns agree with hypotheses of the motion between them."""

    # (K, S) how much nearer returns are after scales of the Doppler's step than after the reverse.
    gains: Floats
    # (K, T) how much nearer they are without a step than after shifts, of which the second half is opposite to the first.
    losses: Floats
    moved: Floats  # (K,) how much nearer they are after the Doppler's step than without one
    along: Floats  # (K,) relative differences of tracked steps and Doppler. NaN where returns hardly observe them
    slow: Bools  # (K,) whether there is no motion by Doppler

    @classmethod
    def of(
        cls, scans: list[Floats], motion: DopplerMotion, along: Floats, rows: Ints, yaws: Floats | None
    ) -> _Pairs:
        """Compare the returns of scans `rows` (K,) with those of the next ones, at the rotations of tracked poses.

        `yaws` (F - 1,): those with which returns agree best after the reverse of the steps.
        """
        scales, agreement = len(_SCALES), of_neighbours(scans, _SAMPLED)
        gains, losses, moved = [], [], []
        for i in rows.tolist():
            step_m = np.multiply.outer(_SCALES, motion.steps[i, :3, 3])
            shifts_m = np.concatenate([step_m, -step_m, np.zeros((1, 3)), _SHIFTS_M])
            turns = [motion.steps[i, :3, :3]]
            if yaws is not None and np.isfinite(yaws[i]):
                turns.append(rotation(np.array([0.0, 0.0, yaws[i]])))
            both = [assembled(np.tile(turn, (len(shifts_m), 1, 1)), shifts_m) for turn in turns]
            logs = [agreement.log_distances(i + 1, i, T).mean(axis=1) for T in both]
            apart = np.min(logs, axis=0)
            ahead, back, still, shifted = np.split(apart, [scales, 2 * scales, 2 * scales + 1])
            gains.append(back - ahead)
            losses.append(shifted - still)
            moved.append(still[0] - ahead[_SAME])
        slow = np.linalg.norm(motion.velocities.mean_mps[rows], axis=1) < _STILL_MPS
        return cls(np.array(gains), np.array(losses), np.array(moved), along[rows], slow)

    def select(self, rows: slice | Bools) -> _Pairs:
        return _Pairs(*(column[rows] for column in vars(self).values()))

    def __len__(self) -> int:
        return len(self.slow)

    def tracked(self, level: float) -> tuple[float, float]:
        """Return the mean relative difference of tracked steps, and its confidence limits. Infinite ones if too few are known."""
        shares = self.along[np.isfinite(self.along)]
        if len(shares) < FEWEST_STEPS:
            return 0.0, np.inf
        mean = Gain.of(shares)
        return float(mean.mean), float(student.ppf(1 - level, mean.count - 1) * mean.error)

    def others(self, level: float) -> Iterator[tuple[float, float]]:
        """Yield the evidence of other motions than that by Doppler, significant above 1, and the ratios of their speeds to its."""
        yield -float(Gain.of(self.gains[:, _SAME]).excess(level)), -1.0
        share, limit = self.tracked(level)
        means = self.gains.mean(axis=0)
        best, here = int(means.argmax()), _SAME - 1 + int(means[_SAME - 1 : _SAME + 2].argmax())
        # Of a radar that is too narrow, gains increase up to the end of the scales.
        if best not in (here, 0, len(_SCALES) - 1) and abs(share) + limit >= _SAME_SCALE - 1:
            loss = self.gains[:, best] - self.gains[:, here]
            yield float(Gain.of(loss).excess(level / len(_SCALES))), float(_SCALES[best])
        # Tracking of sparse scans may follow a pattern that moves with the sensor: the gains decide.
        other = int(np.abs(np.log(_SCALES / max(1 + share, _SCALES[0]))).argmin())
        gains = self.gains[np.isfinite(self.along)]
        if other == _SAME or (len(gains) >= FEWEST_STEPS and (gains[:, other] - gains[:, _SAME]).mean() > 0):
            yield (abs(share) - _SAME_TRACKED) / max(limit, 1e-9), 1 + share

    @property
    def farthest(self) -> float:
        """Ratio of speeds to those by Doppler of the most different motion that the returns do not exclude."""
        own = self.gains[:, _SAME]
        if Gain.of(own).excess(BY_CHANCE) < 1:
            return -1.0
        possible = _SCALES[Gain.of(own[:, None] - self.gains).excess(BY_CHANCE) <= 1]
        share, limit = self.tracked(BY_CHANCE)
        return 1 + min(float(np.abs(possible - 1).max(initial=0)), abs(share) + limit)


def _judged(pairs: _Pairs, scans: Ints) -> tuple[OtherMotion | None, tuple[OtherMotion, ...]]:
    """Judge Doppler by window of pairs, between scans (K + 1,): return the clearest contradiction, and motions not excluded."""
    tried = list(windows_of(len(pairs)))
    level = BY_CHANCE / len(tried)
    contradictions, doubts = list[tuple[bool, float, OtherMotion]](), list[OtherMotion]()
    # In a tunnel, the pattern of the returns moves with the sensor, and confirms that a moving one stands still.
    moving = pairs.select(~pairs.slow)
    pattern_moves = len(moving) >= FEWEST_STEPS and Gain.of(moving.moved).excess(BY_CHANCE) < 1
    for rows in tried:
        window, first, last = pairs.select(rows), int(scans[rows.start]), int(scans[rows.stop])
        still, moving = window.select(window.slow), window.select(~window.slow)
        found = list[tuple[bool, float, float | None]]()
        if len(still) >= max(FEWEST_STEPS, _MOSTLY * len(window)):
            if pattern_moves:
                doubts.append(OtherMotion(first, last, None, confirmed=False))
            losses, of_each = still.losses, level / len(_SHIFTS_M)
            opposite = np.subtract(*np.split(losses, 2, axis=1))
            # After a motion d, log distances after opposite shifts s differ by log((s + d) / (s - d)), about 2 d / s.
            shifts_m = np.linalg.norm(_SHIFTS_M[: opposite.shape[1]], axis=1)
            moved_m = np.abs(opposite.mean(axis=0)) * shifts_m / 2
            evidence = np.where(moved_m > LEAST_M, np.abs(Gain.of(opposite).excess(of_each)), 0.0)
            found.append((True, float(evidence.max()), None))
            # Stationary for a part of the drive, sparse scans of a slow sensor cannot confirm it.
            if 2 * len(window) >= len(pairs) - 1:
                found.append((False, 2 - float(Gain.of(losses).excess(of_each).min()), None))
        if len(moving) >= FEWEST_STEPS:
            found += [(True, *other) for other in moving.others(level)]
            if abs(moving.farthest - 1) > _MEASURED:
                doubts.append(OtherMotion(first, last, moving.farthest, confirmed=False))
        for confirmed, excess, ratio in found:
            if excess > 1:
                contradictions.append((confirmed, excess, OtherMotion(first, last, ratio, confirmed)))
    clearest = max(contradictions, key=lambda one: one[:2])[2] if contradictions else None
    return clearest, tuple(doubts)
