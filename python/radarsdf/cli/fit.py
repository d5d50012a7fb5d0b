# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf fit``: from scans to a map."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.map_in import MAP_SUFFIX
from radarsdf.cli.options import add_fit_options, add_json, config_of, progress_of
from radarsdf.cli.posing import scans_and_poses
from radarsdf.cli.results import Results, counted
from radarsdf.cli.saying import complain
from radarsdf.cli.scans_in import add_scans, inputs_of, words_of

if TYPE_CHECKING:
    from radarsdf import RadarMap
    from radarsdf.io.scans import Scans


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
    parser.add_argument(
        "--refine",
        action="store_true",
        help="mend the poses by the returns first; radarsdf poses writes them",
    )
    parser.add_argument("--geometry-only", action="store_true", help="do not use the intensities")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="PATH",
        help="save the state of the fit in this file from time to time; if the file exists, continue from it; "
        "it is removed when the map is written",
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="HTML",
        help="also write a page about the map: pictures, errors, plots, settings",
    )
    add_fit_options(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Fit a map, or estimate what the fit takes."""
    config = config_of(options)
    _check_report(options)

    from radarsdf import Interrupted, estimate, fit
    from radarsdf.cli.check import warn_or_refuse
    from radarsdf.cli.saving import save_map
    from radarsdf.io.files import check_outputs

    check_outputs([options.out, options.checkpoint, options.report], inputs_of(options))
    if options.out is not None and options.out.suffix != MAP_SUFFIX:
        msg = f"{options.out}: a map is written as {MAP_SUFFIX}, by which the other commands know it"
        raise ValueError(msg)
    results = Results(options)
    scans, posed = scans_and_poses(options, config, results, refine=options.refine)
    every_scan = scans
    config = posed.config(config)
    held_out = None
    if options.holdout is not None:
        from radarsdf.evaluation import holdout

        train, test = holdout(len(scans.points), options.holdout)
        scans, held_out = scans.select(train), scans.select(test)
    intensities = None if options.geometry_only else scans.intensities
    if options.dry_run:
        expected = estimate(scans.points, scans.poses, intensities, config=config)
        results.add(str(expected), **dataclasses.asdict(expected))
        results.end()
        return
    if not options.no_check:
        warn_or_refuse(scans, intensities)
    started_s = time.perf_counter()
    try:
        radar_map = fit(
            scans.points,
            scans.poses,
            intensities,
            doppler_mps=scans.doppler_mps,
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
    if posed.way is not None:
        radar_map.report["poses"] = posed.way
    save_map(radar_map, options.out)
    if options.checkpoint is not None:
        options.checkpoint.unlink(missing_ok=True)
    _say(results, radar_map, options, len(scans), time.perf_counter() - started_s)
    if options.report is not None:
        _report(results, radar_map, options, every_scan, (scans, held_out))
    results.end()


def _report(
    results: Results,
    radar_map: RadarMap,
    options: argparse.Namespace,
    every_scan: Scans,
    parts: tuple[Scans, Scans | None],
) -> None:
    """Writes the page. `parts`: the scans of the fit, and those that were held out."""
    from radarsdf import check
    from radarsdf.cli.report import add_report
    from radarsdf.report.subject import Subject

    findings = check(every_scan, config=radar_map.config)
    subject = Subject(radar_map, options.out.name, *parts, findings, progress=progress_of(options))
    add_report(results, options.report, subject)


def _check_report(options: argparse.Namespace) -> None:
    """Refuse a report that could not be made, before the work."""
    if options.report is None:
        return
    from radarsdf.report.page import require_extras

    require_extras()
    if options.dry_run:
        msg = "--dry-run makes no map that --report could be about: leave out one of them"
        raise ValueError(msg)


def _say(
    results: Results, radar_map: RadarMap, options: argparse.Namespace, scans: int, seconds: float
) -> None:
    """Say what the fit used, what it left out, what it found, and what to do next."""
    report, out = radar_map.report, options.out
    returns, used, movers, ghosts = (report[name] for name in ("returns", "returns_used", "movers", "ghosts"))
    left_out = {"move by their Doppler": movers, "are ghosts": ghosts}
    left_out["are out of range"] = returns - used - movers - ghosts
    parts = [f"{count} {why}" for why, count in left_out.items() if count]
    results.add(
        f"{used} of {returns} returns in {counted(scans, 'scan')} make the surface"
        + "".join(f", {part}" for part in parts),
        scans=scans,
        **{name: report[name] for name in ("returns", "returns_used", "movers", "ghosts")},
    )
    if wild := report["wild_intensities"]:
        results.add(
            f"{wild} intensities cannot belong to the others, and are left out of the reflectance: "
            "radarsdf check names them",
            wild_intensities=wild,
        )
    for line in report["skipped"]:
        if "moves" in line:
            complain(f"radarsdf fit: warning: no returns were left out that move: {line.partition(': ')[2]}")
    noise, losses = report["noise"], report["losses"]
    loss = "".join(f", {stage} loss {value:.3g}" for stage, value in losses.items())
    results.add(f"fit {seconds:.1f} s: {radar_map}{loss}", seconds=seconds, losses=losses)
    results.add(
        "noise {range_m:.3f} m, azimuth {azimuth_rad:.4f} rad, elevation {elevation_rad:.4f} rad".format(
            **noise
        ),
        noise=noise,
    )
    results.add(f"written to {out}", out=out, leaf_cells=report["leaf_cells"], map_bytes=radar_map.file_bytes)
    following = ["radarsdf", "mesh", str(out), "-o", str(out.with_suffix(".ply"))]
    if options.quick:
        following += ["--voxel", "0.2"]
    results.add(f"next: {shlex.join(following)}", next=shlex.join(following))
    if options.holdout is not None:
        words = ["radarsdf", "eval", str(out), *words_of(options), "--holdout", str(options.holdout)]
        results.add(f"and: {shlex.join(words)}", evaluate=shlex.join(words))
