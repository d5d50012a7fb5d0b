# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf report``: a page about a map."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.map_in import add_map, load_map
from radarsdf.cli.options import add_box, add_json, add_quiet, add_surface, box_of, limits_of, progress_of
from radarsdf.cli.results import Results
from radarsdf.cli.scans_in import add_scans, inputs_of, scans_of

if TYPE_CHECKING:
    from radarsdf.report.subject import Subject


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_map(parser)
    add_scans(parser, required=False)
    parser.add_argument("-o", "--out", type=Path, required=True, help="the page to write, .html")
    parser.add_argument(
        "--holdout",
        type=int,
        metavar="N",
        help="compare intensities on the scans that radarsdf fit --holdout N left out",
    )
    add_surface(parser)
    add_box(parser)
    add_quiet(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Write the page."""
    from radarsdf.report.page import require_extras

    require_extras()
    if options.holdout is not None and options.scans is None:
        msg = "--holdout needs the scans"
        raise ValueError(msg)

    from radarsdf import check
    from radarsdf.evaluation import holdout
    from radarsdf.io.files import check_outputs
    from radarsdf.report.subject import Subject

    check_outputs([options.out], [options.map, *inputs_of(options)])
    radar_map = load_map(options.map)
    scans = findings = held_out = None
    if options.scans is not None:
        scans = scans_of(options)
        findings = check(scans, config=radar_map.config)
        if options.holdout is not None:
            train, test = holdout(len(scans.points), options.holdout)
            scans, held_out = scans.select(train), scans.select(test)
    results = Results(options)
    subject = Subject(
        radar_map,
        options.map.absolute().name,
        scans,
        held_out,
        findings,
        voxel_size_m=options.voxel,
        box=box_of(options),
        progress=progress_of(options),
        limits=limits_of(options),
    )
    add_report(results, options.out, subject)
    results.end()


def add_report(results: Results, path: Path, subject: Subject) -> None:
    """Write a page, and say so."""
    from radarsdf.report.writing import write_report

    started_s = time.perf_counter()
    size = write_report(path, subject)
    seconds = time.perf_counter() - started_s
    results.add(
        f"report {seconds:.1f} s: {size / 1e6:.1f} MB written to {path}",
        report=path,
        report_bytes=size,
        report_seconds=seconds,
    )
