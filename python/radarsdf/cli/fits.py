# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf fit``, ``demo`` and ``config``: from scans to a map."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from radarsdf.cli.app import refuse_if, warn
from radarsdf.cli.options import MAP_SUFFIX, Recording, Settings, Surface, words_of
from radarsdf.cli.pages import add_report, show
from radarsdf.cli.results import Results, add_intensity_errors, counted, save_map, split
from radarsdf.cli.scans import scans_and_poses, warn_or_refuse

if TYPE_CHECKING:
    import trimesh

    from radarsdf import RadarMap
    from radarsdf.io.scans import Scans


def config(settings: Settings) -> None:
    """Print the configuration as TOML."""
    from radarsdf.config.toml import to_toml

    typer.echo(to_toml(settings.load()), nl=False)


def fit(
    recording: Recording,
    *,
    out: Path | None = None,
    dry_run: bool = False,
    holdout: int | None = None,
    refine: bool = False,
    geometry_only: bool = False,
    no_check: bool = False,
    checkpoint: Path | None = None,
    report: Path | None = None,
    settings: Settings,
    results: Results,
) -> None:
    """Fit a map, or estimate what the fit takes.

    out: The map to write, .safetensors.
    dry_run: Only estimate memory and time.
    holdout: Leave out the first scan and then every N-th scan, for radarsdf eval --holdout N.
    refine: Refine the poses by the returns first; radarsdf poses writes refined poses.
    checkpoint: Save the state of the fit in this file from time to time; if the file exists, continue from it; it is removed
        when the map is written.
    report: Also write a page about the map, .html: pictures, errors, plots, settings.
    """
    from radarsdf import check, estimate, fit
    from radarsdf.io.files import check_outputs
    from radarsdf.report.page import require_extras
    from radarsdf.report.subject import Subject

    refuse_if((out is None) != dry_run, "-o MAP writes the map, --dry-run only estimates: give one of them")
    refuse_if(out and out.suffix != MAP_SUFFIX, f"{out}: a map is written as {MAP_SUFFIX}")
    refuse_if(dry_run and report, f"--dry-run makes no map: leave out --report {report}")
    if report is not None:
        require_extras()
    config = settings.load()

    check_outputs([out, checkpoint, report], recording.inputs)
    every_scan, posed = scans_and_poses(recording, config, results, refine=refine)
    config = posed.config(config)
    scans, held_out = split(every_scan, holdout)
    intensities = None if geometry_only else scans.intensities
    if out is None:
        expected = estimate(scans.points, scans.poses, intensities, config=config)
        results.add(str(expected), **dataclasses.asdict(expected))
        return
    if not no_check:
        warn_or_refuse(scans, intensities)
    started_s = time.perf_counter()
    with _saved_if_interrupted(out):
        radar_map = fit(
            scans.points,
            scans.poses,
            intensities,
            doppler_mps=scans.doppler_mps,
            config=config,
            progress=results.progress,
            checkpoint=checkpoint,
        )
    seconds = time.perf_counter() - started_s
    if posed.way is not None:
        radar_map.report["poses"] = posed.way
    save_map(radar_map, out)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    _add_fit(results, radar_map, len(scans), seconds)
    results.add(f"written to {out}", out=out)
    following = shlex.join(["radarsdf", "mesh", str(out), "-o", str(out.with_suffix(".ply"))])
    following += " --voxel 0.2" if settings.quick else ""
    results.add(f"next: {following}", next=following)
    if holdout is not None:
        words = ["radarsdf", "eval", str(out), *words_of(recording), "--holdout", str(holdout)]
        results.add(f"and: {shlex.join(words)}", evaluate=shlex.join(words))
    if report is not None:
        findings = check(every_scan, config=radar_map.config)
        subject = Subject(radar_map, out.name, scans, held_out, findings, progress=results.progress)
        add_report(results, report, subject)


@contextlib.contextmanager
def _saved_if_interrupted(path: Path) -> Iterator[None]:
    """Keeps the map of a fit that Ctrl-C stops, and adds to the error where it is."""
    from radarsdf import Interrupted

    try:
        yield
    except Interrupted as stop:
        if stop.radar_map is not None:
            try:
                save_map(stop.radar_map, path)
                stop.args = (f"{stop}; the map so far is in {path}",)
            except OSError as error:
                stop.args = (f"{stop}; {error}",)
        raise


def _add_fit(results: Results, radar_map: RadarMap, scans: int, seconds: float) -> None:
    """Add the counts of returns, the losses and the estimated noise of a fit."""
    report = radar_map.report
    counts = {name: report[name] for name in ("returns", "returns_used", "movers", "ghosts")}
    returns, used, movers, ghosts = counts.values()
    left_out = {
        "move by their Doppler": movers,
        "are ghosts": ghosts,
        "are out of range": returns - used - movers - ghosts,
    }
    line = f"{used} of {returns} returns in {counted(scans, 'scan')} make the surface"
    line += "".join(f", {count} {why}" for why, count in left_out.items() if count)
    results.add(line, scans=scans, **counts)
    if outliers := report["wild_intensities"]:
        line = f"{outliers} intensities are outliers, and are left out of the reflectance: radarsdf check names them"
        results.add(line, wild_intensities=outliers)
    for line in report["skipped"]:
        if "moves" in line:
            warn(f"warning: no moving returns were left out: {line.partition(': ')[2]}")
    noise, losses = report["noise"], report["losses"]
    loss = "".join(f", {stage} loss {value:.3g}" for stage, value in losses.items())
    results.add(f"fit {seconds:.1f} s: {radar_map}{loss}", seconds=seconds, losses=losses)
    results.add(
        f"noise {noise['range_m']:.3f} m, azimuth {noise['azimuth_rad']:.4f} rad, "
        f"elevation {noise['elevation_rad']:.4f} rad",
        noise=noise,
        leaf_cells=report["leaf_cells"],
        map_bytes=radar_map.file_bytes,
    )


def demo(
    *,
    scene: Literal["hugin", "oculii", "wall", "astyx"] = "hugin",
    frames: int | None = None,
    out: Path = Path("radarsdf_demo"),
    view: bool | None = None,
    surface: Surface,
    settings: Settings,
    results: Results,
) -> None:
    """Simulate, fit, mesh, evaluate, write.

    scene: The radar and the place.
    frames: Number of scans; default: depends on the scene.
    out: The folder to write.
    view: Show the map in the browser at the end, until Ctrl-C; default: in a terminal of a machine with a screen.
    """
    too_few = frames is not None and frames < 2
    refuse_if(too_few, f"--frames must be at least 2, one to be held out, not {frames}")

    import radarsdf.map.mesh  # here and not by the first mesh: the printed times are without imports
    from radarsdf.evaluation import holdout
    from radarsdf.io import write_scans
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import write_mesh
    from radarsdf.render.picture import save_picture

    config, progress = settings.load(), results.progress
    view = _ends_with_viewer(view, results.json)
    out.mkdir(parents=True, exist_ok=True)
    files = [out / name for name in ("scans.npz", "map.safetensors", "mesh.ply", "picture.png")]
    check_outputs(files)
    scans_file, map_file, mesh_file, picture_file = files
    results.add(
        f"simulates a drive, makes a map of it, compares that with the truth, and writes all to {out}"
    )
    scans = _simulated(scene, frames)
    train, test = holdout(len(scans.points))
    returns = sum(map(len, scans.points))
    line = f"simulated a drive, {scene}: {returns} returns in {len(scans)} scans"
    results.add(line, returns=returns, scans=len(scans))

    fitted = scans.select(train)
    started_s = time.perf_counter()
    radar_map = radarsdf.fit(
        fitted.points, fitted.poses, fitted.intensities, config=config, progress=progress
    )
    fit_s = time.perf_counter() - started_s
    save_map(radar_map, map_file)  # first: the rest can be had from the map
    started_s = time.perf_counter()
    viewpoint = scans.poses[len(scans.poses) // 2, :3, 3]
    mesh = radar_map.mesh(surface.voxel, viewpoint=viewpoint, **surface.limits, progress=progress)
    mesh_s = time.perf_counter() - started_s
    line = f"fitted a map to {len(train)} of them in {fit_s:.1f} s, and made a mesh of it in {mesh_s:.1f} s: {radar_map}"
    results.add(line, fit_s=fit_s, mesh_s=mesh_s)

    _add_surface_errors(results, mesh, scans)
    results.add("errors of the intensities of held-out scans, of the map and of the nearest returns (kNN):")
    add_intensity_errors(results, radar_map, scans.select(test), fitted)

    write_scans(scans_file, scans)
    write_mesh(mesh_file, mesh)
    try:
        save_picture(picture_file, mesh, scalar=mesh.vertex_attributes["intensity"])
    except ImportError as error:  # Matplotlib is optional
        files.remove(picture_file)
        warn(f"warning: no picture: {error}")
    results.add("wrote " + ", ".join(map(str, files)), files=files)
    results.add(f"next: {shlex.join(['radarsdf', 'view', str(map_file), str(scans_file)])}")
    if view:
        results.end()
        show(radar_map, scans, open_page=True, voxel_size=surface.voxel, progress=progress, **surface.limits)


def _simulated(scene: str, frames: int | None) -> Scans:
    from radarsdf import simulate
    from radarsdf.io import Scans

    found = simulate.SCENES[scene](frames=frames)
    return Scans(found.points, found.poses, found.intensities, found.ground_truth, truth_kind="simulated")


def _add_surface_errors(results: Results, mesh: trimesh.Trimesh, scans: Scans) -> None:
    from radarsdf.evaluation import format_metrics, surface_metrics

    results.add_threshold(mesh.metadata)
    assert scans.ground_truth is not None
    metrics = surface_metrics(mesh, scans.ground_truth, samples=1_000_000)
    near = f"within {metrics['threshold_m']:g} m"
    results.add(
        f"{metrics['precision']:.1%} of the mesh lies {near} of the true surface, and "
        f"{metrics['completion_ratio']:.1%} of that surface {near} of the mesh:"
    )
    results.add(format_metrics(metrics), surface=metrics)


def _ends_with_viewer(wanted: bool | None, json: bool) -> bool:
    """Whether the viewer ends the demo. It waits for Ctrl-C, so only if it was asked for, or somebody can see it."""
    from radarsdf.view.serving import has_display, require_viser

    if wanted:
        require_viser()
    if wanted is not None:
        return wanted
    in_terminal = sys.stdout is not None and sys.stdout.isatty() and not json
    return in_terminal and has_display() and find_spec("viser") is not None
