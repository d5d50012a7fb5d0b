# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans whose poses the radar itself mends or finds, for the commands that need poses."""

from __future__ import annotations

import argparse
import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from radarsdf.cli.results import Results
from radarsdf.cli.saying import complain
from radarsdf.cli.scans_in import scans_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from radarsdf import FitConfig
    from radarsdf.io.scans import Scans


@dataclass(frozen=True)
class PosedScans:
    """Scans with their new poses, and what was given."""

    scans: Scans
    """Of the longest piece, if the poses were found in several."""
    given: NDArray[np.float64] | None
    """(F, 4, 4) poses of these scans before. None: there were none."""
    pieces: int
    way: dict[str, Any] | None = None
    """What the report of a fit keeps of them. None: they are as given."""
    sigmas: tuple[float, float] | None = None
    """Standard deviations of a pose, m and rad. None: they are not known."""

    def config(self, config: FitConfig) -> FitConfig:
        """With the errors of the poses, unless it states some itself."""
        stated = config.returns.pose_sigma_m or config.returns.pose_sigma_rad
        if self.sigmas is None or stated:
            return config
        sigma_m, sigma_rad = self.sigmas
        return config.override(returns={"pose_sigma_m": sigma_m, "pose_sigma_rad": min(sigma_rad, 1.0)})


def scans_and_poses(
    options: argparse.Namespace, config: FitConfig, results: Results, *, refine: bool, find: bool = False
) -> PosedScans:
    """The scans of a command. Their poses are refined, if that is wanted, or found, if there are none or `find` says so."""
    from radarsdf.io.poses.reading import UNPOSED, NoPoses

    if find:
        return _found(scans_of(options, UNPOSED), config, results, options.command)
    try:
        scans = scans_of(options)
    except NoPoses as missing:
        try:
            posed = _found(scans_of(options, UNPOSED), config, results, options.command)
        except ValueError as error:
            msg = f"{missing}, but not here: {error}"
            raise NoPoses(msg) from error
        complain(f"radarsdf {options.command}: there are no poses: they were found from the radar alone")
        return posed
    return _refined(scans, config, results) if refine else PosedScans(scans, scans.poses, 1)


def _refined(scans: Scans, config: FitConfig, results: Results) -> PosedScans:
    from radarsdf import refine_poses
    from radarsdf.poses.way import pose_sigmas, way_of

    refined = refine_poses(scans, config=config)
    results.add(refined.report["verdict"], poses=refined.report, improved=refined.improved)
    if refined.improved:
        results.add(
            "they moved by {moved_m:.3f} m and {degrees:.2f} degrees; a given step is off by {sigma_m:.3f} m and {step:.2f} degrees "
            "(root mean square, standard deviations)".format(
                degrees=math.degrees(refined.report["moved_rad"]),
                step=math.degrees(refined.report["sigma_rad"]),
                **refined.report,
            )
        )
    posed = PosedScans(scans.with_poses(refined.poses), scans.poses, 1, way_of(refined, scans.poses))
    # The covariance is that of the refined poses.
    return dataclasses.replace(posed, sigmas=pose_sigmas(refined.covariance)) if refined.improved else posed


def _found(scans: Scans, config: FitConfig, results: Results, command: str) -> PosedScans:
    from radarsdf import odometry
    from radarsdf.poses.way import pose_sigmas, way_of

    found = odometry(scans, config=config)
    results.add(found.report["verdict"], poses=found.report)
    for note in found.report["notes"]:
        complain(f"radarsdf {command}: {note}")
    if found.report["doppler_sign"] < 0:
        results.add("this radar's Doppler is positive where the sensor comes nearer")
    pieces, rows = found.report["pieces"], found.longest_piece()
    posed = scans.with_poses(found.poses, other_world=True)
    if pieces > 1:
        results.add(f"the scans {rows.start} to {rows.stop - 1} are used, the longest piece")
        posed = posed.select_range(rows)
    sigmas = pose_sigmas(found.covariance[rows])
    return PosedScans(posed, None, pieces, way_of(found, None, rows), sigmas)
