# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Whether refinement would mend the poses, and by how much they drift."""

from __future__ import annotations

import numpy as np

from radarsdf.checking.finding import Finding
from radarsdf.checking.recording import FloatArray, Recording
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.checked_scans import median_range_m
from radarsdf.poses.refine import RefinedPoses, refine_poses
from radarsdf.poses.rigid import steps, turned_by
from radarsdf.returns.noise import SensorNoise

# So that a large recording takes no longer than a small one: so many windows, at equal steps, of so many scans and returns.
_WINDOWS, _SCANS, _RETURNS = 3, 60, 60_000
_LEAST_SCANS = 4  # fewer tell nothing
# Of the deviation of a return, that returns must move by. Measured: true poses of slow sensors with cells of 0.5 m: up to 0.09; a
# drift of 0.01 m and 0.05 degrees a step that is found: 0.27 and more.
_LEAST_MOVED = 0.15


def check_drift(recording: Recording, config: FitConfig) -> list[Finding]:
    """Tells whether returns that took no part agree better once the poses are refined.

    Of a large recording, windows of scans are refined. What counts is the one in which the gain is most significant.
    """
    refined = [_refined(recording.select(rows), config) for rows in _windows(len(recording))]
    improved = [window for window in refined if window[1].improved and window[2] > _LEAST_MOVED]
    if not improved:
        return []
    given, found, _ = max(
        improved, key=lambda window: window[1].report["gain"] / window[1].report["gain_error"]
    )
    report = found.report
    drift_m, drift_deg = _drift(given, found.poses)
    where = "" if len(refined) == 1 else f" ({len(improved)} of {len(refined)} windows of the recording)"
    return [
        Finding(
            "poses_drift",
            "warning",
            f"With refined poses, returns of other scans are {np.expm1(report['gain']):.1%} denser where returns that took no part lie "
            f"({report['gain'] / report['gain_error']:.0f} standard errors): a step is off by {report['sigma_m']:.3f} m and "
            f"{np.degrees(report['sigma_rad']):.2f} degrees, and {len(given)} scans end off by {drift_m:.2f} m and {drift_deg:.1f} "
            f"degrees{where}.",
            "Mend them: radarsdf poses, radarsdf fit --refine, or radarsdf.refine_poses(points, poses).",
        )
    ]


def _windows(count: int) -> list[np.ndarray]:
    """Numbers of the scans of each window."""
    if count < _LEAST_SCANS:
        return []
    if count <= _SCANS:
        return [np.arange(count)]
    windows = min(_WINDOWS, count // _SCANS)
    begins = np.linspace(0, count - _SCANS, windows).astype(np.int64)
    return [begin + np.arange(_SCANS) for begin in begins]


def _refined(part: Recording, config: FitConfig) -> tuple[FloatArray, RefinedPoses, float]:
    """The given poses of some scans, the refined ones, and by how many deviations of a return they move returns."""
    # Every n-th return: those of a scan come in the order of its angles.
    every = max(1, -(-sum(map(len, part.points)) // _RETURNS))
    points = [np.asarray(scan[::every], np.float64) for scan in part.points]
    times_s, doppler_mps = part.ascending_times_s, None
    if part.doppler_mps is not None and times_s is not None:
        doppler_mps = [speeds[::every] for speeds in part.doppler_mps]
    refined = refine_poses(
        points, part.poses, doppler_mps=doppler_mps, times_s=times_s, config=config, progress=False
    )
    if not refined.improved:
        return part.poses, refined, 0.0
    range_m = median_range_m(points)
    moved_m = float(np.hypot(refined.report["moved_m"], range_m * refined.report["moved_rad"]))
    noise = SensorNoise(**refined.report["noise"])
    return part.poses, refined, moved_m / float(np.hypot(noise.range_m, range_m * noise.angle_rad))


def _drift(given: FloatArray, found: FloatArray) -> tuple[float, float]:
    """By how much the way from the first to the last scan differs, m and degrees."""
    ends = [poses[[0, -1]] for poses in (given, found)]
    one, other = (steps(pair) for pair in ends)
    return float(np.linalg.norm(one[0, :3, 3] - other[0, :3, 3])), float(np.degrees(turned_by(one, other)[0]))
