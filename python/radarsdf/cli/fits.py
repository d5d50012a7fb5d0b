# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf fit`` and ``demo``: from scans to a map."""

from __future__ import annotations

import shlex
import sys
from argparse import Namespace

import radarsdf
from radarsdf import Interrupted, RadarMap
from radarsdf.cli.app import refuse_if, warn
from radarsdf.cli.inputs import MAP_SUFFIX, inputs_of, mesh_limits, split
from radarsdf.cli.maps import add_intensity_errors
from radarsdf.cli.pages import add_report, show
from radarsdf.cli.results import Results, save_map
from radarsdf.cli.scans import posed_scans, warn_or_refuse
from radarsdf.cli.settings import load_config
from radarsdf.evaluation import format_metrics, holdout, surface_metrics
from radarsdf.io import Scans, write_mesh, write_scans
from radarsdf.io.files import check_outputs
from radarsdf.map.threshold import Threshold
from radarsdf.render import picture
from radarsdf.report.page import require_extras
from radarsdf.report.subject import Subject
from radarsdf.view import serving


def fit(given: Namespace, results: Results) -> None:
    """Fit a map, or estimate what the fit takes."""
    out, report = given.out, given.report
    neither = (out is None) != given.dry_run
    refuse_if(neither, "-o MAP writes the map, --dry-run only estimates: give one of them")
    refuse_if(out and out.suffix != MAP_SUFFIX, f"{out}: a map is written as {MAP_SUFFIX}")
    refuse_if(given.dry_run and report, f"--dry-run makes no map: leave out --report {report}")
    if report is not None:
        require_extras()
    config = load_config(given)
    check_outputs([out, given.checkpoint, report], inputs_of(given))
    every_scan, posed = posed_scans(given, config, results, refine=given.refine)
    config = posed.config(config)
    scans, held_out = split(every_scan, given.holdout)
    intensities = None if given.geometry_only else scans.intensities
    if out is None:
        expected = radarsdf.estimate(scans.points, scans.poses, intensities, config=config)
        results.add(str(expected), **vars(expected))
        return
    if not given.no_check:
        warn_or_refuse(scans, intensities)
    try:
        radar_map = radarsdf.fit(
            scans.points,
            scans.poses,
            intensities,
            doppler_mps=scans.doppler_mps,
            config=config,
            progress=results.progress,
            checkpoint=given.checkpoint,
        )
    except Interrupted as stop:
        if stop.radar_map is not None:
            save_map(stop.radar_map, out)
            stop.args = (f"{stop}; the map so far is in {out}",)
        raise
    if posed.way is not None:
        radar_map.report["poses"] = posed.way
    save_map(radar_map, out)
    if given.checkpoint is not None:
        given.checkpoint.unlink(missing_ok=True)
    _add_fit(results, radar_map)
    results.add(f"written to {out}", out=out)
    words = ["radarsdf", "mesh", str(out), "-o", str(out.with_suffix(".ply"))]
    results.add(f"next: {shlex.join(words)}{' --voxel 0.2' * given.quick}")
    if report is not None:
        findings = radarsdf.check(every_scan, config=radar_map.config)
        subject = Subject(radar_map, out.name, scans, held_out, findings, progress=results.progress)
        add_report(results, report, subject)


def _add_fit(results: Results, radar_map: RadarMap) -> None:
    """Add the counts of returns, the losses and the estimated noise of a fit."""
    report = radar_map.report
    names = ("scans", "returns", "returns_used", "movers", "ghosts", "wild_intensities", "leaf_cells")
    scans, returns, used, moving, ghosts, outliers, _ = counts = [report[name] for name in names]
    left_out = {
        "move by their Doppler": moving,
        "are ghosts": ghosts,
        "are out of range": returns - used - moving - ghosts,
    }
    line = f"{used} of {returns} returns in {scans} scans make the surface"
    line += "".join(f", {count} {why}" for why, count in left_out.items() if count)
    results.add(line, **dict(zip(names, counts, strict=True)))
    if outliers:
        results.add(f"{outliers} intensities are outliers, and are left out of the reflectance")
    noise, losses = report["noise"], report["losses"]
    seconds = sum(value for name, value in report.items() if name.endswith("_s") and name != "skipped_s")
    loss = "".join(f", {stage} loss {value:.3g}" for stage, value in losses.items())
    results.add(f"fit {seconds:.1f} s: {radar_map}{loss}", seconds=seconds, losses=losses)
    results.add(
        f"noise {noise['range_m']:.3f} m, azimuth {noise['azimuth_rad']:.4f} rad, "
        f"elevation {noise['elevation_rad']:.4f} rad",
        noise=noise,
        map_bytes=radar_map.file_bytes,
    )


def demo(given: Namespace, results: Results) -> None:
    """Simulate, fit, mesh, evaluate, write."""
    frames, out, view = given.frames, given.out, given.view
    refuse_if(frames is not None and frames < 2, f"--frames must be at least 2, not {frames}")
    if view is None:  # only where somebody can see it, and end it by Ctrl-C
        in_terminal = sys.stdout is not None and sys.stdout.isatty() and not results.json
        view = in_terminal and serving.has_display() and serving.has_viser()
    elif view:
        serving.require_viser()
    config, progress, limits = load_config(given), results.progress, mesh_limits(given)
    out.mkdir(parents=True, exist_ok=True)
    files = [out / name for name in ("scans.npz", "map.safetensors", "mesh.ply", "picture.png")]
    check_outputs(files)
    scans_file, map_file, mesh_file, picture_file = files

    drive = radarsdf.simulate.SCENES[given.scene](frames=frames)
    scans = Scans(drive.points, drive.poses, drive.intensities, drive.ground_truth, truth_kind="simulated")
    train, test = (scans.select(rows) for rows in holdout(len(scans.points)))
    results.add(f"simulated a drive, {given.scene}: {len(train)} scans to fit, {len(test)} held out")
    radar_map = radarsdf.fit(train.points, train.poses, train.intensities, config=config, progress=progress)
    save_map(radar_map, map_file)  # first: the rest can be had from the map
    _add_fit(results, radar_map)
    viewpoint = scans.poses[len(scans.poses) // 2, :3, 3]
    mesh = radar_map.mesh(given.voxel, viewpoint=viewpoint, **limits, progress=progress)
    results.add_threshold(Threshold.of_mesh(mesh.metadata))
    metrics = surface_metrics(mesh, drive.ground_truth, samples=1_000_000)
    results.add(format_metrics(metrics), surface=metrics)
    add_intensity_errors(results, radar_map, test, train)

    write_scans(scans_file, scans)
    write_mesh(mesh_file, mesh)
    try:
        picture.save_picture(picture_file, mesh, scalar=mesh.vertex_attributes["intensity"])
    except ImportError as error:  # Matplotlib is optional
        files.remove(picture_file)
        warn(f"warning: no picture: {error}")
    results.add("wrote " + ", ".join(map(str, files)), files=files)
    results.add(f"next: {shlex.join(['radarsdf', 'view', str(map_file), str(scans_file)])}")
    if view:
        results.end()
        show(radar_map, scans, open_page=True, voxel_size=given.voxel, progress=progress, **limits)
