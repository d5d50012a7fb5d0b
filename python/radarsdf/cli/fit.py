# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf fit``: from scans to a map."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from radarsdf.cli.options import add_fit_options, config_of, progress_of
from radarsdf.cli.saying import say
from radarsdf.cli.scans_in import add_scans, scans_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_scans(parser)
    out = parser.add_mutually_exclusive_group(required=True)
    out.add_argument("-o", "--out", type=Path, help="the map to write, .safetensors")
    out.add_argument("--dry-run", action="store_true", help="only estimate memory and time")
    parser.add_argument(
        "--holdout",
        type=int,
        metavar="N",
        help="leave out the first scan and then every N-th scan, for radarsdf eval --holdout N",
    )
    parser.add_argument(
        "--no-check", action="store_true", help="fit the scans even if radarsdf check would find an error"
    )
    parser.add_argument("--geometry-only", action="store_true", help="do not use the intensities")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="PATH",
        help="save the state of the fit in this file from time to time; if the file exists, continue from it; "
        "it is removed when the map is written",
    )
    add_fit_options(parser)


def run(options: argparse.Namespace) -> None:
    """Fit a map, or estimate what the fit takes."""
    config = config_of(options)

    from radarsdf import Interrupted, estimate, fit
    from radarsdf.cli.check import warn_or_refuse
    from radarsdf.cli.saving import save_map
    from radarsdf.io.files import check_outputs

    inputs = [path for path in (options.scans, options.poses, options.extrinsic) if path is not None]
    check_outputs([options.out, options.checkpoint], inputs)
    scans = scans_of(options)
    if options.holdout is not None:
        from radarsdf.evaluation import holdout

        scans = scans.select(holdout(len(scans.points), options.holdout)[0])
    intensities = None if options.geometry_only else scans.intensities
    if options.dry_run:
        say(str(estimate(scans.points, scans.poses, intensities, config=config)))
        return
    if not options.no_check:
        warn_or_refuse(scans, intensities)
    started_s = time.perf_counter()
    try:
        radar_map = fit(
            scans.points,
            scans.poses,
            intensities,
            config=config,
            progress=progress_of(options),
            checkpoint=options.checkpoint,
        )
    except Interrupted as stop:
        if stop.radar_map is not None:
            try:
                save_map(stop.radar_map, options.out)
                stop.args = (f"{stop}; the map so far is in {options.out}",)
            except OSError as error:
                stop.args = (f"{stop}; {error}",)
        raise
    save_map(radar_map, options.out)
    if options.checkpoint is not None:
        options.checkpoint.unlink(missing_ok=True)
    say(f"fit {time.perf_counter() - started_s:.1f} s: {radar_map}, written to {options.out}")
    say(
        "noise {range_m:.3f} m, azimuth {azimuth_rad:.4f} rad, elevation {elevation_rad:.4f} rad".format(
            **radar_map.report["noise"]
        )
    )
