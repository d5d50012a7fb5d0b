# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf view``: a map in the browser."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from radarsdf.cli.map_in import add_map, load_map
from radarsdf.cli.options import (
    add_address,
    add_box,
    add_quiet,
    add_surface,
    box_of,
    check_address,
    limits_of,
    progress_of,
)
from radarsdf.cli.saying import say, until_stopped
from radarsdf.cli.scans_in import add_scans, scans_of

if TYPE_CHECKING:
    from radarsdf.io.scans import Scans
    from radarsdf.map.map import Map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_map(parser)
    add_scans(parser, required=False)
    add_surface(parser)
    add_box(parser)
    parser.add_argument(
        "--max-vertices",
        type=int,
        default=500_000,
        metavar="N",
        help="thin the mesh if it has more than N vertices; default: 500000",
    )
    add_address(parser)
    parser.add_argument(
        "--open",
        action=argparse.BooleanOptionalAction,
        help="open the page in a browser here; default: if there is a screen",
    )
    add_quiet(parser)


def run(options: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C."""
    from radarsdf.view.serving import has_display

    check_address(options)
    radar_map = load_map(options.map)
    scans = None if options.scans is None else scans_of(options)
    show(
        radar_map,
        scans,
        open_page=has_display() if options.open is None else options.open,
        voxel_size=options.voxel,
        box=box_of(options),
        max_vertices=options.max_vertices,
        host=options.host,
        port=options.port,
        progress=progress_of(options),
        **limits_of(options),
    )


def show(radar_map: Map, scans: Scans | None, *, open_page: bool, **arguments: Any) -> None:
    """Serve the page until Ctrl-C, and say where. `arguments`: those of :class:`radarsdf.view.viewer.Viewer`."""
    from radarsdf.view.serving import ssh_line, url_of
    from radarsdf.view.viewer import Viewer

    with Viewer(radar_map, scans, **arguments) as viewer:
        url = url_of(viewer.host, viewer.port)
        for note in viewer.notes:
            say(note)
        say(f"{len(viewer.surface.vertices)} vertices on {url}; Ctrl-C ends it")
        say(f"from elsewhere: {ssh_line(viewer.host, viewer.port)}, then {url_of('localhost', viewer.port)}")
        say(f"the surface is {viewer.surface.threshold}")
        if open_page:
            import webbrowser

            webbrowser.open(url)
        until_stopped(viewer)
