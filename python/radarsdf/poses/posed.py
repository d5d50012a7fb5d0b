# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses that were refined or found, as those who make maps use them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.odometry import Odometry
from radarsdf.poses.refine import RefinedPoses
from radarsdf.poses.rigid import Floats
from radarsdf.poses.way import pose_sigmas, way_of


@dataclass(frozen=True)
class Posed:
    """The poses of the scans that a map is made of."""

    poses: Floats
    """(K, 4, 4) T_world_sensor, m."""
    rows: slice
    """The K scans among those of the drive: all, or the longest piece, if poses were found in several."""
    given: Floats | None = None
    """(K, 4, 4) the poses before. None: there were none."""
    pieces: int = 1
    way: dict[str, Any] | None = None
    """What the report of a map keeps of them. None: they are as given."""
    sigmas: tuple[float, float] | None = None
    """Standard deviations of a pose, m and rad. None: they are not known."""
    notes: tuple[str, ...] = ()
    """Sentences on what was not used."""

    @classmethod
    def as_given(cls, poses: Floats) -> Posed:
        """Poses (F, 4, 4) that are neither refined nor found."""
        return cls(poses, slice(0, len(poses)), poses)

    @classmethod
    def refined(cls, refined: RefinedPoses, given: Floats) -> Posed:
        """Given poses (F, 4, 4) that were refined. If they were kept, their deviations are not known: the covariance is that of
        the refined ones."""
        sigmas = pose_sigmas(refined.covariance) if refined.improved else None
        rows, way = slice(0, len(given)), way_of(refined, given)
        return cls(refined.poses, rows, given, 1, way, sigmas, tuple(refined.report.get("notes", ())))

    @classmethod
    def found(cls, found: Odometry) -> Posed:
        """The longest piece of a drive without poses."""
        rows = found.longest_piece()
        sigmas, way = pose_sigmas(found.covariance[rows]), way_of(found, None, rows)
        notes = tuple(found.report["notes"])
        return cls(found.poses[rows], rows, None, found.report["pieces"], way, sigmas, notes)

    def config(self, config: FitConfig) -> FitConfig:
        """With the errors of the poses, unless it states some itself."""
        stated = config.returns.pose_sigma_m or config.returns.pose_sigma_rad
        if self.sigmas is None or stated:
            return config
        sigma_m, sigma_rad = self.sigmas
        return config.override(returns={"pose_sigma_m": sigma_m, "pose_sigma_rad": min(sigma_rad, 1.0)})
