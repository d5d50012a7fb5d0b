# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf poses``: poses that the radar itself mends or finds."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from radarsdf.cli.map_in import MAP_SUFFIX
from radarsdf.cli.options import add_config_options, add_json, config_of
from radarsdf.cli.posing import scans_and_poses
from radarsdf.cli.results import Results
from radarsdf.cli.scans_in import add_scans, inputs_of, words_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_scans(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        help="the poses to write: .tum (with times), .kitti or .npy; or .npz: the scans with these poses",
    )
    parser.add_argument(
        "--find",
        action="store_true",
        help="do not use the poses of the scans: find them from returns and Doppler",
    )
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="also draw the trajectory from above, before and after"
    )
    add_config_options(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Refine the poses of the scans, or find them, and write them."""
    from radarsdf.io.files import check_outputs
    from radarsdf.io.npz import write_scans
    from radarsdf.io.poses.files import check_pose_suffix, write_poses

    config = config_of(options)
    as_scans = options.out.suffix.lower() == ".npz"
    if not as_scans:
        check_pose_suffix(options.out)
    check_outputs([options.out, options.picture], inputs_of(options))
    if options.find and options.poses is not None:
        msg = f"--find does not use poses: leave out {options.poses}"
        raise ValueError(msg)
    if options.picture is not None:
        from radarsdf.extras import require

        require("matplotlib", what="pictures need")
    results = Results(options)
    scans, posed = scans_and_poses(options, config, results, refine=True, find=options.find, out=options.out)
    if as_scans:
        write_scans(options.out, scans)
    elif posed.pieces > 1 and options.out.suffix.lower() != ".tum":
        msg = f"there are {posed.pieces} pieces, and {options.out} would not say which scans have poses: write .tum or .npz"
        raise ValueError(msg)
    else:
        write_poses(options.out, scans.poses, scans.times_s)
    results.add(f"{len(scans.poses)} poses written to {options.out}", out=options.out)
    if options.picture is not None:
        from radarsdf.render.figures import save_trajectory_picture

        drawn = (
            {"found": scans.poses} if posed.given is None else {"given": posed.given, "refined": scans.poses}
        )
        save_trajectory_picture(options.picture, scans.points, drawn)
        results.add(f"picture {options.picture}", picture=options.picture)
    following = _following(options, as_scans)
    results.add(f"next: {following}", next=following)
    results.end()


def _following(options: argparse.Namespace, as_scans: bool) -> str:
    """The command to run next: a fit with these poses."""
    from radarsdf.io.folders import BASE_T_RADAR

    target = ["-o", options.out.stem + MAP_SUFFIX]
    if as_scans:
        words = ["fit", str(options.out), *target]
    elif (options.scans / BASE_T_RADAR).is_file():  # which would be applied to the written poses, too
        find = ["--find"] if options.find else []
        words = ["poses", *words_of(options), *find, "-o", str(options.out.with_suffix(".npz"))]
    else:
        # The written poses are those of the radar: what leads to it from other poses has no part in them.
        written = {"poses": options.out, "extrinsic": None, "pose_topic": None}
        words = ["fit", *words_of(argparse.Namespace(**{**vars(options), **written})), *target]
    return shlex.join(["radarsdf", *words])
