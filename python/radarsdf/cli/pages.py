"""``radarsdf view`` and ``report``: a map as a web page."""

from __future__ import annotations

import webbrowser
from argparse import Namespace
from pathlib import Path

from radarsdf import check
from radarsdf.cli.inputs import check_address, inputs_of, load_map, mesh_limits, scans_if, split
from radarsdf.cli.localise import located, unposed_scans
from radarsdf.cli.options import refuse_if
from radarsdf.cli.results import Results, until_stopped
from radarsdf.io.files import check_outputs
from radarsdf.map.map import Map
from radarsdf.report.sections import Subject
from radarsdf.report.writing import require_extras, write_report
from radarsdf.scans import Scans
from radarsdf.view import serving
from radarsdf.view.pages import Viewer


def view(given: Namespace, results: Results) -> None:
    """Serve the page until Ctrl-C, after printing its address."""
    check_address(given)
    radar_map = load_map(given.map)
    scans, options = _scans(given, radar_map, results), {"box": given.box, "progress": results.progress}
    page = {"voxel_size": given.voxel, "host": given.host, "port": given.port}
    with Viewer(radar_map, scans, **page, **options, **mesh_limits(given)) as viewer:
        url = serving.url_of(viewer.host, viewer.port)
        print(f"{len(viewer.surface.vertices)} vertices on {url}; Ctrl-C ends it", flush=True)
        if serving.has_display() if given.open is None else given.open:
            webbrowser.open(url)
        until_stopped(viewer.wait)


def report(given: Namespace, results: Results) -> None:
    """Write the page."""
    lacking = given.holdout and not given.scans
    refuse_if(lacking, f"--holdout {given.holdout} needs the scans: name them after the map")

    require_extras()
    check_outputs([given.out], inputs_of(given))
    radar_map = load_map(given.map)
    scans = findings = held_out = None
    every_scan = _scans(given, radar_map, results)
    if every_scan is not None:
        findings = check(every_scan, config=radar_map.config)
        scans, held_out = split(every_scan, given.holdout)
    options = {"voxel_size_m": given.voxel, "box": given.box, "limits": mesh_limits(given)}
    name = given.map.absolute().name
    subject = Subject(radar_map, name, scans, held_out, findings, progress=results.progress, **options)
    add_report(results, given.out, subject)


def _scans(given: Namespace, radar_map: Map, results: Results) -> Scans | None:
    if not given.locate:
        return scans_if(given.scans, given)
    refuse_if(not given.scans, "--locate needs the scans: name them after the map")
    return located(radar_map, unposed_scans(given), results)


def add_report(results: Results, path: Path, subject: Subject) -> None:
    size = write_report(path, subject)
    results.add(f"report of {size / 1e6:.1f} MB written to {path}", report=path, report_bytes=size)
