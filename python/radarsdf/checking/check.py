"""Check of scans and poses before a fit: all findings, worst first."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.arrays import Bools, Ints
from radarsdf.checking import frames, noise, trajectory
from radarsdf.checking.doppler import check_doppler, check_mountings, misread_radars
from radarsdf.checking.recording import SEVERITIES, Finding, checked_input
from radarsdf.checks import are_rigid, instance, pose_matrices
from radarsdf.config.fit_config import FitConfig
from radarsdf.returns.rays import measured, too_far
from radarsdf.scans import Scans, filled

_EQUAL = 1e-6  # relative difference of equal ranges, from float32
# A largest range is too frequent if more than 8 returns, and 5 times as many as at each of the next 10 ranges, have it.
_NEXT, _LEAST_EQUAL, _ABOVE_NEXT = 10, 8, 5


def check(
    points: Sequence[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    intensities: Sequence[ArrayLike] | None = None,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    times_s: ArrayLike | None = None,
    config: FitConfig | None = None,
) -> list[Finding]:
    """Find mistakes in scans and poses, and estimate the cost of a fit.

    Most findings compare the agreement of returns of different scans in the world frame: with the data as they are, and
    with one common mistake corrected. Samples are taken at equal steps, so the same data give the same findings.

    Parameters
    ----------
    points : sequence of F arrays, or Scans
        (N_i, 3) each: the returns of one scan, sensor frame, m, of any real dtype. Other attributes of
        :class:`radarsdf.io.Scans` are used unless passed here.
    poses : array_like, optional
        (F, 4, 4) T_world_sensor, m, one per scan. Optional only with `Scans`.
    intensities : sequence of F arrays, optional
        (N_i,) each, sensor units.
    doppler_mps : sequence of F arrays, optional
        (N_i,) each: speed of each return along its ray, m/s, positive away from the sensor.
    times_s : array_like, optional
        (F,) time of each scan, s.
    config : FitConfig, optional
        Settings of the planned fit.

    Returns
    -------
    list of Finding
        Worst first. If there is no error, the last one is the cost of a fit.

    Raises
    ------
    TypeError, ValueError
        If arrays are not numeric, or their shapes are inconsistent. Wrong values are findings.

    Examples
    --------
    >>> import numpy as np, radarsdf
    >>> scans = radarsdf.simulate.wall(frames=6)
    >>> findings = radarsdf.check(scans.points, np.linalg.inv(scans.poses))
    >>> findings[0].name, findings[0].severity
    ('poses_inverted', 'error')
    """
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    rig, scans, poses, intensities, doppler_mps, times_s = filled(
        points, poses=poses, intensities=intensities, doppler_mps=doppler_mps, times_s=times_s
    )
    if rig is None:
        return _find(checked_input(scans, poses, intensities, doppler_mps, times_s), config, frames.FULL)
    T_world_sensor = rig.sensor_poses(pose_matrices(poses, len(rig.of_scan)))
    recording = checked_input(scans, T_world_sensor, intensities, doppler_mps, times_s)
    assert isinstance(points, Scans)
    of_body = points.with_poses(pose_matrices(poses))
    mounted = rig.T_body_sensor is not None and are_rigid(T_world_sensor).all()
    misread = dict(misread_radars(of_body)) if mounted else {}
    found = list(misread.values())
    for label, rows in rig.scans_of_radars().items():
        if label not in misread:
            of_radar = _find(recording.select(rows), config, frames.FULL)
            found += [dataclasses.replace(one, evidence=f"{label}: {one.evidence}") for one in of_radar]
    if mounted and not any(one.severity == "error" and one.name != "sensor_turned" for one in found):
        found += check_mountings(of_body, config)
    return _sorted(found)


def check_cheaply(
    points: Sequence[ArrayLike], poses: ArrayLike, intensities: Sequence[ArrayLike] | None = None
) -> list[Finding]:
    """Findings of :func:`check` that take little time compared with a fit, on a smaller sample."""
    return _find(checked_input(points, poses, intensities), None, frames.CHEAP)


def _stops(findings: list[Finding]) -> bool:
    return any(finding.severity == "error" for finding in findings)


def _find(recording: Scans, config: FitConfig | None, effort: frames.Effort) -> list[Finding]:
    """All findings, worst first. `config` None: only the cheap ones."""
    found, recording, numbers = _usable(recording)
    if not _stops(found):
        for check_values in (
            trajectory.check_times,
            noise.check_elevation,
            trajectory.check_rounding,
            noise.check_intensities,
        ):
            found += check_values(recording)
        found += trajectory.check_duplicates(recording, numbers)
        found += _of_poses(recording, numbers, effort)
    if config is not None and not _stops(found):
        found += noise.check_noise_and_cost(recording, config)
        if not _stops(found):
            found += _drift(recording, numbers, config, found)
    return _sorted(found)


def _sorted(found: list[Finding]) -> list[Finding]:
    return sorted(found, key=lambda finding: SEVERITIES.index(finding.severity))


def _drift(recording: Scans, numbers: Ints, config: FitConfig, found: list[Finding]) -> list[Finding]:
    """Exchanged scans, which refined poses would hide, or drift of the poses or what explains it better."""
    faults = list(trajectory.check_order(recording, numbers)) or list(
        trajectory.check_drift(recording, config)
    )
    unknown = any(finding.name == "motion_undecided" for finding in found)
    return [
        Finding("undecided", "warning", fault.evidence) if unknown and fault.name == "poses_drift" else fault
        for fault in faults
    ]


def _of_poses(recording: Scans, numbers: Ints, effort: frames.Effort) -> list[Finding]:
    found = list(frames.check_still(recording, effort))
    if not found:
        found = list(frames.check_frames(recording, effort))
    if not _stops(found):
        found += trajectory.check_lengths(recording)
    if not _stops(found):
        found += trajectory.check_jumps(recording, numbers, effort)
        found += check_doppler(recording)
        found += noise.check_ground(recording)
    return found


def _usable(recording: Scans) -> tuple[list[Finding], Scans, Ints]:
    """Findings about unusable rows, scans and poses, the recording without them, and the numbers (F,) of its scans."""
    found: list[Finding] = []
    numbers = np.arange(len(recording))
    returns = [measured(scan) for scan in recording.points]
    far = [too_far(*each) for each in zip(recording.points, returns, strict=True)]
    found += _far(recording, returns, sum(int(mask.sum()) for mask in far))
    left_out = [~mask for mask in returns]
    total, unmeasured = sum(map(len, left_out)), sum(int(mask.sum()) for mask in left_out)
    infinite = sum(int((~np.isfinite(scan)).any(axis=1).sum()) for scan in recording.points)
    if infinite:
        evidence = f"{infinite} of {total} returns have coordinates that are not finite."
        found.append(Finding("returns_not_finite", "note", evidence))
    if unmeasured > infinite:
        count = f"{unmeasured - infinite} of {total} returns"
        evidence = f"{count} are no measurements: 0 0 0, or consecutive copies of one point."
        found.append(Finding("padding", "note", evidence))
    left_out = [mask | apart for mask, apart in zip(left_out, far, strict=True)]
    if any(mask.any() for mask in left_out):
        recording = _without(recording, left_out)
    empty = np.array([mask.all() for mask in left_out])
    if empty.any():
        count, first = f"{empty.sum()} of {len(empty)}", np.argmax(empty)
        evidence = f"{count} scans have no returns, the first is scan {first}."
        found.append(Finding("empty_scans", "error" if empty.all() else "note", evidence))
    if not empty.all():
        found += trajectory.check_rigid(recording)
        numbers = np.flatnonzero(~empty & are_rigid(recording.poses))
        recording = recording.select(numbers)
    return found, recording, numbers


def _far(recording: Scans, returns: list[Bools], num_far: int) -> Iterator[Finding]:
    """Report returns that a fit leaves out as too far away, and a farthest range that is much too frequent."""
    pairs = zip(recording.points, returns, strict=True)
    ranges = np.concatenate([np.linalg.norm(scan[mask], axis=1) for scan, mask in pairs])
    most = ranges.max(initial=0.0)
    counts = np.unique((np.log(ranges / most) / _EQUAL).round(), return_counts=True)[1]
    if num_far:
        evidence = f"{num_far} of {len(ranges)} returns are beyond 100 times the median range of their scan."
        yield Finding("far_returns", "note", evidence)
    if len(counts) > _NEXT and counts[-1] > _LEAST_EQUAL + _ABOVE_NEXT * counts[-1 - _NEXT : -1].max():
        evidence = f"{counts[-1]} of {len(ranges)} returns are at exactly the largest range, {most:g} m."
        yield Finding("range_sentinel", "warning", evidence)


def _without(recording: Scans, left_out: list[Bools]) -> Scans:
    """Remove the rows in the mask (N_i,) of each scan."""
    points, intensities, doppler_mps = (
        None if arrays is None else [values[~mask] for values, mask in zip(arrays, left_out, strict=True)]
        for arrays in (recording.points, recording.intensities, recording.doppler_mps)
    )
    assert points is not None
    return Scans(points, recording.poses, intensities, doppler_mps=doppler_mps, times_s=recording.times_s)
