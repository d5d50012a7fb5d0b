# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf compare``: what changed between two maps, or between a map and new scans."""

from __future__ import annotations

import argparse
from pathlib import Path

from radarsdf.cli.map_in import add_map, is_map, load_map
from radarsdf.cli.options import add_box, add_json, box_of
from radarsdf.cli.results import Results
from radarsdf.cli.scans_in import add_scans, inputs_of, scans_of

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

    if options.out is not None:
        if options.out.suffix != ".npz":
            check_mesh_path(options.out)
        check_outputs([options.out], [options.map, *inputs_of(options)])
    after = load_map(options.scans) if is_map(options.scans) else scans_of(options)
    changes = compare(load_map(options.map), after, align_frames=options.align, box=box_of(options))
    results = Results(options)
    report = changes.report
    results.add(report["alignment"], alignment=report["alignment"], T_before_after=changes.T_before_after)
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
            f"{region.kind}: {region.area_m2:.2f} m2 round {x:.1f} {y:.1f} {z:.1f}, probability {region.probability:.2f}"
        )
    results.add(
        regions=[
            {
                "kind": region.kind,
                "box": region.box,
                "area_m2": region.area_m2,
                "probability": region.probability,
            }
            for region in regions
        ]
    )
    if options.out is not None:
        changes.save(options.out)
        results.add(f"{options.out} written", out=options.out)
    results.end()
