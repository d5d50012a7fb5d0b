# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The check of scans and poses before a fit: all findings, the worst first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.checking import frames, noise, trajectory
from radarsdf.checking.doppler import check_doppler
from radarsdf.checking.intensity import check_intensities
from radarsdf.checking.recording import SEVERITIES, Finding, Recording
from radarsdf.checks import MISSING_POSES, are_rigid, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.io.scans import Scans, filled
from radarsdf.returns.rays import measured


def check(
    points: Sequence[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    intensities: Sequence[ArrayLike] | None = None,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    times_s: ArrayLike | None = None,
    config: FitConfig | None = None,
) -> list[Finding]:
    """Finds mistakes in scans and poses, and estimates what a fit of them will cost.

    Most findings compare how well returns of different scans agree in the world frame: with the data as they are, and as if
    one common mistake were corrected. Samples are taken at equal steps, so the same data give the same findings.

    Parameters
    ----------
    points : sequence of F arrays, or Scans
        (N_i, 3) each: the returns of one scan, sensor frame, m. Of :class:`radarsdf.io.Scans`, as they are, all the
        rest is used where it is not given here.
    poses : array_like, optional
        (F, 4, 4) T_world_sensor, m, one for each scan. Only `Scans` can do without.
    intensities : sequence of F arrays, optional
        (N_i,) each, sensor units.
    doppler_mps : sequence of F arrays, optional
        (N_i,) each: speed of each return along its ray, m/s, positive away from the sensor.
    times_s : array_like, optional
        (F,) time of each scan, s.
    config : FitConfig, optional
        Settings of the fit to come.

    Returns
    -------
    list of Finding
        The worst first. Without an error among them, the last is what a fit will cost.

    Raises
    ------
    TypeError, ValueError
        If the arrays are not numbers, or their shapes do not fit together. Wrong numbers are findings.

    Examples
    --------
    >>> import numpy as np, radarsdf
    >>> scans = radarsdf.simulate.wall(frames=6)
    >>> findings = radarsdf.check(scans.points, np.linalg.inv(scans.poses))
    >>> findings[0].name, findings[0].severity
    ('poses_inverted', 'error')
    """
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    scans, poses, intensities, doppler_mps, times_s = filled(
        points, poses=poses, intensities=intensities, doppler_mps=doppler_mps, times_s=times_s
    )
    if poses is None:
        raise ValueError(MISSING_POSES)
    recording = Recording.of(scans, poses, intensities, doppler_mps, times_s)
    return _sorted(_find(recording, config, frames.FULL))


def check_cheaply(
    points: Sequence[ArrayLike], poses: ArrayLike, intensities: Sequence[ArrayLike] | None = None
) -> list[Finding]:
    """The findings of :func:`check` that take little time compared with a fit, on a smaller sample."""
    recording = Recording.of(points, poses, intensities, None, None)
    return _sorted(_find(recording, None, frames.CHEAP))


def _sorted(findings: list[Finding]) -> list[Finding]:
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def _stops(findings: list[Finding]) -> bool:
    return any(finding.severity == "error" for finding in findings)


def _find(recording: Recording, config: FitConfig | None, effort: frames.Effort) -> list[Finding]:
    """All findings. `config` None: only the cheap ones."""
    found, recording = _usable(recording)
    if _stops(found):
        return found
    for checked in (
        trajectory.check_times,
        noise.check_elevation,
        trajectory.check_rounding,
        check_intensities,
        trajectory.check_duplicates,
    ):
        found += checked(recording)
    wrong = [*frames.check_still(recording, effort)] or [*frames.check_frames(recording, effort)]
    if not _stops(wrong):
        wrong += trajectory.check_lengths(recording)
    if not _stops(wrong):  # else the scans do not agree, whatever the clock
        wrong += trajectory.check_jumps(recording, effort)
        wrong += check_doppler(recording)
        if config is not None and not any(finding.severity != "note" for finding in wrong):
            wrong += frames.check_clock(recording, effort)
        wrong += noise.check_ground(recording)
    found += wrong
    if config is not None and not _stops(found):
        found += noise.check_noise_and_cost(recording, config)
        if not _stops(found):
            found += noise.check_drift(recording, config)
    return found


def _usable(recording: Recording) -> tuple[list[Finding], Recording]:
    """Findings about rows, scans and poses that a fit leaves out, and the recording without them."""
    found = []
    left_out = [~measured(scan) for scan in recording.points]
    total, unmeasured = sum(map(len, left_out)), sum(int(mask.sum()) for mask in left_out)
    infinite = total - sum(int(np.isfinite(scan).all(axis=1).sum()) for scan in recording.points)
    nothing = "Nothing needs to be done: a fit leaves them out."
    for count, name, what in (
        (infinite, "returns_not_finite", "have coordinates that are not finite"),
        (
            unmeasured - infinite,
            "padding",
            "are no measurements: 0 0 0, or one point many times in succession",
        ),
    ):
        if count > 0:
            found.append(Finding(name, "note", f"{count} of {total} returns {what}.", nothing))
    if unmeasured:
        recording = recording.without(left_out)
    empty = np.array([mask.all() for mask in left_out])
    if empty.any():
        evidence = (
            f"{empty.sum()} of {len(empty)} scans have no returns, the first is scan {np.argmax(empty)}."
        )
        if empty.all():
            return [*found, Finding("empty_scans", "error", evidence, "Pass the returns.")], recording
        found.append(Finding("empty_scans", "note", evidence, nothing))
    found += trajectory.check_rigid(recording)
    return found, recording.select(np.flatnonzero(~empty & are_rigid(recording.poses)))
