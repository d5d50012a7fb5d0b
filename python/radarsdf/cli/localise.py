"""``radarsdf locate`` and ``join``: scans in a map made before, and sessions in one frame."""

from __future__ import annotations

from argparse import Namespace

import numpy as np

import radarsdf
from radarsdf.arrays import Floats
from radarsdf.checks import check
from radarsdf.cli.inputs import load_map, read_scans
from radarsdf.cli.options import refuse_if
from radarsdf.cli.results import Results, warn
from radarsdf.cli.scans import check_poses_out, write_posed
from radarsdf.cli.settings import load_config
from radarsdf.io.files import check_outputs
from radarsdf.io.npz import write_scans
from radarsdf.io.poses import UNPOSED, NoPoses, check_pose_times
from radarsdf.io.read import read
from radarsdf.map.map import Map
from radarsdf.poses.rigid import transform
from radarsdf.scans import Scans


def locate(given: Namespace, results: Results) -> None:
    """Localise the scans in the map, print what was found, and write the poses of the scans that were."""
    out = given.out
    check_poses_out(given)
    guess = None
    if given.guess is not None:
        *position, yaw_deg = given.guess
        guess = transform(np.array([0.0, 0.0, np.radians(yaw_deg)]), np.array(position))
    scans = unposed_scans(given)
    check_pose_times(out, scans.times_s)
    placed = located(load_map(given.map), scans, results, guess)
    lost = len(scans) - len(placed)
    write_posed(out, placed, results, f"{lost} scans are lost" if lost else "")


def unposed_scans(given: Namespace) -> Scans:
    """Read scans that are to be localised."""
    refuse_if(given.poses, f"scans that are localised need no poses: leave out {given.poses}")
    return read_scans(given, UNPOSED)


def located(radar_map: Map, scans: Scans, results: Results, guess: Floats | None = None) -> Scans:
    """Return the scans that are found in the map, with their poses there, and print which."""
    found = radarsdf.locate(radar_map, scans, guess=guess)
    report = found.report
    for note in report["notes"]:
        warn(f"note: {note}")
    results.add(report["verdict"], **report, explained=found.explained, segments=found.segments)
    for why in report["lost"]:
        results.add(f"lost: {why}")
    placed = scans.with_poses(np.nan_to_num(found.poses), other_world=True)
    return placed.select(np.flatnonzero(found.segments >= 0))


def join(given: Namespace, results: Results) -> None:
    """Find the poses of the sessions in one frame, and write those that belong together."""
    folder, paths = given.out, given.sessions
    refuse_if(len(paths) < 2, "join takes at least two sessions")
    names = [f"{path.resolve().stem}.npz" for path in paths]
    check(len(set(names)) == len(names), f"the sessions must have different names, not {', '.join(names)}")
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
