# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf eval``: the errors of a surface against lidar points, and of intensities against held-out scans."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.map_in import MAP, is_map, load_map
from radarsdf.cli.options import add_box, add_json, add_quiet, add_surface, box_of, limits_of, progress_of
from radarsdf.cli.results import Results
from radarsdf.cli.scans_in import SCANS, add_poses, scans_of

if TYPE_CHECKING:
    from radarsdf.io.scans import Scans


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("what", type=Path, help=f"a mesh, or {MAP}")
    parser.add_argument(
        "scans",
        metavar="truth",
        type=Path,
        help="lidar points (.ply, .pcd, .las, .laz, .npy, .npz, .csv, .xyz, .txt, .bin), a surface (.ply, .obj, .off, "
        f".stl, .glb), or scans with lidar points: {SCANS}",
    )
    add_poses(parser)
    parser.add_argument(
        "--holdout",
        type=int,
        metavar="N",
        help="also print the intensity errors on the scans that radarsdf fit --holdout N left out",
    )
    add_surface(parser)
    add_box(parser)
    parser.add_argument(
        "--samples",
        type=int,
        default=10_000_000,
        help="number of points sampled on the mesh; default: 10000000",
    )
    add_quiet(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Print the errors of the surface, the intensities, or both."""
    from radarsdf.cli.held_out import add_intensity_errors
    from radarsdf.evaluation import format_metrics, holdout, surface_metrics
    from radarsdf.io.files import check_regular_file
    from radarsdf.io.meshes import read_ground_truth, read_mesh

    radar_map = load_map(options.what) if is_map(options.what) else None
    if radar_map is None:
        check_regular_file(options.what)
    scans = _scans(options)
    if options.holdout is not None and (radar_map is None or scans is None):
        msg = "--holdout needs a map and scans"
        raise ValueError(msg)
    ground_truth = scans.ground_truth if scans is not None else read_ground_truth(options.scans)
    if ground_truth is None and options.holdout is None:
        msg = (
            f"{options.scans} has no lidar points: lidar_points in an .npz file, lidar.pcd or lidar.ply in a folder; "
            "--holdout N evaluates intensities"
        )
        raise ValueError(msg)
    results = Results(options)
    if ground_truth is not None:
        if radar_map is None:
            mesh = read_mesh(options.what)
        else:
            mesh = radar_map.mesh(options.voxel, **limits_of(options), progress=progress_of(options))
        metrics = surface_metrics(mesh, ground_truth, box=box_of(options), samples=options.samples)
        results.add(format_metrics(metrics), surface=metrics)
    if options.holdout is not None and radar_map is not None and scans is not None:
        train, test = holdout(len(scans), options.holdout)
        add_intensity_errors(results, radar_map, scans.select(test), scans.select(train))
    results.end()


def _scans(options: argparse.Namespace) -> Scans | None:
    """The scans, if the truth is not a file of points or a surface."""
    from radarsdf.io.bags.files import is_bag
    from radarsdf.io.npz import holds_scans

    path = options.scans
    if path.is_dir() or is_bag(path) or options.poses is not None:
        return scans_of(options)
    if path.suffix.lower() == ".npz" and holds_scans(path):
        return scans_of(options)
    return None
