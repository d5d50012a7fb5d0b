"""``radarsdf fit`` and ``demo``: from scans to a map."""

import shlex
import sys
from argparse import Namespace
from collections.abc import Callable
from importlib.util import find_spec

import radarsdf
from radarsdf.cli import Results, maps
from radarsdf.cli.inputs import MAP_SUFFIX, inputs_of, scans_or_unposed, split, without_intensities
from radarsdf.cli.options import LIMITS, Parser, refuse_if
from radarsdf.cli.scans import posed_scans, warn_or_refuse
from radarsdf.cli.settings import load_config
from radarsdf.io import Scans, write_scans
from radarsdf.io.files import check_outputs
from radarsdf.report.writing import Subject, require_extras
from radarsdf.view import serving

# Options of the demo that are passed on to its commands.
_SHARED = ("paper", "quick", "config", "set", "voxel", *LIMITS)


def fit(given: Namespace, results: Results) -> None:
    out, report = given.out, given.report
    not_exactly_one = (out is None) != given.dry_run
    refuse_if(not_exactly_one, "-o MAP writes the map, --dry-run only estimates: give exactly one of them")
    refuse_if(out and out.suffix != MAP_SUFFIX, f"{out}: a map is written as {MAP_SUFFIX}")
    refuse_if(given.dry_run and report, f"--dry-run makes no map: leave out --report {report}")
    if report is not None:
        require_extras()
    config = load_config(given)
    check_outputs([out, given.checkpoint, report], inputs_of(given))
    every_scan, posed = posed_scans(*scans_or_unposed(given), config, results, refine=given.refine)
    config = posed.config(config)
    scans, held_out = split(every_scan, given.holdout)
    used = without_intensities(scans) if given.geometry_only else scans
    if out is None:
        expected = radarsdf.estimate(used.points, used.sensor_poses, used.intensities, config=config)
        results.add(str(expected), **vars(expected))
        return
    if not given.no_check:
        warn_or_refuse(used)
    try:
        radar_map = radarsdf.fit(used, config=config, progress=results.progress, checkpoint=given.checkpoint)
    except radarsdf.Interrupted as stop:
        if stop.radar_map is not None:
            stop.radar_map.save(out)
            stop.args = (f"{stop}; the map so far is in {out}",)
        raise
    if posed.trajectory is not None:
        radar_map.report["poses"] = posed.trajectory
    radar_map.save(out)
    if given.checkpoint is not None:
        given.checkpoint.unlink(missing_ok=True)
    _add_fit(results, radar_map)
    results.add_file("map", out)
    words = ["radarsdf", "mesh", str(out), "-o", str(out.with_suffix(".ply"))]
    results.add(f"next: {shlex.join(words)}{' --voxel 0.2' * given.quick}")
    if report is not None:
        findings = radarsdf.check(every_scan, config=radar_map.config)
        subject = Subject(radar_map, out.name, scans, held_out, findings, progress=results.progress)
        maps.add_report(results, report, subject)


def _add_fit(results: Results, radar_map: radarsdf.RadarMap) -> None:
    report = radar_map.report
    names = ("scans", "returns", "returns_used", "moving", "ghosts", "intensity_outliers", "leaf_cells")
    scans, returns, used, moving, ghosts, outliers, _ = (report[name] for name in names)
    invalid = returns - used - moving - ghosts
    left_out = {"move according to their Doppler": moving, "are ghosts": ghosts}
    left_out["are invalid or out of range"] = invalid
    line = f"{used} of {returns} returns in {scans} scans form the surface"
    line += "".join(f", {count} {why}" for why, count in left_out.items() if count)
    results.add(line, **{name: report[name] for name in names})
    if outliers:
        results.add(f"{outliers} intensities are outliers, left out of the reflectance")
    noise, losses = report["noise"], report["losses"]
    seconds = sum(value for name, value in report.items() if name.endswith("_s") and name != "skipped_s")
    loss = "".join(f", {stage} loss {value:.3g}" for stage, value in losses.items())
    results.add(f"fit {seconds:.1f} s: {radar_map}{loss}", seconds=seconds, losses=losses)
    angles = ", ".join(f"{axis} {noise[f'{axis}_rad']:.4f} rad" for axis in ("azimuth", "elevation"))
    described = f"noise: range {noise['range_m']:.3f} m, {angles}"
    results.add(described, noise=noise, map_bytes=radar_map.file_bytes)


def demo(given: Namespace, results: Results) -> None:
    frames, out, view = given.frames, given.out, given.view
    refuse_if(frames is not None and frames < 2, f"--frames must be at least 2, not {frames}")
    if view is None:  # only if somebody can see it and stop it with Ctrl-C
        in_terminal = sys.stdout is not None and sys.stdout.isatty() and not results.json
        view = in_terminal and serving.has_display() and find_spec("viser") is not None
    elif view:
        serving.page_port(serving.LOCALHOST, None)
    drive = radarsdf.simulate.SCENES[given.scene](frames=frames)
    out.mkdir(parents=True, exist_ok=True)
    scans_file, map_file = str(out / "scans.npz"), str(out / "map.safetensors")
    write_scans(scans_file, Scans(drive.points, drive.poses, drive.intensities, drive.ground_truth))
    results.add(f"simulated a drive of {len(drive.points)} scans, {given.scene}: {scans_file}")

    def run(function: Callable[[Namespace, Results], None], command: str, *words: str) -> None:
        results.add(f"$ radarsdf {command} {shlex.join(words)}")
        parsed = vars(Parser(command).parse_args(words))
        shared = {name: vars(given)[name] for name in _SHARED if name in parsed}
        function(Namespace(**parsed | shared), results)

    picture = ["--picture", str(out / "picture.png")] if find_spec("matplotlib") else []
    viewpoint = [f"{x:.1f}" for x in drive.poses[len(drive.poses) // 2, :3, 3]]
    run(fit, "fit", scans_file, "-o", map_file, "--holdout", "10")
    run(maps.mesh, "mesh", map_file, "-o", str(out / "mesh.ply"), "--viewpoint", *viewpoint, *picture)
    run(maps.evaluate, "eval", map_file, scans_file, "--holdout", "10", "--samples", "1000000")
    if view:
        results.end()
        run(maps.view, "view", map_file, scans_file, "--open")
    else:
        results.add(f"next: {shlex.join(['radarsdf', 'view', map_file, scans_file])}")
