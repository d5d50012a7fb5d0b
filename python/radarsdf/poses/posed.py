"""Refined or estimated poses for maps and reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.odometry import Odometry
from radarsdf.poses.refine import RefinedPoses

_MOST = 500  # maximum number of poses in a report: enough for a plot


def pose_sigmas(covariance: Floats) -> tuple[float, float]:
    """Compute median standard deviations per axis of the position, m, and rotation, rad, of poses.

    `covariance` (F, 6, 6) is that of :class:`RefinedPoses` or :class:`Odometry`. These are the values for
    ``returns.pose_sigma_m`` and ``pose_sigma_rad`` of a :class:`FitConfig`.
    """
    position_m, turn_rad = np.median(_sigmas(covariance), axis=0).tolist()
    return position_m, turn_rad


def _sigmas(covariance: Floats) -> Floats:
    """Return standard deviations (F, 2) of positions, m, and rotations, rad, root mean square of the three axes."""
    variances = np.einsum("fii->fi", covariance).reshape(-1, 2, 3).mean(axis=2)
    return np.sqrt(np.maximum(variances, 0.0))


def trajectory_report(
    found: RefinedPoses | Odometry, given: Floats | None, rows: slice = slice(None)
) -> dict[str, Any]:
    """Return the trajectory of the scans `rows` for the report of a fit, as JSON values. `given` (F, 4, 4): original poses."""
    poses = found.poses[rows]
    some = np.unique(np.linspace(0, len(poses) - 1, min(_MOST, len(poses))).astype(np.int64))
    sigmas = _sigmas(found.covariance[rows])[some]
    return {
        "verdict": found.report["verdict"],
        "improved": found.improved if isinstance(found, RefinedPoses) else None,
        "step_m": found.report.get("sigma_m"),
        "step_rad": found.report.get("sigma_rad"),
        "scans": some.tolist(),
        "before": None if given is None else given[rows][some, :3, 3].tolist(),
        "after": poses[some, :3, 3].tolist(),
        "sigma_m": sigmas[:, 0].tolist(),
        "sigma_rad": sigmas[:, 1].tolist(),
    }


@dataclass(frozen=True)
class PosedScans:
    """Poses of the scans to fit a map to."""

    poses: Floats  # (K, 4, 4) T_world_sensor, m
    rows: slice  # the K scans among those of the drive: all, or the longest segment of odometry
    given: Floats | None = None  # (K, 4, 4) original poses, if any
    segments: int = 1
    trajectory: dict[str, Any] | None = None  # for the report of a map. None for original poses
    sigmas: tuple[float, float] | None = None  # standard deviations of a pose, m and rad, if known
    notes: tuple[str, ...] = ()  # sentences on unused input

    @classmethod
    def refined(cls, refined: RefinedPoses, given: Floats) -> PosedScans:
        """Build from refined poses and the original ones (F, 4, 4). `sigmas` are unknown if these were kept."""
        sigmas = pose_sigmas(refined.covariance) if refined.improved else None
        rows, notes = slice(0, len(given)), tuple(refined.report.get("notes", ()))
        return cls(refined.poses, rows, given, 1, trajectory_report(refined, given), sigmas, notes)

    @classmethod
    def found(cls, found: Odometry) -> PosedScans:
        """Build from the longest segment of odometry."""
        rows, report = found.longest_segment(), found.report
        sigmas, trajectory = pose_sigmas(found.covariance[rows]), trajectory_report(found, None, rows)
        segments, notes = report["segments"], tuple(report["notes"])
        return cls(found.poses[rows], rows, None, segments, trajectory, sigmas, notes)

    def config(self, config: FitConfig) -> FitConfig:
        """Return `config` with the errors of the poses, unless it specifies its own."""
        if self.sigmas is None or config.returns.pose_sigma_m or config.returns.pose_sigma_rad:
            return config
        sigma_m, sigma_rad = self.sigmas
        return config.override(returns={"pose_sigma_m": sigma_m, "pose_sigma_rad": min(sigma_rad, 1.0)})
