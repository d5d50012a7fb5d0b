"""Consistency of Doppler and times with the motion that returns, or given poses, show, by window of scans."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from radarsdf.arrays import Bools, Floats, Ints
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import ERRORS, LEAST_M, Agreement, Gain, of_neighbours
from radarsdf.poses.checked_scans import CheckedScans
from radarsdf.poses.doppler import (
    BY_CHANCE,
    FEWEST_STEPS,
    NOT_USED,
    DopplerMotion,
    SensorVelocities,
    slope_of,
    windows_of,
)
from radarsdf.poses.planes import Tracked, plane_cell_m
from radarsdf.poses.rigid import assembled, rotation, steps
from radarsdf.poses.tracking import Drive, Tracker, track_once

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
        root = np.sqrt(weights / np.maximum(lengths, 1e-9))
        share, error, _ = slope_of(root * lengths, root * along)
        needed = student.ppf(1 - BY_CHANCE / (2 * len(tried)), len(shown) - 1) * error
        if abs(share) <= max(needed, ERRORS / np.sqrt(information)) + _SAME_SPEED:
            continue
        if (excess := abs(share) - needed) > worst:
            by_doppler = float((weights * np.einsum("ki,ki->k", doppler, longer)).sum())
            by_other = float((weights * np.einsum("ki,ki->k", shown, longer)).sum())
            ratio = by_other / by_doppler if abs(by_doppler) > 0.05 * abs(by_other) else None
            worst, found = excess, OtherMotion(int(scans[rows.start]), int(scans[rows.stop]), ratio)
    return found


def _unevenness_m2(shown_m: Floats) -> float:
    """Return the variance of a component of steps (K, 3): where the sensor moves evenly, second differences have six times it."""
    return float(np.median(np.diff(shown_m, 2, axis=0) ** 2) / 6) if len(shown_m) > 2 else 0.0


@dataclass(frozen=True)
class Clock:
    """Errors of the times of scans."""

    errors_s: Floats  # (F,) to subtract
    sigma_s: float = 0.0  # standard deviation where it is undecided whether times or firing are uneven

    @classmethod
    def of(cls, times_s: Floats, shown_m: Floats, doppler_m: Floats, known: Bools) -> "Clock":
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
        share, error, _ = slope_of(uneven_s, missing_s)
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
    runs: Ints,
    rows: Ints,
    motion: DopplerMotion,
    shown: Floats,
    covariance: Floats,
    seen: Floats,
    followed: Bools,
) -> tuple[int, tuple[int, ...]]:
    """Return the delay, scans, of the Doppler with which steps (K, 3) by another source agree best, if significantly; else 0.

    And those that are not excluded. `velocities` and `runs` without a gap: of all scans; `motion`: of scans `rows`; `covariance` (K, 3, 3): of
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
        # Longer delays are compared in so few steps that most drives would not exclude them, and some seem to show them.
        if (count := int(used.sum())) < FEWEST_STEPS or 3 * count <= 2 * followed.sum():
            continue
        delayed = replace(motion.velocities, mean_mps=velocities.mean_mps[at])
        turned = replace(motion, velocities=delayed).turned(motion.steps[:, :3, :3])
        later = turned.steps[:, :3, 3]
        moves = own, shown - own, later - own, seen * (later - own)
        scaled, *others = (np.einsum("fij,fj->fi", whitening, each)[used] for each in moves)
        # Without the part that a wrong scale explains.
        square = max((scaled**2).sum(), 1e-12)
        left, change, expected = (v - scaled * (v * scaled).sum() / square for v in others)
        share, _, remaining = slope_of(change, left)
        needed = student.ppf(1 - BY_CHANCE / (2 * MOST_LATE), count - 1)
        delays, expected_error, _ = slope_of(expected, left)
        # Noise of the Doppler alone, which is a part of both, shows half of any delay where the velocity is constant: 5 scans on a motorway.
        # Other errors of the displacements change with speed, too: by less than half, or several times as much as a delay explains.
        likely = share > 0.5 and needed * expected_error < delays - 0.5 < 1
        if likely and (left**2).sum() > _SAME_RESIDUALS * (remaining**2).sum():
            found.append((float((remaining**2).sum()) / count, delay))
        if delays + needed * expected_error >= 1:
            possible.append(delay)
    return min(found)[1], tuple(possible)


_SAMPLED, _PAIRS = 100, 48  # returns of a scan, and maximum number of pairs of scans to compare
_DELAYED = 24  # steps to compare with delayed ones
_COMPARED_M = 1.5  # minimum motion between them: of less, the noise of the returns hides a tenth
# Prior deviations of velocities, share of the speed: along them (most scenes converge from half or twice the true ones), and across.
_FREE_SCALE, _FREE_ACROSS = 0.15, 0.04
_SCALES = np.geomspace(0.4, 2.5, 17)
_SAME = len(_SCALES) // 2
_SAME_TRACKED = 0.05  # relative difference of tracked steps and right Doppler: simulated scenes up to 0.02
_SHIFTS_M = np.kron([[1.0], [-1.0]], np.kron(np.eye(3)[:2], [[4.0], [2.0], [1.0]]))
# Ratio of the speeds by returns and by Doppler that the estimate may be wrong by: 1.06 for a sparse radar.
_SAME_SCALE = 1.1
_MEASURED = 0.1  # relative difference from the Doppler beyond which confidence limits leave its scale open
_UNKNOWN_SCALE = 0.5  # standard deviation of the scale without evidence: half or twice the speed
_MOSTLY = 0.8  # share of steps without motion by Doppler from which on returns must confirm it
_LEAST_SEEN = 0.5  # share of a step's prior variance that the returns remove, if their difference counts
_STILL_MPS = 0.1  # slower Doppler, in which compensation for ego motion leaves only noise, tells no direction


@dataclass(frozen=True)
class Consistency:
    """Comparison of a drive's Doppler and times with the motion that its returns, or given poses, show."""

    delay: int = 0  # of the Doppler, scans, where one explains this motion significantly better
    possible_delays: tuple[int, ...] = ()  # not excluded
    contradicted: OtherMotion | None = None  # in a window
    clock: Clock | None = None
    doubts: tuple[OtherMotion, ...] | None = None  # not excluded. None: too few scans with motion
    source: str = "the returns"

    @classmethod
    def of_poses(cls, velocities: SensorVelocities, times_s: Floats, poses: Floats) -> "Consistency":
        """Compare velocities and times (F,) with poses (F, 4, 4)."""
        shown, known = steps(poses)[:, :3, 3], velocities.found[:-1] & velocities.found[1:]
        clock = Clock.of(times_s, shown, DopplerMotion.by(velocities, times_s, poses).steps[:, :3, 3], known)
        times_s = times_s - clock.errors_s
        motion, scans = DopplerMotion.by(velocities, times_s, poses), np.arange(len(times_s))
        ends = np.append(scans[:-1][known], scans[1:][known][-1:])
        variances_m2 = motion.shares[known, :3].mean(axis=1)
        found = contradiction(shown[known], motion.steps[known, :3, 3], variances_m2, ends)
        covariance = np.tile(_unevenness_m2(shown) * np.eye(3), (len(shown), 1, 1))
        every = velocities, runs_of(times_s), scans, motion, shown, covariance, np.ones(3), known
        return cls(0 if found else delay_of(*every)[0], (), found, clock, (), "the poses")

    @classmethod
    def of_returns(cls, drive: Drive, config: FitConfig) -> "Consistency":
        """Compare scans, tracked with velocities that are hardly known; without enough of them, nothing is known."""
        return next(filter(None, cls.in_steps(drive, config)))

    @classmethod
    def in_steps(cls, drive: Drive, config: FitConfig) -> Iterator["Consistency | None"]:
        """Yield None after each step of :meth:`of_returns`, of a few milliseconds, and the result after the last."""
        durations_s, velocities = np.diff(drive.times_s), drive.velocities
        if velocities is None or len(durations_s) < FEWEST_STEPS:
            yield cls()
            return
        lengths_m = np.linalg.norm(velocities.mean_mps[:-1], axis=1) * durations_s
        most_apart = max(len(lengths_m) // (2 * FEWEST_STEPS), 1)
        every = int(np.clip(_COMPARED_M / max(np.median(lengths_m), 1e-9), 1, most_apart))
        rows = np.arange(0, len(durations_s) + 1, every)
        compared, times_s = velocities.select(rows), drive.times_s[rows]
        scans = [drive.scans[i] for i in rows]
        free = compared.scaled(1.0, _FREE_SCALE)
        free.covariance[:] += (_FREE_ACROSS * compared.usual_mps) ** 2 * np.eye(3)
        tracker = Tracker(plane_cell_m(scans, config.leaf_size_m), config)
        sampled = drive if every == 1 else Drive(scans, times_s, None)  # turns are known between neighbours
        tracked, apart, agreement = list[Tracked](), list[Floats](), of_neighbours(scans, _SAMPLED)
        for step, _ in track_once(replace(sampled, velocities=free), tracker):
            tracked.append(step)
            yield None
        filled = np.array([len(scan) > 0 for scan in scans])
        usable = (np.diff(runs_of(times_s)) == 0) & filled[1:] & filled[:-1]
        if usable.sum() < FEWEST_STEPS:
            yield cls()
            return
        followed = usable & (np.diff([step.segment for step in tracked]) == 0)
        poses = np.stack([step.pose for step in tracked])
        motion = DopplerMotion.by(compared, times_s, poses)
        own, shown, axes = motion.steps[:, :3, 3], steps(poses)[:, :3, 3], poses[:-1, :3, :3]
        in_world = np.stack([step.covariance[:3, :3] for step in tracked[1:]])
        covariance = np.einsum("fji,fjk,fkl->fil", axes, in_world, axes)  # of `shown`, m²
        # Differences relative to the Doppler, without the share of the prior. NaN where returns hardly observe them.
        before = free.step_covariances(motion.durations_s)
        left, prior = (np.einsum("ki,kij,kj->k", own, each, own) for each in (covariance, before))
        seen = 1 - left / np.maximum(prior, 1e-30)
        along = np.einsum("ki,ki->k", shown - own, own) / np.maximum((own**2).sum(axis=1), 1e-12)
        along = np.where(followed & (seen > _LEAST_SEEN), along / np.maximum(seen, _LEAST_SEEN), np.nan)
        rows_of_pairs = np.flatnonzero(usable)  # also where tracking was lost: by wrong Doppler, it may be
        rows_of_pairs = rows_of_pairs[:: -(-len(rows_of_pairs) // _PAIRS)]
        for i in rows_of_pairs.tolist():
            apart.append(_distances(agreement, motion, i, sampled.yaws))
            yield None
        pairs = _Pairs.of(np.stack(apart), along[rows_of_pairs])
        delay, possible = 0, tuple[int, ...]()
        if every <= MOST_LATE:
            # The fastest steps: of slow ones, errors of the returns seem delays.
            lengths_m, count = np.linalg.norm(own, axis=1) * usable, min(_DELAYED, len(usable))
            begin = int(np.argmax(np.convolve(lengths_m, np.ones(count), "valid")))
            fastest = followed & (np.abs(np.arange(len(usable)) - begin - (count - 1) / 2) < count / 2)
            seen = (1 - np.divide(*(of.diagonal(axis1=1, axis2=2) for of in (covariance, before)))).clip(0, 1)
            runs = runs_of(drive.times_s)
            delay, possible = delay_of(velocities, runs, rows, motion, shown, covariance, seen, fastest)
        shown = own * (1 + np.nan_to_num(along)[:, None])
        clock = Clock.of(times_s, shown, own, np.isfinite(along)) if every == 1 else None
        found, doubts = _judged(pairs, rows[np.append(rows_of_pairs, rows_of_pairs[-1] + 1)])
        known = found or (~pairs.slow).sum() >= FEWEST_STEPS
        yield cls(delay, possible, found, clock, doubts if known else None)

    def widened(self, rows: Ints, poses: Floats, covariance: Floats, segments: Ints, drive: Drive) -> Floats:
        """Return covariances (F, 6, 6), relative to the middle scan of each segment, that include motions in doubt.

        `rows` (K,): the scans of the drive that were compared.
        """
        assert drive.velocities is not None
        covariance, scans, velocities = covariance.copy(), np.arange(len(poses)), drive.velocities.mean_mps
        moving = velocities[np.linalg.norm(velocities, axis=1) >= _STILL_MPS]
        delays = np.array([0, *self.possible_delays])[:, None]  # equally likely
        delayed = velocities[np.clip(scans + delays, 0, scans[-1])]
        errors_mps = [*(delayed - velocities) / np.sqrt(len(delays))]
        for doubt in self.doubts or ():
            inside = ((scans > rows[doubt.first]) & (scans <= rows[doubt.last]))[:, None]
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

    @property
    def contradiction(self) -> str | None:
        """What contradicts the Doppler, in words."""
        if self.contradicted is not None:
            return self.contradicted.words(self.source)
        when = f"{abs(self.delay)} scans {'later' if self.delay > 0 else 'earlier'}"
        return f"{self.source} agree with that of {when}" if self.delay else None

    def applied(self, velocities: SensorVelocities) -> tuple[SensorVelocities | None, list[str]]:
        """Return velocities with an open scale in their covariance, or None if they are contradicted; and notes."""
        if velocities.offset is not None:
            added = "{:.2f} m/s are added to that of all returns from scan {} to {}."
            return None, [f"{NOT_USED}: {added.format(*velocities.offset)}"]
        if (why := self.contradiction) is not None:
            remedy = " Give each scan its own." if self.delay else ""
            if self.source == "the poses":
                remedy = " If it is right, leave the poses out: radarsdf.odometry"
            return None, [f"{NOT_USED}: {why}.{remedy}"]
        if self.doubts is None:
            velocities = replace(velocities, common_sigma=_UNKNOWN_SCALE)
            return velocities, ["Assumed: the Doppler is in m/s; too few scans with motion decide its scale."]
        scans = ", ".join(f"{doubt.first} to {doubt.last}" for doubt in self.doubts)
        note = f"Assumed: the Doppler is right; scans {scans} do not decide its scale."
        return velocities, [note] if self.doubts else []

    def corrected(self, checked: CheckedScans) -> CheckedScans:
        """Return scans with the velocities and times to use, and notes."""
        if checked.velocities is None:
            return checked
        (velocities, notes), times_s, yaws = self.applied(checked.velocities), checked.times_s, checked.yaws
        if velocities is None:
            yaws = None
        elif self.clock is not None:
            times_s, notes = times_s - self.clock.errors_s, [*notes, *self.clock.note]
            velocities = replace(velocities, clock_sigma_s=self.clock.sigma_s)
        notes = [*checked.notes, *notes]
        return replace(checked, times_s=times_s, velocities=velocities, notes=notes, yaws=yaws)


@dataclass(frozen=True)
class _Pairs:
    """K pairs of scans, and how well their returns agree with hypotheses of the motion between them."""

    # (K, S) how much nearer returns are after scales of the Doppler's step than after the reverse. NaN if slow
    gains: Floats
    # (K, T) how much nearer they are without a step than after shifts, of which the second half is opposite to the first. NaN if not slow
    losses: Floats
    moved: Floats  # (K,) how much nearer they are after the Doppler's step than without one. NaN if slow
    along: Floats  # (K,) relative differences of tracked steps and Doppler. NaN where returns hardly observe them
    slow: Bools  # (K,) whether there is no motion by Doppler

    @classmethod
    def of(cls, apart: Floats, along: Floats) -> "_Pairs":
        """Build from the distances (K, H) that :func:`_distances` yields for K pairs, and `along` (K,)."""
        ahead, back, unmoved, shifted = np.split(apart, np.cumsum([len(_SCALES), len(_SCALES), 1]), axis=1)
        moved = unmoved[:, 0] - ahead[:, _SAME]
        return cls(back - ahead, shifted - unmoved, moved, along, np.isnan(moved))

    def select(self, rows: slice | Bools) -> "_Pairs":
        return _Pairs(*(column[rows] for column in vars(self).values()))

    def __len__(self) -> int:
        return len(self.slow)

    def tracked(self, level: float) -> tuple[float, float]:
        """Return the mean relative difference of tracked steps, and its confidence limits. Infinite ones if too few are known."""
        shares = self.along[np.isfinite(self.along)]
        if len(shares) < FEWEST_STEPS:
            return 0.0, np.inf
        mean = Gain.of_samples(shares)
        return float(mean.mean), float(student.ppf(1 - level, mean.count - 1) * mean.error)

    def others(self, level: float) -> Iterator[tuple[float, float]]:
        """Yield the evidence of other motions than that by Doppler, significant above 1, and the ratios of their speeds to its."""
        yield -float(Gain.of_samples(self.gains[:, _SAME]).excess(level)), -1.0
        share, limit = self.tracked(level)
        # Noise of returns that hides steps lets gains grow beyond the right scale, but nowhere faster than the scale.
        gains = self.gains / np.maximum(_SCALES, 1.0)
        means = gains.mean(axis=0)
        best, here = int(means.argmax()), _SAME - 1 + int(means[_SAME - 1 : _SAME + 2].argmax())
        # Of a radar that is too narrow, gains increase up to the end of the scales.
        if best not in (here, 0, len(_SCALES) - 1) and abs(share) + limit >= _SAME_SCALE - 1:
            loss = gains[:, best] - gains[:, here]
            yield float(Gain.of_samples(loss).excess(level / len(_SCALES))), float(_SCALES[best])
        # Tracking of sparse scans may follow a pattern that moves with the sensor: the gains decide.
        other = int(np.abs(np.log(_SCALES / max(1 + share, _SCALES[0]))).argmin())
        gains = self.gains[np.isfinite(self.along)]
        if other == _SAME or (len(gains) >= FEWEST_STEPS and (gains[:, other] - gains[:, _SAME]).mean() > 0):
            yield (abs(share) - _SAME_TRACKED) / max(limit, 1e-9), 1 + share

    @property
    def farthest(self) -> float:
        """Ratio of speeds to those by Doppler of the most different motion that the returns do not exclude."""
        own = self.gains[:, _SAME]
        if Gain.of_samples(own).excess(BY_CHANCE) < 1:
            return -1.0
        possible = _SCALES[Gain.of_samples(own[:, None] - self.gains).excess(BY_CHANCE) <= 1]
        share, limit = self.tracked(BY_CHANCE)
        return 1 + min(float(np.abs(possible - 1).max(initial=0)), abs(share) + limit)


def _distances(agreement: Agreement, motion: DopplerMotion, i: int, yaws: Floats | None) -> Floats:
    """Compare the returns of scan `i` with those of the next one, after motions with tracked rotations: mean log distances (H,).

    `yaws` (2, F - 1): as :attr:`Drive.yaws`. With the second ones, returns agree best after the reverse of the steps.
    """
    scales, step = len(_SCALES), motion.steps[i]
    apart, step_m = np.full(2 * scales + 1 + len(_SHIFTS_M), np.nan), np.multiply.outer(_SCALES, step[:3, 3])
    # A pair without motion by Doppler decides no scale, and others need no shifts.
    slow = np.linalg.norm(motion.velocities.mean_mps[i]) < _STILL_MPS
    tried = slice(2 * scales, None) if slow else slice(2 * scales + 1)
    shifts_m = np.concatenate([step_m, -step_m, np.zeros((1, 3)), _SHIFTS_M])[tried]
    turns = [step[:3, :3]]
    if yaws is not None and np.isfinite(yaws[1, i]):
        turns.append(rotation(np.array([0.0, 0.0, yaws[1, i]])))
    both = [assembled(np.tile(turn, (len(shifts_m), 1, 1)), shifts_m) for turn in turns]
    apart[tried] = np.min([agreement.log_distances(i + 1, i, T).mean(axis=1) for T in both], axis=0)
    return apart


def _judged(pairs: _Pairs, scans: Ints) -> tuple[OtherMotion | None, tuple[OtherMotion, ...]]:
    """Judge Doppler by window of pairs, between scans (K + 1,): return the clearest contradiction, and motions not excluded."""
    tried = list(windows_of(len(pairs)))
    level = BY_CHANCE / len(tried)
    against, doubts = list[tuple[bool, float, OtherMotion]](), list[OtherMotion]()
    # In a tunnel, the pattern of the returns moves with the sensor, and confirms that a moving one stands still.
    moving = pairs.select(~pairs.slow)
    pattern_moves = len(moving) >= FEWEST_STEPS and Gain.of_samples(moving.moved).excess(BY_CHANCE) < 1
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
            evidence = np.where(moved_m > LEAST_M, np.abs(Gain.of_samples(opposite).excess(of_each)), 0.0)
            found.append((True, float(evidence.max()), None))
            # Stationary for a part of the drive, sparse scans of a slow sensor cannot confirm it.
            if 2 * len(window) >= len(pairs) - 1:
                found.append((False, 2 - float(Gain.of_samples(losses).excess(of_each).min()), None))
        if len(moving) >= FEWEST_STEPS:
            found += [(True, *other) for other in moving.others(level)]
            if abs(moving.farthest - 1) > _MEASURED:
                doubts.append(OtherMotion(first, last, moving.farthest, confirmed=False))
        against += [(c, excess, OtherMotion(first, last, r, c)) for c, excess, r in found if excess > 1]
    clearest = max(against, key=lambda one: one[:2])[2] if against else None
    return clearest, tuple(doubts)
