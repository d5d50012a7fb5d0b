"""Tests of Doppler against returns: the scale of its speeds, and its delay."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.doppler import ERRORS, NOT_USED, DopplerMotion, SensorVelocities, scale_gains
from radarsdf.poses.planes import plane_cell_m
from radarsdf.poses.rigid import Floats, steps
from radarsdf.poses.tracking import Drive, Tracked, Tracker, tracked_once

# Pairs of scans to compare, the number from which on they are chosen to be apart, and their minimum.
_COMPARED, _SOME_COMPARED, _FEW_COMPARED = 24, 12, 6
_COMPARED_M = 1.5  # minimum motion between them: of less, the noise of the returns hides a tenth
# Prior deviations of velocities, share of the speed: along them, so that returns of most scenes converge from half or twice the true
# ones, and across.
_FREE_SCALE, _FREE_ACROSS = 0.15, 0.04
_SCALES = np.geomspace(0.4, 2.5, 33)
# Ratio of the speeds by returns and by Doppler that the estimate may be wrong by: 1.06 for a sparse radar.
_SAME_SCALE = 1.1
_SCALE_MEASURED = 1.2  # beyond which confidence limits of that ratio leave the scale of the Doppler open
_MOST_LATE = 10  # scans
_BY_CHANCE = 0.01  # significance level of another scale than 1, and of a delay
_SAME_RESIDUALS = 1.25  # ratio of squared residuals up to which a delay does not matter


@dataclass(frozen=True)
class DopplerTests:
    """Comparison of a drive's Doppler with its returns."""

    scale: float = 1.0  # ratio of the speeds by returns to those by Doppler
    least: float = float(_SCALES[0])  # confidence limits of this ratio
    most: float = float(_SCALES[-1])
    delay: int = 0  # of the Doppler, scans, where one explains the returns significantly better

    @classmethod
    def of(cls, drive: Drive, config: FitConfig, num_threads: int) -> DopplerTests:
        """Compare the fastest scans, tracked with velocities that are hardly known; without enough of them, nothing is known."""
        durations_s, velocities = np.diff(drive.times_s), drive.velocities
        if velocities is None or len(durations_s) < _FEW_COMPARED:
            return cls()
        lengths_m = np.linalg.norm(velocities.mean_mps[:-1], axis=1) * durations_s
        after_gap = durations_s > 2 * np.median(durations_s)
        lengths_m[after_gap] = 0.0
        most_apart = max(len(lengths_m) // _SOME_COMPARED, 1)
        every = int(np.clip(_COMPARED_M / max(np.median(lengths_m), 1e-9), 1, most_apart))
        count = min(_COMPARED, len(lengths_m) // every) * every
        begin = int(np.argmax(np.convolve(lengths_m, np.ones(count), "valid")))
        rows = slice(begin, begin + count + 1, every)
        compared, scans, times_s = velocities.select(rows), drive.scans[rows], drive.times_s[rows]
        free = compared.scaled(1.0, _FREE_SCALE)
        free.covariance[:] += (_FREE_ACROSS * compared.usual_mps) ** 2 * np.eye(3)
        tracker = Tracker(plane_cell_m(scans, config.leaf_size_m), config.returns, num_threads)
        tracked, _ = tracked_once(Drive(scans, times_s, free, None), tracker)
        segments, counts = np.array(
            [(found.segment, len(scan)) for found, scan in zip(tracked, scans, strict=True)]
        ).T
        followed = (np.diff(segments) == 0) & (np.minimum(counts[1:], counts[:-1]) > 0)
        if followed.sum() < _FEW_COMPARED:
            return cls()
        motion = DopplerMotion.by(compared, times_s, np.stack([found.pose for found in tracked]))
        pairs = [(scans[i], scans[i + 1], motion.steps[i]) for i in np.flatnonzero(followed)]
        gains = np.array([scale_gains(a, b @ step[:3, :3].T, step[:3, 3], _SCALES) for a, b, step in pairs])
        runs = np.r_[0, np.cumsum(after_gap)]
        delay = _delay(velocities, runs, np.arange(len(runs))[rows], motion, tracked, followed)
        return cls(*_scale(gains), delay)

    def applied(self, velocities: SensorVelocities) -> tuple[SensorVelocities | None, list[str]]:
        """Return velocities with an open scale in their covariance, or None if returns contradict them; and notes."""
        if self.least > _SAME_SCALE or self.most < 1 / _SAME_SCALE:
            shown = f"the returns show {self.scale:.1f} times its speeds. Give it in m/s, and times in s"
            return None, [f"{NOT_USED}: {shown}."]
        if self.delay:
            shown = f"the returns agree with that of {abs(self.delay)} scans {'later' if self.delay > 0 else 'earlier'}"
            return None, [f"{NOT_USED}: {shown}. Give each scan its own."]
        if self.most <= _SCALE_MEASURED and self.least >= 1 / _SCALE_MEASURED:
            return velocities, []
        shown = f"{self.least:.1f} to {self.most:.1f} times its speeds"
        velocities = dataclasses.replace(velocities, common_sigma=max(self.most - 1, 1 - self.least) / ERRORS)
        return velocities, [f"Assumed: the Doppler is in m/s; the returns agree with {shown}."]


def _scale(gains: Floats) -> tuple[float, float, float]:
    """Return the best scale by gains (K, S), and the limits of those that are not significantly worse."""
    best = int(np.argmax(gains.mean(axis=0)))
    losses = gains[:, best, None] - gains
    errors = losses.std(axis=0, ddof=1) / np.sqrt(len(gains))
    # The best of many scales is compared with each.
    needed = float(student.ppf(1 - _BY_CHANCE / len(_SCALES), len(gains) - 1))
    possible = _SCALES[losses.mean(axis=0) <= needed * errors]
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
    axes, of_steps = poses[:-1, :3, :3], np.stack([found.covariance[:3, :3] for found in tracked[1:]])
    covariance = np.einsum("fji,fjk,fkl->fil", axes, of_steps, axes)
    covariance += [motion.velocities.step_covariance(i, d) for i, d in enumerate(motion.durations_s.tolist())]
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    own, shown = motion.steps[:, :3, 3], steps(poses)[:, :3, 3]
    found, last = [(np.inf, 0)], len(velocities.mean_mps) - 1
    for delay in set(range(-_MOST_LATE, _MOST_LATE + 1)) - {0}:
        at = np.clip(rows + delay, 0, last)
        known = (at == rows + delay) & (runs[at] == runs[rows])
        used = followed & known[:-1] & known[1:]
        if (count := int(used.sum())) < _FEW_COMPARED:
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
