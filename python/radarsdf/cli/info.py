# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf info``: what a bug report needs, and what a map holds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.map_in import MAP, load_map
from radarsdf.cli.options import add_json
from radarsdf.cli.results import Results

if TYPE_CHECKING:
    from radarsdf.map.map import Map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("map", type=Path, nargs="?", help=f"say also what is in {MAP}")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Print one line for each part."""
    from radarsdf.versions import versions

    radar_map = None if options.map is None else load_map(options.map)
    results = Results(options)
    for name, value in versions().items():
        results.add(_line(name, value), **{name.replace(" ", "_"): value})
    if radar_map is not None:
        _add_map(results, radar_map)
    results.end()


def _add_map(results: Results, radar_map: Map) -> None:
    scale, sensor = radar_map.intensity_scale, radar_map.sensor
    limits = None if scale is None else (scale.low, scale.high)
    cells, edge_m, size = radar_map.num_cells, radar_map.config.leaf_size_m, radar_map.file_bytes
    results.add(_line("map", repr(radar_map)), map=repr(radar_map))
    report = radar_map.report
    counted_in = {name: report[name] for name in ("scans", "returns") if name in report}
    words = ", ".join(f"{count} {name}" for name, count in counted_in.items())
    results.add(_line("made of", words), **counted_in)
    lower, upper = radar_map.extent
    edges = " x ".join(f"{edge:.1f}" for edge in upper - lower)
    corners = " to ".join("({:.1f}, {:.1f}, {:.1f})".format(*corner) for corner in (lower, upper))
    results.add(_line("extent", f"{edges} m, from {corners} m"), extent=[lower, upper])
    results.add(_line("size", f"{size / 1e6:.1f} MB"), bytes=size)
    results.add(_line("leaf cells", f"{cells} of {edge_m:g} m"), leaf_cells=cells, leaf_size_m=edge_m)
    results.add(
        _line("origin", "({:.2f}, {:.2f}, {:.2f}) m".format(*radar_map.origin)), origin=radar_map.origin
    )
    results.add(_line("ranges", "{:.1f} to {:.1f} m".format(*sensor.range_m)), range_m=sensor.range_m)
    results.add(
        _line("intensities", "none" if limits is None else "{:g} to {:g}".format(*limits)), intensities=limits
    )
    results.add(_line("rough returns", f"{radar_map.rough_share:.0%}"), rough_share=radar_map.rough_share)
    if missing := report.get("missing_tiles"):
        results.add(_line("missing tiles", ", ".join(missing)), missing_tiles=missing)


def _line(name: str, value: str) -> str:
    return f"{name:<16}{value}"
