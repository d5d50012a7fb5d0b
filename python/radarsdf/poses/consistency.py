"""Consistency of Doppler and times with the motion that returns or poses show, by window of scans."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.doppler import (
    ERRORS,
    NOT_USED,
    DopplerMotion,
    SensorVelocities,
    log_distance_gains,
    shift_losses,
)
from radarsdf.poses.drive import Drive, track_once
from radarsdf.poses.planes import plane_cell_m
from radarsdf.poses.rigid import Floats, steps
from radarsdf.poses.tracking import Tracked, Tracker

_BY_CHANCE = 0.01  # significance level of a contradiction, of all windows of a drive together
_FEWEST_STEPS = 6  # of a window
# Relative difference of speeds that axes and scale of a radar and given poses may have, ten times that of two motorway radars.
_SAME_SPEED = 0.03
_PAIRS = 48  # maximum number of pairs of scans to compare
_DELAYED = 24  # steps to compare with delayed ones
_COMPARED_M = 1.5  # minimum motion between them: of less, the noise of the returns hides a tenth
# Prior deviations of velocities, share of the speed: along them, so that returns of most scenes converge from half or twice the true
# ones, and across.
_FREE_SCALE, _FREE_ACROSS = 0.15, 0.04
_SCALES = np.geomspace(0.4, 2.5, 17)
_BACK, _AHEAD = [0, 1, 2, 6, 7, 8], [5, 4, 3, 11, 10, 9]  # opposite shifts
_SAME = len(_SCALES) // 2
_SAME_TRACKED = 0.05  # relative difference of tracked steps and right Doppler: simulated scenes up to 0.02
_SHIFTS_M = np.concatenate(
    [np.outer([-4.0, -2.0, -1.0, 1.0, 2.0, 4.0], axis) for axis in ([1, 0, 0], [0, 1, 0])]
)
# Ratio of the speeds by returns and by Doppler that the estimate may be wrong by: 1.06 for a sparse radar.
_SAME_SCALE = 1.1
_SCALE_MEASURED = 1.2  # beyond which confidence limits of that ratio leave the scale of the Doppler open
_MOST_LATE = 10  # scans
_SAME_RESIDUALS = 1.25  # ratio of squared residuals up to which a delay does not matter
_EVEN = 1e-3  # unevenness of times that does not matter, share of an interval
_LEAST_STEP_M = 0.1  # minimum motion in a step that reveals its duration
_MOSTLY = 0.8  # share of steps without motion by Doppler from which on returns must confirm it
_LEAST_SEEN = 0.5  # share of a step's prior variance that the returns remove, if their difference counts
_STILL_MPS = 0.1  # slower Doppler, in which compensation for ego motion leaves only noise, tells no direction


@dataclass(frozen=True)
class Contradiction:
    """Window of scans in which Doppler and another source of motion exclude each other."""

    first: int  # scan
    last: int
    # Of the speeds by the other source to those by Doppler: infinite where Doppler shows no motion, NaN where this is undecided.
    ratio: float

    def words(self, source: str) -> str:
        """Describe in words, without a full stop."""
        if not np.isfinite(self.ratio):
            return f"from scan {self.first} to {self.last}, it shows no motion, which {source} do not confirm"
        return f"from scan {self.first} to {self.last}, {source} show {self.ratio:.2f} times its speeds"


def _runs(times_s: Floats) -> NDArray[np.int64]:
    """Number (F,) the runs of scans without a gap."""
    durations_s = np.diff(times_s)
    runs: NDArray[np.int64] = np.append(0, np.cumsum(durations_s > 2 * np.median(durations_s)))
    return runs


def _windows(count: int) -> Iterator[slice]:
    """Yield all steps, their halves, quarters and so on, of at least `_FEWEST_STEPS`."""
    parts = 1
    while count // parts >= _FEWEST_STEPS:
        edges = np.linspace(0, count, parts + 1).astype(int).tolist()
        yield from (slice(a, b) for a, b in itertools.pairwise(edges))
        parts *= 2


def contradiction(
    shown_m: Floats, doppler_m: Floats, variances_m2: Floats, scans: NDArray[np.int64]
) -> Contradiction | None:
    """Test displacements (K, 3) of steps by another source and by Doppler, with variances (K,) of a component of the latter.

    In each window, the mean difference along the longer ones is compared with its standard error (Student's t). `scans` (K + 1,):
    those between which the steps are.
    """
    # The other source has errors, too: where the sensor moves evenly, second differences have six times their variance.
    jumps = np.diff(shown_m, 2, axis=0) if len(shown_m) > 2 else np.zeros((1, 3))
    all_weights = 1 / (variances_m2 + np.median(jumps**2) / 6)
    worst, found, tried = 0.0, None, list(_windows(len(shown_m)))
    for rows in tried:
        shown, doppler, weights = shown_m[rows], doppler_m[rows], all_weights[rows]
        # Along the longer displacements: those of Doppler without ego motion, or of a stationary sensor, have no direction.
        longer = shown if (shown**2).sum() >= (doppler**2).sum() else doppler
        lengths = np.linalg.norm(longer, axis=1)
        information = (weights * lengths**2).sum()
        if information < 3 * ERRORS**2 * len(shown):
            continue
        along = np.einsum("ki,ki->k", shown - doppler, longer) / np.maximum(lengths, 1e-9)
        total = (weights * lengths).sum()
        share = float((weights * along).sum() / total)
        spread = weights * (along - share * lengths)
        error = float(np.sqrt((spread**2).sum() * len(shown) / (len(shown) - 1)) / total)
        needed = student.ppf(1 - _BY_CHANCE / (2 * len(tried)), len(shown) - 1) * error
        if abs(share) <= max(needed, ERRORS / np.sqrt(information)) + _SAME_SPEED:
            continue
        if (excess := abs(share) - needed) > worst:
            by_doppler, by_other = (
                float((weights * np.einsum("ki,ki->k", moves, longer)).sum()) for moves in (doppler, shown)
            )
            ratio = by_other / by_doppler if abs(by_doppler) > 0.05 * abs(by_other) else np.inf
            worst, found = excess, Contradiction(int(scans[rows.start]), int(scans[rows.stop]), ratio)
    return found


def of_poses(
    velocities: SensorVelocities, times_s: Floats, poses: Floats
) -> tuple[Contradiction | None, Clock]:
    """Test velocities and times (F,) against given poses (F, 4, 4); return the clearest contradiction, and errors of the times."""
    shown, known = steps(poses)[:, :3, 3], velocities.found[:-1] & velocities.found[1:]
    clock = Clock.of(times_s, shown, DopplerMotion.by(velocities, times_s, poses).steps[:, :3, 3], known)
    motion = DopplerMotion.by(velocities, times_s - clock.errors_s, poses)
    scans = np.append(np.flatnonzero(known), np.flatnonzero(known)[-1:] + 1)
    variances = motion.shares[known, :3].mean(axis=1)
    found = contradiction(shown[known], motion.steps[known, :3, 3], variances, scans)
    return found, clock


@dataclass(frozen=True)
class Clock:
    """Errors of the times of scans."""

    errors_s: Floats  # (F,) to subtract
    sigma_s: float = 0.0  # standard deviation where it is undecided whether times or firing are uneven

    @classmethod
    def of(cls, times_s: Floats, shown_m: Floats, doppler_m: Floats, known: NDArray[np.bool_]) -> Clock:
        """Compare times (F,) with those of a radar that fires evenly: which explain the steps (F - 1, 3) that another source shows?"""
        durations_s, errors_s = np.diff(times_s), np.zeros(len(times_s))
        runs = _runs(times_s)
        for run in np.unique(runs):
            rows = np.flatnonzero(runs == run)
            if len(rows) > _FEWEST_STEPS:
                errors_s[rows] = times_s[rows] - np.polyval(np.polyfit(rows, times_s[rows], 1), rows)
        squares = np.maximum((doppler_m**2).sum(axis=1), 1e-12)
        missing_s = np.einsum("ki,ki->k", shown_m - doppler_m, doppler_m) / squares * durations_s
        used = known & (np.diff(runs) == 0) & (squares > _LEAST_STEP_M**2)
        uneven_s = -np.diff(errors_s)[used]
        if used.sum() < _FEWEST_STEPS or uneven_s.std() < _EVEN * np.median(durations_s):
            return cls(np.zeros(len(times_s)))
        missing_s = missing_s[used] - np.median(missing_s[used])
        share = float((uneven_s * missing_s).sum() / (uneven_s**2).sum())
        scores = uneven_s * (missing_s - share * uneven_s)
        error = float(np.sqrt((scores**2).sum() * used.sum() / (used.sum() - 1)) / (uneven_s**2).sum())
        needed = student.ppf(1 - _BY_CHANCE, used.sum() - 1) * error
        if share > needed:
            return cls(min(share, 1.0) * errors_s, float(min(needed, 1.0) * errors_s.std()))
        return cls(np.zeros(len(times_s)), float(errors_s.std()) if share + needed > 1 else 0.0)

    @property
    def note(self) -> list[str]:
        """Note on errors that are corrected, or undecided."""
        if self.errors_s.any():
            return [
                f"Assumed: scans are evenly spaced in time; their times deviate by {1e3 * self.errors_s.std():.1f} ms, speeds do not."
            ]
        if self.sigma_s:
            return [
                f"Assumed: times are wrong by {1e3 * self.sigma_s:.1f} ms, by which they are uneven; speeds cannot decide."
            ]
        return []


@dataclass(frozen=True)
class Consistency:
    """Comparison of a drive's Doppler with its returns."""

    scale: float = 1.0  # ratio of the speeds by returns to those by Doppler
    least: float = float(_SCALES[0])  # confidence limits of this ratio
    most: float = float(_SCALES[-1])
    delay: int = 0  # of the Doppler, scans, where one explains the returns significantly better
    contradicted: Contradiction | None = None  # in a window
    clock: Clock | None = None
    # Relative difference of the speeds that tracking shows, but pairs of scans do not decide.
    undecided: float = 0.0

    @classmethod
    def of_returns(cls, drive: Drive, config: FitConfig, num_threads: int) -> Consistency:
        """Compare scans, tracked with velocities that are hardly known; without enough of them, nothing is known."""
        durations_s, velocities = np.diff(drive.times_s), drive.velocities
        if velocities is None or len(durations_s) < _FEWEST_STEPS:
            return cls()
        lengths_m = np.linalg.norm(velocities.mean_mps[:-1], axis=1) * durations_s
        most_apart = max(len(lengths_m) // (2 * _FEWEST_STEPS), 1)
        every = int(np.clip(_COMPARED_M / max(np.median(lengths_m), 1e-9), 1, most_apart))
        rows = np.arange(0, len(durations_s) + 1, every)
        compared, times_s = velocities.select(rows), drive.times_s[rows]
        scans = [drive.scans[i] for i in rows]
        free = compared.scaled(1.0, _FREE_SCALE)
        free.covariance[:] += (_FREE_ACROSS * compared.usual_mps) ** 2 * np.eye(3)
        tracker = Tracker(plane_cell_m(scans, config.leaf_size_m), config.returns, num_threads)
        tracked, _ = track_once(Drive(scans, times_s, free, None), tracker)
        segments, counts = np.array(
            [(found.segment, len(scan)) for found, scan in zip(tracked, scans, strict=True)]
        ).T
        usable = np.diff(_runs(times_s)) == 0
        usable &= np.minimum(counts[1:], counts[:-1]) > 0
        followed = (np.diff(segments) == 0) & usable
        if usable.sum() < _FEWEST_STEPS:
            return cls()
        poses = np.stack([found.pose for found in tracked])
        motion = DopplerMotion.by(compared, times_s, poses)
        pairs = np.flatnonzero(usable)  # also where tracking was lost: by wrong Doppler, it may be
        pairs = pairs[:: -(-len(pairs) // _PAIRS)]
        gains = np.array([_gains(scans[i], scans[i + 1], motion.steps[i]) for i in pairs])
        # The fastest steps: of slow ones, errors of the returns seem delays.
        ways_m, count = np.linalg.norm(motion.steps[:, :3, 3], axis=1) * usable, min(_DELAYED, len(usable))
        begin = int(np.argmax(np.convolve(ways_m, np.ones(count), "valid")))
        fastest = followed & (np.abs(np.arange(len(usable)) - begin - (count - 1) / 2) < count / 2)
        delay = (
            _delay(velocities, _runs(drive.times_s), rows, motion, tracked, fastest)
            if every <= _MOST_LATE
            else 0
        )
        slow = np.linalg.norm(compared.mean_mps, axis=1)[pairs] < _STILL_MPS
        along = np.where(followed, _relative_differences(tracked, motion, free), np.nan)[pairs]
        shown, own = steps(poses)[:, :3, 3], motion.steps[:, :3, 3]
        clock = Clock.of(times_s, shown, own, followed) if every == 1 else None
        window, undecided = _judged(gains, along, slow)
        if window is not None:
            first, last = pairs[window.first], pairs[min(window.last, len(pairs) - 1)] + 1
            window = dataclasses.replace(window, first=int(rows[first]), last=int(rows[last]))
        scale, least, most = 1.0, float(_SCALES[0]), float(_SCALES[-1])
        if (~slow).sum() >= _FEWEST_STEPS:
            scale, least, most = _scale(gains[~slow, : len(_SCALES)])
        if np.isfinite(along).sum() >= _FEWEST_STEPS and window is None:
            least, most = min(least, 1.0), max(most, 1.0)  # the windows decide
        return cls(scale, least, most, delay, window, clock, undecided)

    def applied(self, velocities: SensorVelocities) -> tuple[SensorVelocities | None, list[str]]:
        """Return velocities with an open scale in their covariance, or None if returns contradict them; and notes."""
        if self.contradicted is not None:
            return None, [f"{NOT_USED}: {self.contradicted.words('the returns')}."]
        if self.least > _SAME_SCALE or self.most < 1 / _SAME_SCALE:
            shown = f"the returns show {self.scale:.1f} times its speeds. Give it in m/s, and times in s"
            return None, [f"{NOT_USED}: {shown}."]
        if self.delay:
            shown = f"the returns agree with that of {abs(self.delay)} scans {'later' if self.delay > 0 else 'earlier'}"
            return None, [f"{NOT_USED}: {shown}. Give each scan its own."]
        wide = self.most > _SCALE_MEASURED or self.least < 1 / _SCALE_MEASURED
        if not wide and not self.undecided:
            return velocities, []
        shown = f"{min(self.least, 1 - self.undecided):.1f} to {max(self.most, 1 + self.undecided):.1f} times its speeds"
        doubt = max((self.most - 1) / ERRORS, (1 - self.least) / ERRORS, self.undecided)
        velocities = dataclasses.replace(velocities, common_sigma=doubt)
        return velocities, [f"Assumed: the Doppler is in m/s; the returns agree with {shown}."]


def _relative_differences(tracked: list[Tracked], motion: DopplerMotion, prior: SensorVelocities) -> Floats:
    """Return differences (F - 1,) of tracked steps from those by Doppler, relative to these; NaN where returns hardly observe them."""
    poses = np.stack([found.pose for found in tracked])
    own, shown = motion.steps[:, :3, 3], steps(poses)[:, :3, 3]
    along = np.einsum("ki,ki->k", shown - own, own) / np.maximum((own**2).sum(axis=1), 1e-12)
    priors = np.stack([prior.step_covariance(i, d) for i, d in enumerate(motion.durations_s.tolist())])
    before = np.einsum("ki,kij,kj->k", own, priors, own)
    left = np.einsum("ki,kij,kj->k", own, _step_covariances(tracked), own)
    seen = 1 - left / np.maximum(before, 1e-30)
    # Without the share of the prior.
    return np.where(seen > _LEAST_SEEN, along / np.maximum(seen, _LEAST_SEEN), np.nan)


def _step_covariances(tracked: list[Tracked]) -> Floats:
    """Return the covariances (F - 1, 3, 3) of translations between tracked scans, in the frame of the first, m²."""
    axes = np.stack([found.pose[:3, :3] for found in tracked[:-1]])
    of_steps = np.stack([found.covariance[:3, :3] for found in tracked[1:]])
    covariances: Floats = np.einsum("fji,fjk,fkl->fil", axes, of_steps, axes)
    return covariances


def _gains(first: Floats, second: Floats, step: Floats) -> Floats:
    """Return how much nearer returns of two scans are after scales of a step (4, 4) than after the reverse, and than after shifts."""
    turned = np.einsum("ni,ji->nj", second, step[:3, :3])
    gains = log_distance_gains(first, turned, np.multiply.outer(_SCALES, step[:3, 3]))
    return np.concatenate([gains, shift_losses(first, turned, _SHIFTS_M)])


def _judged(gains: Floats, along: Floats, slow: NDArray[np.bool_]) -> tuple[Contradiction | None, float]:
    """Judge Doppler by window of K pairs of scans; return the clearest contradiction, and the largest undecided one, a share.

    `gains` (K, S): of :func:`_gains`; `along` (K,): relative differences of tracked steps and Doppler, NaN where tracking was lost;
    `slow` (K,): pairs without motion by Doppler.
    """
    tried, count = list(_windows(len(gains))), len(_SCALES)
    found: list[tuple[float, slice, float]] = []  # excess over what is needed, window, ratio
    undecided = 0.0
    for rows in tried:
        moving, still = gains[rows][~slow[rows], :count], gains[rows][slow[rows], count:]
        level, steps_here = _BY_CHANCE / len(tried), len(moving) + len(still)
        # Stationary for a part of the drive, sparse scans of a slow sensor cannot confirm it.
        if len(still) >= max(_FEWEST_STEPS, _MOSTLY * steps_here) and 2 * steps_here >= len(gains) - 1:
            # Without motion by Doppler, which compensation for ego motion leaves, too, returns must agree less after any shift.
            level /= still.shape[1]
            needed = student.ppf(1 - level, len(still) - 1)
            confirmed = float(_t_values(still).min() / needed)
            moved = float(np.abs(_t_values(still[:, _BACK] - still[:, _AHEAD])).max() / needed)
            found.append((max(2 - confirmed, moved), rows, np.inf if moved > 1 else np.nan))
        if len(moving) < _FEWEST_STEPS:
            continue
        needed = float(student.ppf(1 - level, len(moving) - 1))
        found.append((-float(_t_values(moving[:, _SAME])) / needed, rows, -1.0))
        shares = along[rows][~slow[rows]]
        known = np.isfinite(shares)
        tracked, share, error = known.sum() >= _FEWEST_STEPS, 0.0, np.inf
        if tracked:
            share, error = float(shares[known].mean()), shares[known].std(ddof=1) / np.sqrt(known.sum())
        means = moving.mean(axis=0)
        best, here = int(means.argmax()), _SAME - 1 + int(means[_SAME - 1 : _SAME + 2].argmax())
        same = abs(share) + needed * error < _SAME_SCALE - 1
        # Of a radar that is too narrow, gains increase up to the end of the scales.
        if best != here and 0 < best < count - 1 and not same:
            loss = float(_t_values(moving[:, best] - moving[:, here]))
            found.append((loss / student.ppf(1 - level / count, len(moving) - 1), rows, _SCALES[best]))
        excess = (abs(share) - _SAME_TRACKED) / max(needed * error, 1e-9)
        if tracked and excess > 1:
            # Tracking of sparse scans may follow a pattern that moves with the sensor: the gains decide.
            other = int(np.abs(np.log(_SCALES / max(1 + share, _SCALES[0]))).argmin())
            better = float(_t_values(moving[known][:, other] - moving[known][:, _SAME]))
            if better > 0 or other == _SAME:
                found.append((excess, rows, 1 + share))
            elif better > -needed:
                undecided = max(undecided, abs(share))
    excess, rows, ratio = max(found, key=lambda one: one[0], default=(0.0, slice(0), 1.0))
    return Contradiction(rows.start, rows.stop, float(ratio)) if excess > 1 else None, undecided


def _t_values(samples: Floats) -> Floats:
    """Return the means over K samples (K, ...) in standard errors."""
    errors = samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
    found: Floats = samples.mean(axis=0) / np.maximum(errors, 1e-9)
    return found


def _scale(gains: Floats) -> tuple[float, float, float]:
    """Return the best scale by gains (K, S), and the limits of those that are not significantly worse."""
    best = int(np.argmax(gains.mean(axis=0)))
    losses = gains[:, best, None] - gains
    errors = losses.std(axis=0, ddof=1) / np.sqrt(len(gains))
    # The best of many scales is compared with each.
    needed = float(student.ppf(1 - _BY_CHANCE / len(_SCALES), len(gains) - 1))
    possible = _SCALES[losses.mean(axis=0) <= needed * errors]
    if best in (
        0,
        len(_SCALES) - 1,
    ):  # no maximum: of a radar that is too narrow, gains increase with the scale
        possible = _SCALES
    return float(_SCALES[best]), float(possible[0]), float(possible[-1])


def _delay(
    velocities: SensorVelocities,
    runs: NDArray[np.int64],  # of scans without a gap
    rows: NDArray[np.int64],
    motion: DopplerMotion,
    tracked: list[Tracked],
    followed: NDArray[np.bool_],
) -> int:
    """Return the delay, scans, of the Doppler with which steps by returns agree best, if significantly; else 0."""
    # The steps by delayed Doppler explain the residuals of those by its own (J test, Davidson and MacKinnon 1981).
    poses = np.stack([found.pose for found in tracked])
    covariance = _step_covariances(tracked)
    covariance += [motion.velocities.step_covariance(i, d) for i, d in enumerate(motion.durations_s.tolist())]
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    own, shown = motion.steps[:, :3, 3], steps(poses)[:, :3, 3]
    found, last = [(np.inf, 0)], len(velocities.mean_mps) - 1
    for delay in set(range(-_MOST_LATE, _MOST_LATE + 1)) - {0}:
        at = np.clip(rows + delay, 0, last)
        known = (at == rows + delay) & (runs[at] == runs[rows])
        used = followed & known[:-1] & known[1:]
        if (count := int(used.sum())) < _FEWEST_STEPS:
            continue
        delayed = dataclasses.replace(motion.velocities, mean_mps=velocities.mean_mps[at])
        later = dataclasses.replace(motion, velocities=delayed).at(poses).steps[:, :3, 3]
        scaled, left, change = (
            np.einsum("fij,fj->fi", whitening, moves)[used] for moves in (own, shown - own, later - own)
        )
        # Without the part that a wrong scale explains.
        left, change = (
            v - scaled * (v * scaled).sum() / max((scaled**2).sum(), 1e-12) for v in (left, change)
        )
        square = max(float((change**2).sum()), 1e-12)
        share = float((left * change).sum()) / square
        remaining = left - share * change
        # Errors of the components of a step depend on each other: cluster-robust, with as many degrees of freedom as steps less one.
        scores = (change * remaining).sum(axis=1)
        error = np.sqrt((scores**2).sum() * count / (count - 1)) / square
        needed = student.ppf(1 - _BY_CHANCE / (2 * _MOST_LATE), count - 1)
        if share > needed * error and (left**2).sum() > _SAME_RESIDUALS * (remaining**2).sum():
            found.append((float((remaining**2).sum()) / count, delay))
    return min(found)[1]
