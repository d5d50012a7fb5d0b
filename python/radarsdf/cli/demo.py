# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf demo``: every step of the package on simulated scans."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.options import add_fit_options, add_json, add_surface, config_of, limits_of, progress_of
from radarsdf.cli.results import Results
from radarsdf.cli.saying import complain

if TYPE_CHECKING:
    import trimesh

    from radarsdf import RadarMap
    from radarsdf.io.scans import Scans

SCENES = ("hugin", "oculii", "wall", "astyx")
"""The names in `radarsdf.simulate.SCENES`, which is not imported for a help text."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("--scene", choices=SCENES, default="hugin", help="default: hugin")
    parser.add_argument("--frames", type=int, help="number of scans; default: depends on the scene")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("radarsdf_demo"),
        help="the folder to write; default: radarsdf_demo",
    )
    parser.add_argument(
        "--view",
        action=argparse.BooleanOptionalAction,
        help="show the map in the browser at the end, until Ctrl-C; default: in a terminal of a machine with a screen",
    )
    add_surface(parser)
    add_fit_options(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Simulate, fit, mesh, evaluate, write."""
    if options.frames is not None and options.frames < 2:
        msg = f"--frames must be at least 2, one of them to be held out, not {options.frames}"
        raise ValueError(msg)
    config = config_of(options)

    import radarsdf.map.mesh  # here and not by the first mesh: the printed times are without imports
    from radarsdf import fit
    from radarsdf.cli.held_out import add_intensity_errors
    from radarsdf.cli.saving import save_map
    from radarsdf.evaluation import holdout
    from radarsdf.io import Scans, write_scans
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import write_mesh
    from radarsdf.render.picture import save_picture

    shown = ends_with_viewer(options)
    options.out.mkdir(parents=True, exist_ok=True)
    check_outputs(options.out / name for name in ("scans.npz", "map.safetensors", "mesh.ply", "picture.png"))
    results = Results(options)
    results.add(
        f"simulates the drive of a radar, makes a map of it, compares that with the truth, and writes all to {options.out}"
    )
    simulation = radarsdf.simulate.SCENES[options.scene](frames=options.frames)
    scans = Scans(
        simulation.points,
        simulation.poses,
        simulation.intensities,
        simulation.ground_truth,
        truth_kind="simulated",
    )
    train, test = holdout(len(scans.points))
    returns = sum(map(len, scans.points))
    results.add(
        f"simulated a drive, {options.scene}: {returns} returns in {len(scans)} scans",
        returns=returns,
        scans=len(scans),
    )

    started_s = time.perf_counter()
    kept = scans.select(train)
    radar_map = fit(kept.points, kept.poses, kept.intensities, config=config, progress=progress_of(options))
    fit_s = time.perf_counter() - started_s
    save_map(radar_map, options.out / "map.safetensors")  # first: what comes after it can be had from the map
    started_s = time.perf_counter()
    viewpoint = scans.poses[len(scans.poses) // 2, :3, 3]
    mesh = radar_map.mesh(
        options.voxel, viewpoint=viewpoint, **limits_of(options), progress=progress_of(options)
    )
    mesh_s = time.perf_counter() - started_s
    results.add(
        f"fitted a map to {len(train)} of them in {fit_s:.1f} s, and made a mesh of it in {mesh_s:.1f} s: {radar_map}",
        fit_s=fit_s,
        mesh_s=mesh_s,
    )

    _say_errors(results, radar_map, mesh, scans)
    add_intensity_errors(results, radar_map, scans.select(test), kept)

    write_scans(options.out / "scans.npz", scans)
    write_mesh(options.out / "mesh.ply", mesh)
    files = ["scans.npz", "map.safetensors", "mesh.ply"]
    try:
        save_picture(options.out / "picture.png", mesh, scalar=mesh.vertex_attributes["intensity"])
        files.append("picture.png")
    except ImportError as error:  # Matplotlib is optional
        complain(f"no picture: {error}")
    results.add(
        "wrote " + ", ".join(str(options.out / name) for name in files),
        files=[options.out / n for n in files],
    )
    looked_at = [str(options.out / name) for name in ("map.safetensors", "scans.npz")]
    results.add(f"next: {shlex.join(['radarsdf', 'view', *looked_at])}")
    results.end()
    if shown:
        _show(radar_map, scans, options)


def _show(radar_map: RadarMap, scans: Scans, options: argparse.Namespace) -> None:
    from radarsdf.cli.view import show

    show(
        radar_map,
        scans,
        open_page=True,
        voxel_size=options.voxel,
        progress=progress_of(options),
        **limits_of(options),
    )


def ends_with_viewer(options: argparse.Namespace) -> bool:
    """Whether the viewer ends the demo. It waits for who looks, so not unless somebody is there, or it was asked for."""
    from radarsdf.view.serving import has_display, require_viser

    asked, somebody = options.view, sys.stdout is not None and sys.stdout.isatty() and has_display()
    if asked or (asked is None and somebody and not options.json):
        try:
            require_viser()
        except ImportError:  # it is optional
            if asked:
                raise
            return False
        return True
    return False


def _say_errors(results: Results, radar_map: RadarMap, mesh: trimesh.Trimesh, scans: Scans) -> None:
    """Say how far the mesh is from the truth, expected and measured if that is known, and what the lines on intensities are."""
    from radarsdf.evaluation import format_metrics, surface_metrics

    results.add_threshold(mesh.metadata)
    if scans.ground_truth is not None:
        metrics = surface_metrics(mesh, scans.ground_truth, samples=1_000_000)
        results.add(
            f"{metrics['precision']:.1%} of the mesh lies within {metrics['threshold_m']:g} m of the true surface, and "
            f"{metrics['completion_ratio']:.1%} of that surface within {metrics['threshold_m']:g} m of the mesh:"
        )
        results.add(format_metrics(metrics), surface=metrics)
    if radar_map.has_intensity:
        results.add(
            "intensities of the scans that the fit did not see, and how far the nearest returns (kNN) are off:"
        )
