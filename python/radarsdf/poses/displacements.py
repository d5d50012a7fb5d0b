"""Displacements and times by Doppler, compared with those that another source shows: given poses, or tracked returns."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from radarsdf.arrays import Bools, Floats, Ints
from radarsdf.poses.agreement import ERRORS
from radarsdf.poses.doppler import DopplerMotion, SensorVelocities
from radarsdf.poses.rigid import steps

BY_CHANCE = 0.01  # significance level of a contradiction, of all windows of a drive together
FEWEST_STEPS = 6  # of a window
MOST_LATE = 10  # maximum delay of the Doppler that is tried, scans
# Relative difference of speeds that axes and scale of a radar and given poses may have, ten times that of two motorway radars.
_SAME_SPEED = 0.03
_SAME_RESIDUALS = 1.25  # ratio of squared residuals up to which a delay does not matter
_EVEN = 1e-3  # unevenness of times that does not matter, share of an interval
_LEAST_STEP_M = 0.1  # minimum motion in a step that reveals its duration


@dataclass(frozen=True)
class OtherMotion:
    """Motion in a window of scans that another source shows, or does not exclude, instead of that by Doppler."""

    first: int  # scan
    last: int
    ratio: float | None  # of its speeds to those by Doppler. None: Doppler shows no motion
    confirmed: bool = True  # by the other source. Else this source observes neither motion nor its absence

    def words(self, source: str) -> str:
        scans = f"from scan {self.first} to {self.last}"
        if self.ratio is None:
            return f"{scans}, it shows no motion, which {source} do not confirm"
        return f"{scans}, {source} show {self.ratio:.2f} times its speeds"


def runs_of(times_s: Floats) -> Ints:
    """Number (F,) the runs of scans without a gap."""
    durations_s = np.diff(times_s)
    return np.append(0, np.cumsum(durations_s > 2 * np.median(durations_s)))


def windows_of(count: int) -> Iterator[slice]:
    """Yield all steps, their halves, quarters and so on, of at least `FEWEST_STEPS`."""
    parts = 1
    while count // parts >= FEWEST_STEPS:
        edges = np.linspace(0, count, parts + 1).astype(int).tolist()
        yield from (slice(a, b) for a, b in itertools.pairwise(edges))
        parts *= 2


def contradiction(
    shown_m: Floats, doppler_m: Floats, variances_m2: Floats, scans: Ints
) -> OtherMotion | None:
    """Test displacements (K, 3) of steps by another source and by Doppler, with variances (K,) of a component of the latter.

    In each window, the mean difference along the longer ones is compared with its standard error (Student's t). `scans` (K + 1,):
    those between which the steps are.
    """
    all_weights = 1 / (variances_m2 + _unevenness_m2(shown_m))  # the other source has errors, too
    worst, found, tried = 0.0, None, list(windows_of(len(shown_m)))
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
        needed = student.ppf(1 - BY_CHANCE / (2 * len(tried)), len(shown) - 1) * error
        if abs(share) <= max(needed, ERRORS / np.sqrt(information)) + _SAME_SPEED:
            continue
        if (excess := abs(share) - needed) > worst:
            by_doppler = float((weights * np.einsum("ki,ki->k", doppler, longer)).sum())
            by_other = float((weights * np.einsum("ki,ki->k", shown, longer)).sum())
            ratio = by_other / by_doppler if abs(by_doppler) > 0.05 * abs(by_other) else None
            worst, found = excess, OtherMotion(int(scans[rows.start]), int(scans[rows.stop]), ratio)
    return found


def compare_with_poses(
    velocities: SensorVelocities, times_s: Floats, poses: Floats
) -> tuple[str | None, Clock]:
    """Test velocities and times (F,) against poses (F, 4, 4). Return the clearest contradiction in words, and errors of the times."""
    shown, known = steps(poses)[:, :3, 3], velocities.found[:-1] & velocities.found[1:]
    clock = Clock.of(times_s, shown, DopplerMotion.by(velocities, times_s, poses).steps[:, :3, 3], known)
    times_s = times_s - clock.errors_s
    motion, scans = DopplerMotion.by(velocities, times_s, poses), np.arange(len(times_s))
    ends = np.append(scans[:-1][known], scans[1:][known][-1:])
    variances_m2 = motion.shares[known, :3].mean(axis=1)
    found = contradiction(shown[known], motion.steps[known, :3, 3], variances_m2, ends)
    if found is not None:
        return found.words("the poses"), clock
    covariance = np.tile(_unevenness_m2(shown) * np.eye(3), (len(shown), 1, 1))
    delay, _ = delay_of(velocities, runs_of(times_s), scans, motion, shown, covariance, np.ones(3), known)
    return (delayed_words("the poses", delay) if delay else None), clock


def _unevenness_m2(shown_m: Floats) -> float:
    """Return the variance of a component of steps (K, 3): where the sensor moves evenly, second differences have six times it."""
    return float(np.median(np.diff(shown_m, 2, axis=0) ** 2) / 6) if len(shown_m) > 2 else 0.0


def delayed_words(source: str, delay: int) -> str:
    return f"{source} agree with that of {abs(delay)} scans {'later' if delay > 0 else 'earlier'}"


@dataclass(frozen=True)
class Clock:
    """Errors of the times of scans."""

    errors_s: Floats  # (F,) to subtract
    sigma_s: float = 0.0  # standard deviation where it is undecided whether times or firing are uneven

    @classmethod
    def of(cls, times_s: Floats, shown_m: Floats, doppler_m: Floats, known: Bools) -> Clock:
        """Compare times (F,) with those of a radar that fires evenly: which explain the steps (F - 1, 3) that another source shows?"""
        durations_s, errors_s = np.diff(times_s), np.zeros(len(times_s))
        runs = runs_of(times_s)
        for run in np.unique(runs):
            rows = np.flatnonzero(runs == run)
            if len(rows) > FEWEST_STEPS:
                errors_s[rows] = times_s[rows] - np.polyval(np.polyfit(rows, times_s[rows], 1), rows)
        squares = np.maximum((doppler_m**2).sum(axis=1), 1e-12)
        missing_s = np.einsum("ki,ki->k", shown_m - doppler_m, doppler_m) / squares * durations_s
        used = known & (np.diff(runs) == 0) & (squares > _LEAST_STEP_M**2)
        uneven_s = -np.diff(errors_s)[used]
        if used.sum() < FEWEST_STEPS or uneven_s.std() < _EVEN * np.median(durations_s):
            return cls(np.zeros(len(times_s)))
        missing_s = missing_s[used] - np.median(missing_s[used])
        share, error, _ = _slope(uneven_s, missing_s)
        needed = student.ppf(1 - BY_CHANCE, used.sum() - 1) * error
        if share > needed:
            return cls(min(share, 1.0) * errors_s, float(min(needed, 1.0) * errors_s.std()))
        return cls(np.zeros(len(times_s)), float(errors_s.std()) if share + needed > 1 else 0.0)

    @property
    def note(self) -> list[str]:
        """Note on errors that are corrected, or undecided."""
        if self.errors_s.any():
            deviate = f"their times deviate by {1e3 * self.errors_s.std():.1f} ms, speeds do not"
            return [f"Assumed: scans are evenly spaced in time; {deviate}."]
        if self.sigma_s:
            wrong = f"times are wrong by {1e3 * self.sigma_s:.1f} ms, by which they are uneven"
            return [f"Assumed: {wrong}; speeds cannot decide."]
        return []


def delay_of(
    velocities: SensorVelocities,
    runs: Ints,  # of scans without a gap
    rows: Ints,
    motion: DopplerMotion,
    shown: Floats,
    covariance: Floats,
    seen: Floats,
    followed: Bools,
) -> tuple[int, tuple[int, ...]]:
    """Return the delay, scans, of the Doppler with which steps (K, 3) by another source agree best, if significantly; else 0.

    And those that are not excluded. `velocities` and `runs`: of all scans; `motion`: of scans `rows`; `covariance` (K, 3, 3): of
    `shown`; `seen` (K, 3): the shares of its differences from `motion` that it shows, since it has a prior from this motion.
    """
    # The steps by delayed Doppler explain the residuals of those by its own (J test, Davidson and MacKinnon 1981).
    covariance = covariance + motion.velocities.step_covariances(motion.durations_s)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    own = motion.steps[:, :3, 3]
    found, possible, last = [(np.inf, 0)], list[int](), len(velocities.mean_mps) - 1
    for delay in set(range(-MOST_LATE, MOST_LATE + 1)) - {0}:
        at = np.clip(rows + delay, 0, last)
        known = (at == rows + delay) & (runs[at] == runs[rows])
        used = followed & known[:-1] & known[1:]
        if (count := int(used.sum())) < FEWEST_STEPS:
            continue
        delayed = dataclasses.replace(motion.velocities, mean_mps=velocities.mean_mps[at])
        turned = dataclasses.replace(motion, velocities=delayed).turned(motion.steps[:, :3, :3])
        later = turned.steps[:, :3, 3]
        moves = own, shown - own, later - own, seen * (later - own)
        scaled, *others = (np.einsum("fij,fj->fi", whitening, each)[used] for each in moves)
        # Without the part that a wrong scale explains.
        left, change, expected = (
            v - scaled * (v * scaled).sum() / max((scaled**2).sum(), 1e-12) for v in others
        )
        share, error, remaining = _slope(change, left)
        needed = student.ppf(1 - BY_CHANCE / (2 * MOST_LATE), count - 1)
        # At a share of less than half, steps are nearer to their own Doppler: other errors of the displacements change with speed.
        if share > max(needed * error, 0.5) and (left**2).sum() > _SAME_RESIDUALS * (remaining**2).sum():
            found.append((float((remaining**2).sum()) / count, delay))
        share, error, _ = _slope(expected, left)
        # Longer delays are compared in so few steps that most drives would not exclude them.
        if share + needed * error >= 1 and 3 * count > 2 * followed.sum():
            possible.append(delay)
    return min(found)[1], tuple(possible)


def _slope(x: Floats, y: Floats) -> tuple[float, float, Floats]:
    """Regress y on x, (K,) or (K, 3), without intercept; return the slope, its standard error, and the residuals."""
    # Errors of the components of a step depend on each other: cluster-robust, with as many degrees of freedom as steps less one.
    count, square = len(x), max(float((x**2).sum()), 1e-12)
    slope = float((x * y).sum()) / square
    left = y - slope * x
    scores = (x * left).reshape(count, -1).sum(axis=1)
    return slope, float(np.sqrt((scores**2).sum() * count / (count - 1)) / square), left
