# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf demo``: every step of the package on simulated scans."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from radarsdf.cli.options import add_fit_options, add_json, config_of, progress_of
from radarsdf.cli.results import Results
from radarsdf.cli.saying import complain

SCENES = ("hugin", "oculii", "wall", "astyx")
"""The names in `radarsdf.simulate.SCENES`, which is not imported for a help text."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("--scene", choices=SCENES, default="hugin", help="default: hugin")
    parser.add_argument("--frames", type=int, help="number of scans; default: depends on the scene")
    parser.add_argument(
        "--out", type=Path, default=Path("radarsdf_demo"), help="output folder; default: radarsdf_demo"
    )
    add_fit_options(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Simulate, fit, mesh, evaluate, write."""
    if options.frames is not None and options.frames < 2:
        msg = f"--frames must be at least 2, one of them to be held out, not {options.frames}"
        raise ValueError(msg)
    config = config_of(options)

    import radarsdf.map.meshing  # here and not by the first mesh: the printed times are without imports
    from radarsdf import fit
    from radarsdf.cli.held_out import add_intensity_errors
    from radarsdf.cli.saving import save_map
    from radarsdf.evaluation import format_metrics, holdout, surface_metrics
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import write_mesh
    from radarsdf.io.scans import Scans, write_scans
    from radarsdf.render.picture import save_picture

    options.out.mkdir(parents=True, exist_ok=True)
    check_outputs(options.out / name for name in ("scans.npz", "map.safetensors", "mesh.ply", "picture.png"))
    simulation = radarsdf.simulate.SCENES[options.scene](frames=options.frames)
    scans = Scans(simulation.points, simulation.poses, simulation.intensities, simulation.ground_truth)
    train, test = holdout(len(scans.points))
    results = Results(options)
    returns = sum(map(len, scans.points))
    results.add(
        f"simulated {options.scene}: {returns} returns in {len(scans)} scans",
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
    mesh = radar_map.mesh(viewpoint=viewpoint, progress=progress_of(options))
    mesh_s = time.perf_counter() - started_s
    results.add(f"fit {fit_s:.1f} s, mesh {mesh_s:.1f} s: {radar_map}", fit_s=fit_s, mesh_s=mesh_s)

    if scans.ground_truth is not None:
        metrics = surface_metrics(mesh, scans.ground_truth, samples=1_000_000)
        results.add(format_metrics(metrics), surface=metrics)
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
    results.end()
