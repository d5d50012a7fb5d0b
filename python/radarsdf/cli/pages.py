# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf view`` and ``report``: a map as a page."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from radarsdf.cli.app import refuse_if
from radarsdf.cli.options import Address, Box, MaybeRecording, Surface, corners_of
from radarsdf.cli.results import Results, load_map, split, until_stopped

if TYPE_CHECKING:
    from radarsdf.io.scans import Scans
    from radarsdf.map.map import Map
    from radarsdf.report.subject import Subject


def view(
    map_path: Path,
    recording: MaybeRecording,
    *,
    open: bool | None = None,
    max_vertices: int = 500_000,
    box: Box = None,
    surface: Surface,
    address: Address,
    quiet: bool = False,
) -> None:
    """Serve the page until Ctrl-C.

    open: Open the page in a browser here; default: if there is a screen.
    max_vertices: Simplify the mesh if it has more vertices.
    quiet: Show no progress bar.
    """
    from radarsdf.view.serving import has_display

    address.check()
    radar_map = load_map(map_path)
    show(
        radar_map,
        recording.read() if recording.scans else None,
        open_page=has_display() if open is None else open,
        voxel_size=surface.voxel,
        box=corners_of(box),
        max_vertices=max_vertices,
        host=address.host,
        port=address.port,
        progress=False if quiet else None,
        **surface.limits,
    )


def show(radar_map: Map, scans: Scans | None, *, open_page: bool, **arguments: Any) -> None:
    """Serve the viewer until Ctrl-C, and print its address. `arguments`: those of :class:`radarsdf.view.viewer.Viewer`."""
    from radarsdf.view.serving import ssh_line, url_of
    from radarsdf.view.viewer import Viewer

    with Viewer(radar_map, scans, **arguments) as viewer:
        url = url_of(viewer.host, viewer.port)
        for note in viewer.notes:
            typer.echo(note)
        typer.echo(f"{len(viewer.surface.vertices)} vertices on {url}; Ctrl-C ends it")
        local = url_of("localhost", viewer.port)
        typer.echo(f"from elsewhere: {ssh_line(viewer.host, viewer.port)}, then {local}")
        typer.echo(f"the surface is {viewer.surface.threshold}")
        if open_page:
            import webbrowser

            webbrowser.open(url)
        until_stopped(viewer)


def report(
    map_path: Path,
    recording: MaybeRecording,
    *,
    out: Path,
    holdout: int | None = None,
    box: Box = None,
    surface: Surface,
    results: Results,
) -> None:
    """Write the page.

    out: The page to write, .html.
    """
    lacking = holdout and not recording.scans
    refuse_if(lacking, f"--holdout {holdout} needs the scans: name them after the map")

    from radarsdf.report.page import require_extras

    require_extras()

    from radarsdf import check
    from radarsdf.io.files import check_outputs
    from radarsdf.report.subject import Subject

    check_outputs([out], [map_path, *recording.inputs])
    radar_map = load_map(map_path)
    scans = findings = held_out = None
    if recording.scans:
        every_scan = recording.read()
        findings = check(every_scan, config=radar_map.config)
        scans, held_out = split(every_scan, holdout)
    subject = Subject(
        radar_map,
        map_path.absolute().name,
        scans,
        held_out,
        findings,
        voxel_size_m=surface.voxel,
        box=corners_of(box),
        progress=results.progress,
        limits=surface.limits,
    )
    add_report(results, out, subject)


def add_report(results: Results, path: Path, subject: Subject) -> None:
    """Write a page about a map."""
    from radarsdf.report.writing import write_report

    started_s = time.perf_counter()
    size = write_report(path, subject)
    seconds = time.perf_counter() - started_s
    line = f"report {seconds:.1f} s: {size / 1e6:.1f} MB written to {path}"
    results.add(line, report=path, report_bytes=size, report_seconds=seconds)
