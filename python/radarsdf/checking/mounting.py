"""Checks of the mountings of several radars: mirrored axes, radars upside down, wrong rotations and lever arms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checking.agreement import Agreement, Comparison, choose_pairs
from radarsdf.checking.doppler import velocities_of_some, velocity_of_poses
from radarsdf.checking.recording import Finding, ascending_times_s
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.calibrate import calibrate
from radarsdf.poses.rigid import increments
from radarsdf.rig import Label
from radarsdf.scans import Scans

_READ_AS = {  # factors of y and z, the name of the finding, and what completes "agree better if"
    (1.0, -1.0): ("mounting_mirrored", "the sign of its elevation is changed"),
    (-1.0, 1.0): ("mounting_mirrored", "the sign of its azimuth is changed"),
    (-1.0, -1.0): ("mounting_upside_down", "it is mounted upside down"),
}
_PAIRS, _RETURNS, _QUERIES = 120, 2000, 200  # of scans, and returns of each
_COMMON = 0.01  # standard deviation of the systematic error of velocities, share of the speed
_SURE, _LOG_RATIO = 3.0, 8.0  # standard errors of the returns, and log likelihood ratio with the velocities
_SURE_ALONE, _GAIN = 6.0, 0.05  # of the returns where velocities do not decide
_ERRORS = 4.0  # standard deviations
_LEAST = np.repeat([0.05, np.radians(0.5)], 3)  # of an error that degrades a map, m and rad


def check_mountings(recording: Scans, config: FitConfig) -> Iterator[Finding]:
    """Compare mountings with velocities by Doppler and with the surfaces that radars share. The poses must be rigid."""
    given = recording.T_body_sensor
    assert given is not None
    try:
        found = calibrate(recording, config=config)
    except ValueError:  # there are no times, or the motion is not observable
        return
    for label, mounting in found.mountings.items():
        off = increments(given[label][None], mounting.T_body_sensor[None])[0]
        sigmas = np.sqrt(mounting.covariance.diagonal())
        wrong = (np.abs(off) > _ERRORS * sigmas) & (np.abs(off) > _LEAST)  # False where unobserved
        if wrong[3:].any():
            degrees = np.degrees([np.linalg.norm(off[3:]), np.nanmax(sigmas[3:])])
            evidence = "The rotation of {} differs by {:.1f} degrees from that found, with a deviation of {:.1f}, relative to {}."
            yield Finding("mounting_rotation", "warning", evidence.format(label, *degrees, found.against))
        if wrong[:3].any():
            axis = int(np.nanargmax(np.where(wrong[:3], np.abs(off[:3]), 0.0)))
            evidence = "The lever arm of {} along {} differs by {:.2f} m from that found, with a deviation of {:.2f}, relative to {}."
            values = label, "xyz"[axis], abs(off[axis]), sigmas[axis], found.against
            yield Finding("mounting_lever", "warning", evidence.format(*values))


def misread_radars(recording: Scans) -> Iterator[tuple[Label, Finding]]:
    """Find radars whose returns agree better with those of all scans, and with the poses, if axes are reversed."""
    rig, poses = recording.rig, recording.sensor_poses
    assert rig is not None
    pairs = choose_pairs(recording.points, poses[:, :3, 3], _PAIRS)
    if len(pairs) == 0:
        return
    agreement = Agreement(recording.points, _RETURNS, _QUERIES)
    turns = np.array([np.diag([1.0, *factors, 1.0]) for factors in ((1.0, 1.0), *_READ_AS)])
    for k, label in enumerate(rig.labels):
        own = pairs[(rig.of_scan[pairs] == k).any(axis=1)]
        if len(own) == 0:
            continue
        own_scans = (rig.of_scan == k)[:, None, None, None]
        changed = np.where(own_scans, poses[:, None] @ turns, poses[:, None]).swapaxes(0, 1)
        T_j_i = np.stack([np.linalg.inv(each[own[:, 1]]) @ each[own[:, 0]] for each in changed])
        scores = agreement.scores(own, T_j_i)
        comparison = Comparison.of(scores[0], scores[1:])
        by_doppler = _log_ratios(recording.select(np.flatnonzero(rig.of_scan == k)), turns[:, :3, :3])
        evidence_of = comparison.significance**2 / 2 + by_doppler
        both = (comparison.significance > _SURE) & (by_doppler > 1) & (evidence_of > _LOG_RATIO)
        sure = comparison.significance > _SURE_ALONE
        alone = sure & (comparison.gains > _GAIN) & (by_doppler > -_LOG_RATIO)
        if not (both | alone).any():
            continue
        best = int(np.argmax(np.where(both | alone, comparison.significance + by_doppler, -np.inf)))
        name, what = list(_READ_AS.values())[best]
        evidence = (
            f"Returns of {label} agree better with the other scans if {what} ({comparison.significance[best]:.0f} standard errors), "
            f"and so do its velocities with the poses (log likelihood ratio {by_doppler[best]:.0f})."
        )
        yield label, Finding(name, "error", evidence)


def _log_ratios(recording: Scans, turns: Floats) -> Floats:
    """Log likelihood ratios (H - 1,) of mean velocities of a radar by Doppler, turned by `turns` (H, 3, 3), to those as they are."""
    times_s = ascending_times_s(recording)
    if recording.doppler_mps is None or times_s is None or len(recording) < 3:
        return np.zeros(len(turns) - 1)
    scans, found = velocities_of_some(recording, recording.doppler_mps)
    by_poses = velocity_of_poses(recording.sensor_poses, times_s)[scans]
    by_doppler = np.reshape([velocity.velocity_mps for velocity in found], (-1, 3))
    speed = np.linalg.norm(by_poses, axis=1).mean()
    if not np.isfinite(by_doppler).any() or speed == 0:
        return np.zeros(len(turns) - 1)
    # The sign of the Doppler is not known.
    turned = np.einsum("hij,nj->hni", turns, by_doppler)
    off = np.stack([np.nanmedian(sign * turned - by_poses, axis=1) for sign in (1.0, -1.0)])
    squares = np.minimum((off / (_COMMON * speed)) ** 2, 100.0).sum(axis=2).min(axis=0)
    return 0.5 * (squares[0] - squares[1:])
