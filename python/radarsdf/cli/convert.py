# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf convert``: scans to our file or to one point cloud, and meshes between formats."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.options import add_json, add_quiet, progress_of
from radarsdf.cli.results import Results, counted
from radarsdf.cli.scans_in import add_scans, inputs_of, scans_of

if TYPE_CHECKING:
    from radarsdf.io.scans import Scans


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_scans(parser, also=", or a mesh: .ply, .obj, .off, .stl, .glb")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        help=".npz: the scans with their poses, as every command reads them; .ply, .pcd, .las, .laz, .npy or .csv: all "
        "returns in the world frame, with intensity, doppler, number and time of the scan; of a mesh, a mesh",
    )
    add_quiet(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Read, and write as the ending of the output says."""
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import holds_mesh

    check_outputs([options.out], inputs_of(options))
    results = Results(options)
    if options.poses is None and holds_mesh(options.scans):
        _convert_mesh(options, results)
    else:
        _convert_scans(options, results)
    results.end()


def _convert_mesh(options: argparse.Namespace, results: Results) -> None:
    from radarsdf.cli.mesh import say_mesh
    from radarsdf.io.meshes import check_mesh_path, read_mesh, write_mesh

    check_mesh_path(options.out)
    mesh = read_mesh(options.scans)
    say_mesh(results, mesh, options.out, write_mesh(options.out, mesh))


def _convert_scans(options: argparse.Namespace, results: Results) -> None:
    from radarsdf.io.clouds.reading import CLOUD_SUFFIXES
    from radarsdf.io.clouds.writing import check_cloud_path, write_cloud
    from radarsdf.io.files import origin_path
    from radarsdf.io.npz import write_scans

    suffix = options.out.suffix.lower()
    if suffix != ".npz":
        check_cloud_path(options.out)
    folder = options.scans.resolve()
    if suffix in CLOUD_SUFFIXES and folder.is_dir() and folder in options.out.resolve().parents:
        msg = f"{options.out} lies in the folder of the scans, and would be taken for one of them: write it elsewhere"
        raise ValueError(msg)
    scans = scans_of(options)
    if suffix == ".npz":
        write_scans(options.out, scans)
        _say(results, scans, sum(map(len, scans.points)), options.out)
        return
    written = write_cloud(options.out, scans, progress=progress_of(options))
    _say(results, scans, written.returns, options.out)
    results.add(origin=written.origin)
    if written.origin is not None:
        results.add(f"in a local frame, whose origin is in {origin_path(options.out)}")


def _say(results: Results, scans: Scans, returns: int, path: Path) -> None:
    results.add(
        f"{returns} returns of {counted(len(scans), 'scan')} written to {path}",
        returns=returns,
        scans=len(scans),
        out=path,
    )
