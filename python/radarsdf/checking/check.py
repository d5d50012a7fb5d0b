"""Check of scans and poses before a fit: all findings, worst first."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from radarsdf.arrays import ArrayLike, Ints
from radarsdf.checking import frames, noise, trajectory
from radarsdf.checking.doppler import check_doppler, check_mountings, misread_radars
from radarsdf.checking.recording import SEVERITIES, Finding, checked_input
from radarsdf.checks import are_rigid, instance, pose_matrices
from radarsdf.config.fit_config import FitConfig
from radarsdf.returns.rays import measured, too_far
from radarsdf.scans import Scans, filled, scans_in_memory, with_returns

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
    points, poses, intensities, doppler_mps
        As for :func:`fit`, but sequences. Doppler is positive away from the sensor.
    times_s : (F,) array_like, optional
        Time of each scan, s.
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
    given = {"poses": poses, "intensities": intensities, "doppler_mps": doppler_mps, "times_s": times_s}
    rig, scans, poses, intensities, doppler_mps, times_s = filled(points, **given)
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
            found += [replace(one, evidence=f"{label}: {one.evidence}") for one in of_radar]
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
    if _stops(found):
        return _sorted(found)
    found += trajectory.check_times(recording)
    found += noise.check_elevation(recording)
    found += trajectory.check_rounding(recording)
    found += noise.check_intensities(recording)
    found += trajectory.check_duplicates(recording, numbers)
    of_poses = list(frames.check_still(recording, effort)) or list(frames.check_frames(recording, effort))
    if not _stops(of_poses):
        of_poses += trajectory.check_lengths(recording)
    if not _stops(of_poses):
        of_poses += trajectory.check_jumps(recording, numbers, effort)
        of_poses += check_doppler(recording)
        of_poses += noise.check_ground(recording)
    found += of_poses
    if config is not None and not _stops(found):
        found += noise.check_noise_and_cost(recording, config)
        if not _stops(found):
            # Exchanged scans first, which refined poses would hide.
            faults = list(trajectory.check_order(recording, numbers))
            undecided = any(finding.name == "motion_undecided" for finding in found)
            found += faults or trajectory.check_drift(recording, config, undecided=undecided)
    return _sorted(found)


def _sorted(found: list[Finding]) -> list[Finding]:
    return sorted(found, key=lambda finding: SEVERITIES.index(finding.severity))


def _usable(recording: Scans) -> tuple[list[Finding], Scans, Ints]:
    """Findings about unusable rows, scans and poses, the recording without them, and the numbers (F,) of its scans."""
    found: list[Finding] = []
    numbers, points = np.arange(len(recording)), recording.points
    returns = [measured(scan) for scan in points]
    far = [too_far(*each) for each in zip(points, returns, strict=True)]
    ranges = np.concatenate([np.linalg.norm(x[of], axis=1) for x, of in zip(points, returns, strict=True)])
    total, most = sum(map(len, points)), ranges.max(initial=0.0)
    distant = sum(int(mask.sum()) for mask in far)
    infinite = sum(int((~np.isfinite(scan)).any(axis=1).sum()) for scan in points)
    padding = total - len(ranges) - infinite
    for name, count, of, what in (
        ("far_returns", distant, len(ranges), "beyond 100 times the median range of their scan"),
        ("returns_not_finite", infinite, total, "not finite in their coordinates"),
        ("padding", padding, total, "no measurements: 0 0 0, or consecutive copies of one point"),
    ):
        if count > 0:
            found.append(Finding(name, "note", f"{count} of {of} returns are {what}."))
    counts = np.unique((np.log(ranges / most) / _EQUAL).round(), return_counts=True)[1]
    if len(counts) > _NEXT and counts[-1] > _LEAST_EQUAL + _ABOVE_NEXT * counts[-1 - _NEXT : -1].max():
        evidence = f"{counts[-1]} of {len(ranges)} returns are at exactly the largest range, {most:g} m."
        found.append(Finding("range_sentinel", "warning", evidence))
    kept = [mask & ~apart for mask, apart in zip(returns, far, strict=True)]
    if not all(mask.all() for mask in kept):
        recording = scans_in_memory([with_returns(*each) for each in zip(recording, kept, strict=True)])
    empty = np.array([not mask.any() for mask in kept])
    if empty.any():
        evidence = f"{empty.sum()} of {len(empty)} scans have no returns, the first is scan {empty.argmax()}."
        found.append(Finding("empty_scans", "error" if empty.all() else "note", evidence))
    if not empty.all():
        found += trajectory.check_rigid(recording)
        numbers = np.flatnonzero(~empty & are_rigid(recording.poses))
        recording = recording.select(numbers)
    return found, recording, numbers
