# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is kept of refined or found poses beside a map: the way, how well it is known, and the verdict."""

from __future__ import annotations

from typing import Any

import numpy as np

from radarsdf.poses.odometry import Odometry
from radarsdf.poses.refine import RefinedPoses
from radarsdf.poses.rigid import Floats

_MOST = 500  # scans whose poses are kept: a plot shows no more


def pose_sigmas(covariance: Floats) -> tuple[float, float]:
    """Standard deviations of a pose's position, m, and rotation, rad, by axis, of the median scan.

    These are what ``returns.pose_sigma_m`` and ``pose_sigma_rad`` of a :class:`FitConfig` state.

    Parameters
    ----------
    covariance : (F, 6, 6) ndarray
        Of :class:`RefinedPoses` or :class:`Odometry`.
    """
    position_m, turn_rad = np.median(_sigmas(covariance), axis=0).tolist()
    return position_m, turn_rad


def way_of(found: RefinedPoses | Odometry, given: Floats | None, rows: slice = slice(None)) -> dict[str, Any]:
    """Of the scans `rows`, for the report of a fit, as values of JSON. `given` (F, 4, 4): the poses before.

    `verdict` in words; `improved`, None of poses that were found; `step_m` and `step_rad`, deviations of a given step; of some of
    the scans, `scans`, their numbers; `before` and `after`, positions, m; `sigma_m` and `sigma_rad`, standard deviations by axis
    of the poses, relative to the scan in the middle.
    """
    poses, covariance = found.poses[rows], found.covariance[rows]
    some = np.unique(np.linspace(0, len(poses) - 1, min(_MOST, len(poses))).astype(np.int64))
    sigmas = _sigmas(covariance)[some]
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


def _sigmas(covariance: Floats) -> Floats:
    """(F, 2) of positions, m, and rotations, rad, root mean square of the three axes."""
    variances = np.einsum("fii->fi", covariance).reshape(-1, 2, 3).mean(axis=2)
    sigmas: Floats = np.sqrt(np.maximum(variances, 0.0))
    return sigmas
