"""Drift of the poses, and single faults that refined poses would hide: time offsets, mountings, exchanged scans."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats, Ints
from radarsdf.checking.agreement import LAGS, MIN_RETURNS, Agreement, Comparison, relative
from radarsdf.checking.frames import FULL
from radarsdf.checking.recording import Finding, ascending_times_s
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.checked_scans import median_range_m
from radarsdf.poses.refine import refine_poses
from radarsdf.poses.rigid import nearest_rotation, step_vectors
from radarsdf.returns.noise import SensorNoise
from radarsdf.scans import Scans

# Sizes of a sample of windows, scans and returns, evenly spread, so that a large recording takes no longer than a small one.
_WINDOWS, _SCANS, _RETURNS = 3, 60, 60_000
_LEAST_SCANS = 4
# Smallest displacement of returns, as a share of their standard deviation. Measured: true poses of slow sensors with cells
# of 0.5 m: up to 0.09; a detected drift of 0.01 m and 0.05 degrees per step: 0.27 and more.
_LEAST_MOVED = 0.15
# Margin over the share that is expected of four steps. Measured: at most 0.95 for drifts; 1.1 to 3 for single steps.
_CONCENTRATED = 1.25
_SURE = 5.0  # log likelihood ratio of a fault to drift: below, it is undecided
_LEAST_STEPS = 8  # that a fault explains
_LEAST_ERROR = 1e-6  # of a step, m
_NEAR = 17  # pairs whose median score is the usual one: scenes overlap more in some places than in others
_MOST_CUTS = 10
# Of the best of some hundred exchanges. Measured: 14 and more for exchanges, 4 on a handheld radar with dead reckoning.
_MIN_GAIN, _MIN_SIGNIFICANCE = 0.05, 8.0
_CLOSES = 0.5  # share of the difference to the usual score


def check_drift(recording: Scans, config: FitConfig) -> Iterator[Finding]:
    """Check whether held-out returns agree better with refined poses, in the clearest of some windows of scans.

    Drift is only one explanation of errors in the steps: a fault that explains them better is reported in its place.
    """
    count = len(recording)
    if count < _LEAST_SCANS:
        return
    begins = np.linspace(0, max(count - _SCANS, 0), min(_WINDOWS, max(1, count // _SCANS))).astype(np.int64)
    improved, shares, faults = [], [], []
    for begin in begins.tolist():
        part = recording.select(np.arange(begin, min(begin + _SCANS, count)))
        # Every n-th return, since returns of a scan are ordered by angle.
        every = max(1, -(-sum(map(len, part.points)) // _RETURNS))
        points = [np.asarray(scan[::every], np.float64) for scan in part.points]
        times_s, doppler_mps = ascending_times_s(part), None
        if part.doppler_mps is not None and times_s is not None:
            doppler_mps = [speeds[::every] for speeds in part.doppler_mps]
        options: dict[str, Any] = {"doppler_mps": doppler_mps, "times_s": times_s, "config": config}
        refined = refine_poses(points, part.poses, **options, progress=False)
        if refined.improved:
            report, range_m = refined.report, median_range_m(points)
            moved_m = np.hypot(report["moved_m"], range_m * report["moved_rad"])
            noise = SensorNoise(**report["noise"])
            if moved_m > _LEAST_MOVED * np.hypot(noise.range_m, range_m * noise.angle_rad):
                improved.append(report)
                lever_m = np.repeat([1.0, range_m], 3)
                given, found = (step_vectors(poses) * lever_m for poses in (recording.poses, refined.poses))
                shares.append(_excess_of_few_steps(found - given[begin : begin + len(found)]))
                faults += [*_time_offsets(given, found, begin), *_mountings(given, found, begin)]
    if improved:
        best = max(improved, key=lambda report: float(report["gain"] / report["gain_error"]))
        evidence = (
            f"With refined poses, returns of other scans are {np.expm1(best['gain']):.1%} denser at held-out returns "
            f"({best['gain'] / best['gain_error']:.0f} standard errors): steps have errors of {best['sigma_m']:.3f} m and "
            f"{np.degrees(best['sigma_rad']):.2f} degrees ({len(improved)} of {len(begins)} windows of the recording)."
        )
        ratio, finding = max(faults, key=lambda fault: fault[0], default=(0.0, None))
        if finding is not None and ratio > _SURE:
            yield finding
        elif finding is not None and ratio > 0:
            yield Finding("undecided", "warning", f"{finding.evidence} {evidence}")
        elif max(shares) > _CONCENTRATED:
            yield Finding("undecided", "warning", f"Few steps differ from refined ones. {evidence}")
        else:
            yield Finding("poses_drift", "warning", evidence)


def _log_errors(errors: Floats) -> Floats:
    """Negative log likelihoods (N,) of errors (N, 6) of steps, m, up to a constant: of unknown scale, so that few large ones
    hardly count."""
    return np.log(np.maximum(np.linalg.norm(errors, axis=1), _LEAST_ERROR))


def _time_offsets(given: Floats, refined: Floats, begin: int) -> Iterator[tuple[float, Finding]]:
    """Log likelihood ratios of time offsets to drift, by steps (K, 6), m, of refined scans from `begin` on, and all given ones."""
    last, drift = len(given) - 1, _log_errors(refined - given[begin : begin + len(refined)])
    offsets = [-0.5, 0.5, *range(-last, last + 1)]

    def fit(offset: float) -> tuple[Ints, Floats]:
        at = begin + np.arange(len(refined)) + offset
        rows = np.flatnonzero((at >= 0) & (at <= last))
        moved = given[np.floor(at[rows]).astype(np.int64)] + given[np.ceil(at[rows]).astype(np.int64)]
        return rows, _log_errors(refined[rows] - 0.5 * moved)

    for offset in offsets:
        rows, errors = fit(offset)
        if offset == 0 or len(rows) < _LEAST_STEPS:
            continue
        other = drift[rows].mean()
        if offset % 1:  # means of two steps have smaller errors, whatever the offset
            other = min(other, fit(-offset)[1].mean())
        ratio = len(rows) * (other - errors.mean()) - np.log(len(offsets))
        evidence = (
            f"The scans move as the poses do about {abs(offset):g} scans {'later' if offset > 0 else 'earlier'} "
            f"(log likelihood ratio to drift: {ratio:.0f})."
        )
        yield float(ratio), Finding("clock_offset", "error", evidence)


def _mountings(given: Floats, refined: Floats, begin: int) -> Iterator[tuple[float, Finding]]:
    """Log likelihood ratios to drift of a sensor that is turned against the frame of the poses, from some scan on."""
    count = len(refined)
    given = given[begin : begin + count]
    drift = _log_errors(refined - given)
    for first in (0, *range(3, count - _LEAST_STEPS)):
        vectors, others = given[first:].reshape(-1, 3), refined[first:].reshape(-1, 3)
        turn = nearest_rotation(np.einsum("ni,nj->ij", others, vectors))
        left = _log_errors((others - np.einsum("ij,nj->ni", turn, vectors)).reshape(-1, 6))
        # Schwarz's criterion for the three angles, and the choice of the scan.
        ratio = (drift[first:] - left).sum() - 1.5 * np.log(count - first) - np.log(count) * (first > 0)
        degrees = np.degrees(Rotation.from_matrix(turn).magnitude())
        since = f" from scan {begin + first} on" if first else ""
        evidence = (
            f"The scans move as if the sensor were turned by {degrees:.1f} degrees against the frame of the poses{since} (log "
            f"likelihood ratio to drift: {ratio:.0f})."
        )
        yield float(ratio), Finding("sensor_turned", "warning", evidence)


def _excess_of_few_steps(errors: Floats) -> float:
    """Share of the four largest squared errors (K, 6) of steps, over that of exponentially distributed ones."""
    off_m2 = np.sort((errors**2).sum(axis=1))
    return float(off_m2[-4:].sum() / off_m2.sum() * len(off_m2) / (4 * np.log(len(off_m2))))


def check_order(recording: Scans, numbers: Ints) -> Iterator[Finding]:
    """Find two scans or blocks of scans that changed places. `numbers` (F,): of the scans."""
    rows = np.flatnonzero([len(scan) >= MIN_RETURNS for scan in recording.points])
    count = len(rows)
    if count < 2 * max(LAGS):
        return
    agreement = Agreement([recording.points[i] for i in rows], FULL.returns, FULL.queries)
    pairs = np.concatenate([np.stack([np.arange(count - lag), np.arange(lag, count)], 1) for lag in LAGS[:3]])
    motions = relative(recording.poses[rows], pairs)[None]
    scores = agreement.scores(pairs, motions)[0]
    excess = scores[: count - 1] - median_filter(scores[: count - 1], _NEAR, mode="nearest")
    places = [0, *np.sort(np.argsort(-excess, kind="stable")[:_MOST_CUTS] + 1).tolist(), count]
    # Of adjacent blocks, one may be longer: it was moved past the other.
    blocks = [(a, b, b, c) for a, b, c in itertools.combinations(places, 3)]
    blocks += [ends for ends in itertools.combinations(places, 4) if ends[1] - ends[0] == ends[3] - ends[2]]
    best = _MIN_GAIN, 0.0, (0, 0, 0, 0)
    for a, b, c, d in blocks:
        # Other scans with the motion of the same poses: their fields of view overlap as much, whatever is right.
        others = np.r_[0:a, c:d, b:c, a:b, d:count][pairs]
        cuts = np.array([a, b, c, d, a + d - c, a + d - b])
        across = ((pairs[:, :1] < cuts) & (cuts <= pairs[:, 1:])).any(axis=1)
        crossing = np.flatnonzero(across & (others != pairs).any(axis=1))
        neighbours = crossing[crossing < count - 1]
        for chosen in (neighbours, crossing):
            compared = Comparison.of(scores[chosen], agreement.scores(others[chosen], motions[:, chosen]))
            gain, significance = float(compared.gains[0]), float(compared.significance[0])
            if gain < max(best[0] if chosen is crossing else _MIN_GAIN, _CLOSES * excess[neighbours].mean()):
                break
        else:
            if significance >= _MIN_SIGNIFICANCE:
                best = gain, significance, (a, b, c, d)
    gain, significance, (a, b, c, d) = best
    if not d:
        return
    first, second = (f"{numbers[rows[i]]} to {numbers[rows[j - 1]]}" for i, j in ((a, b), (c, d)))
    evidence = (
        f"If scans {first} and scans {second} change places, returns of neighbouring scans are {np.exp(gain):.2f} times closer to "
        f"each other at the ends of these blocks ({significance:.0f} standard errors)."
    )
    yield Finding("scans_exchanged", "error", evidence)
