# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans whose poses the radar itself mends or finds, for the commands that need poses."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.results import Results
from radarsdf.cli.saying import complain
from radarsdf.cli.scans_in import scans_of

if TYPE_CHECKING:
    from radarsdf import FitConfig
    from radarsdf.io.poses.trajectory import NoPoses
    from radarsdf.io.scans import Scans
    from radarsdf.poses.posed import Posed


def scans_and_poses(
    options: argparse.Namespace,
    config: FitConfig,
    results: Results,
    *,
    refine: bool,
    find: bool = False,
    out: Path | None = None,
) -> tuple[Scans, Posed]:
    """The scans of a command, those of the longest piece if there are several. Their poses are refined, if that is wanted, or found, if there are none or `find` says so. `out`: the file of poses that the command writes."""
    from radarsdf.io.poses.files import check_pose_times
    from radarsdf.poses.posed import Posed

    scans, missing = scans_or_unposed(options, find=find)
    if out is not None:
        check_pose_times(out, scans.times_s)
    if find or missing is not None:
        with finding(options, missing):
            return _found(scans, config, results, options.command)
    return _refined(scans, config, results) if refine else (scans, Posed.as_given(scans.poses))


def scans_or_unposed(options: argparse.Namespace, *, find: bool = False) -> tuple[Scans, NoPoses | None]:
    """The scans of a command, and why they have no poses. `find`: theirs are not used."""
    from radarsdf.io.poses.trajectory import UNPOSED, NoPoses

    if find:
        return scans_of(options, UNPOSED), None
    try:
        return scans_of(options), None
    except NoPoses as missing:
        return scans_of(options, UNPOSED), missing


@contextmanager
def finding(options: argparse.Namespace, missing: NoPoses | None) -> Iterator[None]:
    """A block in which poses are found. If they are `missing`, that is said, or why they cannot be found."""
    from radarsdf.io.poses.trajectory import NoPoses

    try:
        yield
    except ValueError as error:
        if missing is None:
            raise
        msg = f"{missing}, but not here: {error}"
        raise NoPoses(msg) from error
    if missing is not None:
        complain(f"radarsdf {options.command}: there are no poses: they were found from the radar alone")


def _refined(scans: Scans, config: FitConfig, results: Results) -> tuple[Scans, Posed]:
    from radarsdf import refine_poses
    from radarsdf.poses.posed import Posed

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
    return scans.with_poses(refined.poses), Posed.refined(refined, scans.poses)


def _found(scans: Scans, config: FitConfig, results: Results, command: str) -> tuple[Scans, Posed]:
    from radarsdf import odometry
    from radarsdf.poses.posed import Posed

    found = odometry(scans, config=config)
    results.add(found.report["verdict"], poses=found.report)
    for note in found.report["notes"]:
        complain(f"radarsdf {command}: {note}")
    if found.report["doppler_sign"] < 0:
        results.add("this radar's Doppler is positive where the sensor comes nearer")
    posed, placed = Posed.found(found), scans.with_poses(found.poses, other_world=True)
    if posed.pieces > 1:
        rows = posed.rows
        results.add(f"the scans {rows.start} to {rows.stop - 1} are used, the longest piece")
        placed = placed.select(range(len(placed))[rows])
    return placed, posed
