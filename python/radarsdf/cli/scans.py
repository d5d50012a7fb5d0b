"""Commands on scans before a fit: ``check``, ``poses``, ``calibrate``, ``locate``, ``join`` and ``convert``."""

import math
from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import radarsdf
from radarsdf.arrays import Floats
from radarsdf.checking.check import check_cheaply
from radarsdf.checks import check as check_that
from radarsdf.cli import Results, as_json, warn
from radarsdf.cli.inputs import check_picture, inputs_of, load_map, read_scans, scans_if, scans_or_unposed
from radarsdf.cli.options import refuse_if
from radarsdf.cli.settings import load_config
from radarsdf.io.clouds import CLOUD_OUT_SUFFIXES, CLOUD_SUFFIXES, write_cloud
from radarsdf.io.files import check_outputs, checked_suffix, write_whole
from radarsdf.io.meshes import MESH_SUFFIXES, holds_mesh, read_mesh, write_mesh
from radarsdf.io.npz import write_scans
from radarsdf.io.poses import POSE_SUFFIXES, UNPOSED, NoPoses, check_pose_times, write_poses
from radarsdf.io.read import read
from radarsdf.map.map import Map
from radarsdf.poses.odometry import PosedScans
from radarsdf.poses.rigid import transform
from radarsdf.render.figures import save_trajectory_picture
from radarsdf.scans import Scans


def check(given: Namespace, results: Results) -> int:
    findings = radarsdf.check(read_scans(given), config=load_config(given))
    for finding in findings:
        results.add(str(finding))
    results.add(findings=[vars(finding) for finding in findings])
    return int(any(finding.severity == "error" for finding in findings))


def warn_or_refuse(scans: Scans) -> None:
    """Print warnings of the cheap checks before a fit. Raises a ValueError if a map of the scans would be nonsense."""
    for finding in check_cheaply(scans.points, scans.sensor_poses, scans.intensities):
        what = f"{finding.name}: {finding.evidence} {finding.fix} --no-check fits the scans as they are"
        check_that(finding.severity != "error", what)
        if finding.severity == "warning":
            warn(str(finding))


def poses(given: Namespace, results: Results) -> None:
    out, picture = given.out, given.picture
    refuse_if(given.find and given.poses, f"--find does not use poses: leave out {given.poses}")
    check_poses_out(given, picture)
    check_picture(picture)
    config = load_config(given)
    scans, unposed = scans_or_unposed(given, find=given.find)
    check_pose_times(out, scans.times_s)
    scans, posed = posed_scans(scans, unposed, config, results, refine=True)
    write_posed(out, scans, results, f"there are {posed.segments} segments" if posed.segments > 1 else "")
    if picture is not None:
        given_poses = {} if posed.given is None else {"given": posed.given}
        drawn = given_poses | {"refined" if given_poses else "found": scans.poses}
        if scans.rig is not None:
            drawn = {name: scans.rig.sensor_poses(poses) for name, poses in drawn.items()}
        save_trajectory_picture(picture, scans.points, drawn)
        results.add_file("picture", picture, "picture")


def check_poses_out(given: Namespace, *others: Path | None) -> None:
    """Check, before anything is read, that :func:`write_posed` and the `others` can write."""
    if given.out.suffix.lower() != ".npz":
        checked_suffix(given.out, POSE_SUFFIXES, "poses to write")
    check_outputs([given.out, *others], inputs_of(given))


def write_posed(out: Path, scans: Scans, results: Results, incomplete: str) -> None:
    """Write scans, or only their poses. `incomplete`: why some scans of the input are missing, or ``""``."""
    suffix = out.suffix.lower()
    if suffix == ".npz":
        write_scans(out, scans)
    else:
        what = f"{incomplete}, but {out} cannot tell which scans have poses: write .tum or .npz"
        check_that(not incomplete or suffix == ".tum", what)
        write_poses(out, scans.poses, scans.times_s)
    results.add_file(f"{len(scans)} poses", out)


def posed_scans(
    scans: Scans, unposed: bool, config: radarsdf.FitConfig, results: Results, *, refine: bool
) -> tuple[Scans, PosedScans]:
    """Estimate the poses of `unposed` scans, or `refine` those of others. Of several segments, return the scans of the longest one."""
    if unposed:
        found = radarsdf.odometry(scans, config=config)
        results.add(found.report["verdict"], poses=found.report)
        posed, scans = PosedScans.of(found), scans.with_poses(found.poses, other_world=True)
        for note in posed.notes:
            warn(f"note: {note}")
        if posed.segments > 1:
            rows = posed.rows
            results.add(f"the scans {rows.start} to {rows.stop - 1} are used, the longest segment")
            scans = scans.select(range(len(scans))[rows])
        return scans, posed
    if not refine:
        return scans, PosedScans(scans.poses, slice(0, len(scans.poses)), scans.poses)
    refined = radarsdf.refine_poses(scans, config=config)
    report = refined.report
    results.add(report["verdict"], poses=report, improved=refined.improved)
    if refined.improved:
        moved_deg, sigma_deg = math.degrees(report["moved_rad"]), math.degrees(report["sigma_rad"])
        moved = f"{report['moved_m']:.3f} m and {moved_deg:.2f} degrees (RMS)"
        error = f"{report['sigma_m']:.3f} m and {sigma_deg:.2f} degrees"
        results.add(f"they moved by {moved}; the input's step error is {error}")
    return scans.with_poses(refined.poses), PosedScans.of(refined, scans.poses)


def calibrate(given: Namespace, results: Results) -> None:
    checked_suffix(given.out, (".json",), "mountings to write")
    check_outputs([given.out], inputs_of(given))
    found = radarsdf.calibrate(scans_or_unposed(given)[0], config=load_config(given))
    for note in found.notes:
        warn(f"note: {note}")
    results.add(f"mountings relative to {found.against}; deviations in brackets", against=found.against)
    of_imu = {} if found.imu is None else {"IMU": found.imu}
    mountings = {str(label): mounting for label, mounting in found.mountings.items()} | of_imu
    rows = [["radar", "x, y, z, m", "yaw, pitch, roll, degrees", "time offset, ms"]]
    for label, one in mountings.items():
        sigmas = np.sqrt(one.covariance.diagonal())
        R = one.T_body_sensor[:3, :3]
        angles = np.full(3, np.nan)
        if np.isfinite(R).all():
            angles = Rotation.from_matrix(R).as_euler("ZYX", degrees=True)
        cells = [_with_deviations(one.T_body_sensor[:3, 3], sigmas[:3], 3)]
        cells += [_with_deviations(angles, np.degrees(sigmas[:2:-1]), 2)]
        cells += [_with_deviations([1e3 * one.time_offset_s], [1e3 * one.time_offset_sigma_s], 1)]
        rows.append([label, *cells])
    results.table(rows)
    for label, one in mountings.items():
        for why in one.unobserved:
            results.add(f"{label}: not observed: {why}")
    values = {label: vars(one) for label, one in mountings.items()}
    results.add(mountings=values)
    if given.out is not None:
        write_whole(given.out, f"{as_json(values)}\n".encode())
        results.add_file(f"{len(values)} mountings", given.out)


def _with_deviations(values: Iterable[float], sigmas: Iterable[float], digits: int) -> str:
    pairs = zip(values, sigmas, strict=True)
    return " ".join(f"{value:.{digits}f} ({sigma:.{digits}f})" for value, sigma in pairs)


def convert(given: Namespace, results: Results) -> None:
    out, folder = given.out, given.scans.resolve()
    check_outputs([out], inputs_of(given))
    if given.poses is None and holds_mesh(given.scans):
        checked_suffix(out, MESH_SUFFIXES, "meshes")
        scans_if(False, given)
        mesh = read_mesh(given.scans)
        write_mesh(out, mesh)
        results.add_file(f"{len(mesh.faces)} triangles", out, triangles=len(mesh.faces))
        return
    suffix = out.suffix.lower()
    if suffix != ".npz":
        checked_suffix(out, CLOUD_OUT_SUFFIXES, "point clouds to write")
    among = suffix in CLOUD_SUFFIXES and folder.is_dir() and folder in out.resolve().parents
    check_that(not among, f"{out} would be read as one of the scans in its folder: write it elsewhere")
    add_scans(results, out, read_scans(given))


def add_scans(results: Results, out: Path, scans: Scans) -> None:
    """Write scans or their returns by the suffix, unless that of a picture, and print how many."""
    suffix = out.suffix.lower()
    if suffix == ".npz":
        write_scans(out, scans)
    # Clouds are written in one pass, without all scans in memory.
    is_cloud = suffix in CLOUD_OUT_SUFFIXES
    returns = write_cloud(out, scans) if is_cloud else sum(map(len, scans.points))
    results.add_file(f"{returns} returns of {len(scans)} scans", out, returns=returns, scans=len(scans))


def locate(given: Namespace, results: Results) -> None:
    out = given.out
    check_poses_out(given)
    guess = None
    if given.guess is not None:
        *position, yaw_deg = given.guess
        guess = transform(np.array([0.0, 0.0, np.radians(yaw_deg)]), np.array(position))
    scans = unposed_scans(given)
    check_pose_times(out, scans.times_s)
    placed, _ = located(load_map(given.map), scans, results, guess)
    lost = len(scans) - len(placed)
    write_posed(out, placed, results, f"{lost} scans are lost" if lost else "")


def unposed_scans(given: Namespace) -> Scans:
    refuse_if(given.poses, f"scans that are localised need no poses: leave out {given.poses}")
    return read_scans(given, UNPOSED)


def located(
    radar_map: Map, scans: Scans, results: Results, guess: Floats | None = None
) -> tuple[Scans, Floats]:
    """Return the scans that are found in the map, with their poses there, and their explained shares, and print which."""
    found = radarsdf.locate(radar_map, scans, guess=guess)
    report = found.report
    for note in report["notes"]:
        warn(f"note: {note}")
    results.add(report["verdict"], **report, explained=found.explained, segments=found.segments)
    for why in report["lost"]:
        results.add(f"lost: {why}")
    placed = scans.with_poses(np.nan_to_num(found.poses), other_world=True)
    kept = np.flatnonzero(found.segments >= 0)
    return placed.select(kept), found.explained[kept]


def join(given: Namespace, results: Results) -> None:
    folder, paths = given.out, given.sessions
    refuse_if(len(paths) < 2, "join takes at least two sessions")
    names = [f"{path.resolve().stem}.npz" for path in paths]
    differ = len(set(names)) == len(names)
    check_that(differ, f"the sessions must have different names, not {', '.join(names)}")
    folder.mkdir(exist_ok=True)
    check_outputs([folder / name for name in names], paths)
    sessions = []
    for path in paths:
        try:
            sessions.append(read(path))
        except NoPoses:
            scans = read(path, UNPOSED)
            sessions.append(scans.with_poses(np.full((len(scans), 4, 4), np.nan), other_world=True))
    found = radarsdf.join(sessions, config=load_config(given))
    results.add(found.report["verdict"], joined=[names[i] for i in found.report["joined"]])
    rows = [["session", "session", "verdict"]]
    rows += [[names[i], names[k], verdict] for (i, k), verdict in found.verdicts.items()]
    results.table(rows)
    results.add(pairs=rows[1:])
    for i in found.report["joined"]:
        known = np.isfinite(found.poses[i]).all(axis=(1, 2))
        posed = sessions[i].with_poses(np.nan_to_num(found.poses[i]), other_world=True)
        write_scans(folder / names[i], posed.select(np.flatnonzero(known)))
        results.add_file(f"{known.sum()} scans", folder / names[i])
