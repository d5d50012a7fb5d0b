# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf compare``: what changed between two maps, or between a map and new scans."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.map_in import add_map, is_map, load_map
from radarsdf.cli.options import add_address, add_box, add_json, box_of, check_address
from radarsdf.cli.results import Results
from radarsdf.cli.saying import say, until_stopped
from radarsdf.cli.scans_in import add_scans, inputs_of, scans_of

if TYPE_CHECKING:
    from radarsdf.changes.changes import Changes, Region

_SAID = 10  # regions, the largest first


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_map(parser)
    add_scans(parser, also="; or the later map")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        help="the file to write: a mesh in colours, such as changes.ply, or .npz with all arrays",
    )
    parser.add_argument(
        "--report", type=Path, metavar="PAGE", help="write a page about what changed, such as changes.html"
    )
    parser.add_argument(
        "--view", action="store_true", help="show what changed in the browser at the end, until Ctrl-C"
    )
    add_address(parser)
    parser.add_argument(
        "--align",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="move the later map as a whole if its surface is then nearer to the earlier one; default: yes",
    )
    parser.add_argument(
        "--min-area", type=float, default=0.1, metavar="M2", help="of what is listed, m2; default: 0.1"
    )
    add_box(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Compare, write the surfaces, say what changed."""
    from radarsdf.changes.compare import compare
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import check_mesh_path

    if options.out is not None and options.out.suffix != ".npz":
        check_mesh_path(options.out)
    check_outputs([options.out, options.report], [options.map, *inputs_of(options)])
    if options.report is not None:
        from radarsdf.report.page import require_extras

        require_extras()
    if options.view:
        check_address(options)
    after = load_map(options.scans) if is_map(options.scans) else scans_of(options)
    before = load_map(options.map)
    changes = compare(before, after, align_frames=options.align, box=box_of(options))
    results = Results(options)
    report = changes.report
    results.add(report["alignment"], alignment=report["alignment"], T_before_after=changes.T_before_after)
    results.add(report["reflectance"], reflectance=report["reflectance"])
    areas = ", ".join(f"{name} {area:.1f}" for name, area in report["areas_m2"].items())
    results.add(
        f"of {report['compared_m2']:.0f} m2 that both saw, m2: {areas}",
        areas_m2=report["areas_m2"],
        compared_m2=report["compared_m2"],
    )
    regions = changes.regions(options.min_area)
    for region in regions[:_SAID]:
        x, y, z = region.box.mean(axis=0)
        results.add(
            f"{region.words}: {region.area_m2:.2f} m2 round {x:.1f} {y:.1f} {z:.1f}, probability {region.probability:.2f}"
        )
    results.add(regions=[vars(region) for region in regions])
    if options.out is not None:
        changes.save(options.out)
        results.add(f"{options.out} written", out=options.out)
    edge_m = before.config.leaf_size_m
    if options.report is not None:
        from radarsdf.report.changes import write_changes_report

        names = options.map.absolute().name, options.scans.absolute().name
        write_changes_report(options.report, changes, names, edge_m, regions)
        results.add(f"{options.report} written", report=options.report)
    results.end()
    if options.view:
        _show(changes, regions, edge_m, options)


def _show(changes: Changes, regions: Sequence[Region], edge_m: float, options: argparse.Namespace) -> None:
    """Serve a page until Ctrl-C, and say where."""
    from radarsdf.view.pages import ChangesView
    from radarsdf.view.serving import url_of

    with ChangesView(changes, regions, edge_m, host=options.host, port=options.port) as view:
        say(f"what changed is on {url_of(view.host, view.port)}; Ctrl-C ends it")
        until_stopped(view)
