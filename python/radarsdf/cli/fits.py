# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf fit``, ``live``, ``demo`` and ``config``: from scans to a map."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from radarsdf.cli.app import command, refuse_if, warn
from radarsdf.cli.options import MAP_SUFFIX, Address, Recording, Settings, Surface, words_of
from radarsdf.cli.pages import add_report, show
from radarsdf.cli.results import Results, add_intensity_errors, counted, save_map, split, until_stopped
from radarsdf.cli.scans import scans_and_poses, scans_or_unposed, warn_or_refuse

if TYPE_CHECKING:
    import trimesh

    from radarsdf import LiveMap, RadarMap
    from radarsdf.io.scans import Scans
    from radarsdf.live.replay import Replay
    from radarsdf.view.pages import GrowingView

_SHOWN_EVERY_S = 0.5


@command()
def config(settings: Settings) -> None:
    """Print the configuration as TOML."""
    from radarsdf.config.toml import to_toml

    typer.echo(to_toml(settings.load()), nl=False)


@command()
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
    quiet: bool = False,
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
            progress=False if quiet else None,
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
        evaluated = shlex.join(
            ["radarsdf", "eval", str(out), *words_of(recording), "--holdout", str(holdout)]
        )
        results.add(f"and: {evaluated}", evaluate=evaluated)
    if report is not None:
        findings = check(every_scan, config=radar_map.config)
        subject = Subject(radar_map, out.name, scans, held_out, findings, progress=False if quiet else None)
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
    """Add what the fit used, what it left out, and what it found."""
    report = radar_map.report
    returns, used, movers, ghosts = (report[name] for name in ("returns", "returns_used", "movers", "ghosts"))
    left_out = {"move by their Doppler": movers, "are ghosts": ghosts}
    left_out["are out of range"] = returns - used - movers - ghosts
    results.add(
        f"{used} of {returns} returns in {counted(scans, 'scan')} make the surface"
        + "".join(f", {count} {why}" for why, count in left_out.items() if count),
        scans=scans,
        **{name: report[name] for name in ("returns", "returns_used", "movers", "ghosts")},
    )
    if outliers := report["wild_intensities"]:
        results.add(
            f"{outliers} intensities are outliers, and are left out of the reflectance: radarsdf check names them",
            wild_intensities=outliers,
        )
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


@command()
def live(
    recording: Recording,
    *,
    out: Path | None = None,
    trajectory: Path | None = None,
    rate: float = 1.0,
    find: bool = False,
    view: bool = False,
    address: Address,
    settings: Settings,
    quiet: bool = False,
    results: Results,
) -> None:
    """Replay the scans, report how the map kept up, and write it.

    out: The map to write in the end, .safetensors.
    trajectory: Also write where the scans were placed: .tum, .kitti or .npy.
    rate: Multiplies the recorded speed, which is 0.1 s a scan without times; 0: as fast as possible.
    find: Do not use the poses of the scans: track each scan on the last ones.
    view: Show the map in the browser while it grows.
    """
    import numpy as np

    from radarsdf.checks import not_negative
    from radarsdf.io.files import check_outputs
    from radarsdf.io.poses.files import check_pose_suffix, check_pose_times, write_poses
    from radarsdf.live.live_map import LiveMap
    from radarsdf.live.replay import replay

    config, rate = settings.load(), not_negative(rate, "--rate")
    if trajectory is not None:
        check_pose_suffix(trajectory)
    check_outputs([out, trajectory], recording.inputs)
    if view:
        address.check()
    scans, missing = scans_or_unposed(recording, find=find)
    with_poses = missing is None and not find
    if not with_poses and scans.times_s is None:
        msg = f"{recording.scans}: scans without poses need times: when each was taken"
        raise ValueError(msg)
    if trajectory is not None:
        check_pose_times(trajectory, scans.times_s)
    growing = LiveMap(config)
    with contextlib.ExitStack() as stack:
        shown = None
        if view:
            from radarsdf.view.pages import GrowingView

            shown = _Shown(growing, stack.enter_context(GrowingView(host=address.host, port=address.port)))
            stack.callback(shown.stop)
        on_scan = None if shown is None else shown.on_scan
        done = replay(growing, scans, with_poses=with_poses, rate=rate, on_scan=on_scan)
        _add_rates(results, done, len(scans))
        if out is not None:
            save_map(
                growing.map() if settings.quick else growing.finish(progress=False if quiet else None), out
            )
            results.add(f"map {out}", out=out)
        if trajectory is not None:
            times_s = None if scans.times_s is None else scans.times_s[done.rows]
            write_poses(trajectory, np.stack(done.poses), times_s)
            results.add(f"trajectory {trajectory}", trajectory=trajectory)
        if shown is not None:
            results.end()
            until_stopped(shown.view)


def _add_rates(results: Results, done: Replay, scans: int) -> None:
    import numpy as np

    if not done.rows:
        msg = "no scan came into the map"
        raise ValueError(msg)
    p50, p99, worst = np.percentile(done.seconds, [50, 99, 100])
    results.add(
        f"{len(done.rows)} of {counted(scans, 'scan')} in the map, {len(done.dropped)} dropped, {len(done.lost)} lost",
        scans=len(done.rows),
        dropped=len(done.dropped),
        lost=len(done.lost),
    )
    results.add(
        f"a scan took {1e3 * p50:.1f} ms (median), {1e3 * p99:.1f} ms (99 of 100), {1e3 * worst:.1f} ms (worst): "
        f"{done.hertz:.0f} scans a second",
        p50_s=p50,
        p99_s=p99,
        worst_s=worst,
        scans_per_second=done.hertz,
    )


class _Shown:
    """A thread that shows the newest surface from time to time."""

    def __init__(self, live_map: LiveMap, view: GrowingView) -> None:
        from radarsdf.view.serving import url_of

        self._live_map, self.view = live_map, view
        self._path: Any = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        typer.echo(f"the map grows on {url_of(view.host, view.port)}; Ctrl-C ends it")

    def on_scan(self, done: Replay) -> None:
        self._path = [pose[:3, 3] for pose in done.poses]

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        import numpy as np

        while not self._ended.wait(_SHOWN_EVERY_S):
            path, self._path = self._path, None
            if path is not None:
                self.view.show(self._live_map.mesh(), np.array(path))


@command()
def demo(
    *,
    scene: Literal["hugin", "oculii", "wall", "astyx"] = "hugin",
    frames: int | None = None,
    out: Path = Path("radarsdf_demo"),
    view: bool | None = None,
    surface: Surface,
    settings: Settings,
    quiet: bool = False,
    results: Results,
) -> None:
    """Simulate, fit, mesh, evaluate, write.

    scene: The radar and the place.
    frames: Number of scans; default: depends on the scene.
    out: The folder to write.
    view: Show the map in the browser at the end, until Ctrl-C; default: in a terminal of a machine with a screen.
    """
    refuse_if(
        frames is not None and frames < 2, f"--frames must be at least 2, one to be held out, not {frames}"
    )

    import radarsdf.map.mesh  # here and not by the first mesh: the printed times are without imports
    from radarsdf.evaluation import holdout
    from radarsdf.io import Scans, write_scans
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import write_mesh
    from radarsdf.render.picture import save_picture

    config, progress = settings.load(), False if quiet else None
    shown = _ends_with_viewer(view, results.json)
    out.mkdir(parents=True, exist_ok=True)
    files = [out / name for name in ("scans.npz", "map.safetensors", "mesh.ply", "picture.png")]
    check_outputs(files)
    scans_file, map_file, mesh_file, picture_file = files
    results.add(
        f"simulates the drive of a radar, makes a map of it, compares that with the truth, and writes all to {out}"
    )
    simulation = radarsdf.simulate.SCENES[scene](frames=frames)
    scans = Scans(
        simulation.points,
        simulation.poses,
        simulation.intensities,
        simulation.ground_truth,
        truth_kind="simulated",
    )
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
    if shown:
        results.end()
        show(radar_map, scans, open_page=True, voxel_size=surface.voxel, progress=progress, **surface.limits)


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
    """Whether the viewer ends the demo. It waits for Ctrl-C, so only if it was asked for, or somebody is there."""
    from radarsdf.view.serving import has_display, require_viser

    somebody = sys.stdout is not None and sys.stdout.isatty() and has_display() and not json
    if not (somebody if wanted is None else wanted):
        return False
    try:
        require_viser()
    except ImportError:  # it is optional
        if wanted:
            raise
        return False
    return True
