# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf check``, ``poses`` and ``convert``: scans before a fit."""

from __future__ import annotations

import dataclasses
import math
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from radarsdf.cli.app import refuse_if, warn
from radarsdf.cli.options import MAP_SUFFIX, Recording, Settings, words_of
from radarsdf.cli.results import Results, counted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from radarsdf import FitConfig
    from radarsdf.io.poses import NoPoses
    from radarsdf.io.scans import Scans
    from radarsdf.poses.posed import Posed


def check(recording: Recording, settings: Settings, results: Results) -> int:
    """Print the findings, the worst first, and the command to run next. The status is 1 if one is an error."""
    from radarsdf import check

    findings = check(recording.read(), config=settings.load())
    failed = any(finding.severity == "error" for finding in findings)
    # Here and not next to the data, which may be on a disk that nobody should write to.
    target = Path(os.path.abspath(recording.scans)).stem + MAP_SUFFIX  # noqa: PTH100 - links keep their names
    words = words_of(recording, settings)
    following = shlex.join(
        ["radarsdf", "check", *words] if failed else ["radarsdf", "fit", *words, "-o", target]
    )
    results.add(findings=[dataclasses.asdict(finding) for finding in findings], next=following)
    for finding in findings:
        results.add(str(finding))
    results.add(f"next: {'fix the errors, then ' if failed else ''}{following}")
    return int(failed)


def warn_or_refuse(scans: Scans, intensities: list[NDArray[Any]] | None) -> None:
    """Print the warnings of the cheap checks before a fit. Raises a ValueError if a map of the scans would be nonsense."""
    from radarsdf.checking.check import check_cheaply

    for finding in check_cheaply(scans.points, scans.poses, intensities):
        if finding.severity == "error":
            msg = f"{finding.name}: {finding.evidence} {finding.mend} --no-check fits the scans as they are"
            raise ValueError(msg)
        if finding.severity == "warning":
            warn(str(finding))


def poses(
    recording: Recording,
    *,
    out: Path,
    find: bool = False,
    picture: Path | None = None,
    settings: Settings,
    results: Results,
) -> None:
    """Refine the poses of the scans, or find them, and write them.

    out: The poses to write: .tum (with times), .kitti or .npy; or .npz: the scans with these poses.
    find: Do not use the poses of the scans: find them from returns and Doppler.
    picture: Also draw the trajectory from above, before and after, as .png.
    """
    from radarsdf.extras import require
    from radarsdf.io.files import check_outputs
    from radarsdf.io.npz import write_scans
    from radarsdf.io.poses import check_pose_suffix, write_poses

    refuse_if(find and recording.poses, f"--find does not use poses: leave out {recording.poses}")
    config = settings.load()
    as_scans = out.suffix.lower() == ".npz"
    if not as_scans:
        check_pose_suffix(out)
    check_outputs([out, picture], recording.inputs)
    if picture is not None:
        require("matplotlib", what="pictures need")
    scans, posed = scans_and_poses(recording, config, results, refine=True, find=find, needs_times=out)
    if as_scans:
        write_scans(out, scans)
    elif posed.pieces > 1 and out.suffix.lower() != ".tum":
        msg = f"there are {posed.pieces} segments, and {out} would not say which scans have poses: write .tum or .npz"
        raise ValueError(msg)
    else:
        write_poses(out, scans.poses, scans.times_s)
    results.add(f"{len(scans.poses)} poses written to {out}", out=out)
    if picture is not None:
        from radarsdf.render.figures import save_trajectory_picture

        given = {} if posed.given is None else {"given": posed.given}
        drawn = given | {"refined" if given else "found": scans.poses}
        save_trajectory_picture(picture, scans.points, drawn)
        results.add(f"picture written to {picture}", picture=picture)
    following = _fit_of_poses(recording, out, find=find)
    results.add(f"next: {following}", next=following)


def _fit_of_poses(recording: Recording, out: Path, *, find: bool) -> str:
    """The command to run next: a fit with the poses that were written."""
    from radarsdf.io.recordings import BASE_T_RADAR

    target = ["-o", out.stem + MAP_SUFFIX]
    if out.suffix.lower() == ".npz":
        words = ["fit", str(out), *target]
    elif (recording.scans / BASE_T_RADAR).is_file():  # which would be applied to the written poses, too
        again = ["--find"] if find else []
        words = ["poses", *words_of(recording), *again, "-o", str(out.with_suffix(".npz"))]
    else:  # the written poses are those of the radar: no extrinsic applies to them
        placed = dataclasses.replace(recording, poses=out, extrinsic=None, pose_topic=None)
        words = ["fit", *words_of(placed), *target]
    return shlex.join(["radarsdf", *words])


def scans_and_poses(
    recording: Recording,
    config: FitConfig,
    results: Results,
    *,
    refine: bool,
    find: bool = False,
    needs_times: Path | None = None,
) -> tuple[Scans, Posed]:
    """Read scans; find their poses if there are none or `find` says so, or `refine` them.

    Of a trajectory in several segments, the scans of the longest are returned. `needs_times`: the file of poses that the
    command writes.
    """
    from radarsdf import odometry, refine_poses
    from radarsdf.io.poses import check_pose_times
    from radarsdf.poses.posed import Posed

    scans, missing = scans_or_unposed(recording, find=find)
    if needs_times is not None:
        check_pose_times(needs_times, scans.times_s)
    if find or missing is not None:
        with finding_poses(missing):
            found = odometry(scans, config=config)
        results.add(found.report["verdict"], poses=found.report)
        if found.report["doppler_sign"] < 0:
            results.add("this radar's Doppler is positive where the sensor approaches")
        posed, scans = Posed.found(found), scans.with_poses(found.poses, other_world=True)
        add_segments(results, posed)
        return (scans.select(range(len(scans))[posed.rows]) if posed.pieces > 1 else scans), posed
    if not refine:
        return scans, Posed.as_given(scans.poses)
    refined = refine_poses(scans, config=config)
    report = refined.report
    results.add(report["verdict"], poses=report, improved=refined.improved)
    if refined.improved:
        results.add(
            f"they moved by {report['moved_m']:.3f} m and {math.degrees(report['moved_rad']):.2f} degrees; the input's "
            f"step error is {report['sigma_m']:.3f} m and {math.degrees(report['sigma_rad']):.2f} degrees "
            "(root mean square, standard deviations)"
        )
    return scans.with_poses(refined.poses), Posed.refined(refined, scans.poses)


def add_segments(results: Results, posed: Posed) -> None:
    """Add which segment of a trajectory is used, and print what was not used to find it."""
    for note in posed.notes:
        warn(f"note: {note}")
    if posed.pieces > 1:
        results.add(f"the scans {posed.rows.start} to {posed.rows.stop - 1} are used, the longest segment")


def scans_or_unposed(recording: Recording, *, find: bool = False) -> tuple[Scans, NoPoses | None]:
    """Read scans, and why they have no poses. `find`: theirs are not used."""
    from radarsdf.io.poses import UNPOSED, NoPoses

    if find:
        return recording.read(UNPOSED), None
    try:
        return recording.read(), None
    except NoPoses as missing:
        return recording.read(UNPOSED), missing


@contextmanager
def finding_poses(missing: NoPoses | None) -> Iterator[None]:
    """A block in which poses are found. If they are `missing`, that is printed, or why they cannot be found."""
    try:
        yield
    except ValueError as error:
        if missing is None:
            raise
        msg = f"{missing}, but not here: {error}"
        raise ValueError(msg) from error
    if missing is not None:
        warn("note: there are no poses: they were found from the radar alone")


def convert(recording: Recording, *, out: Path, results: Results) -> None:
    """Read, and write as the ending of the output says.

    scans: The scans: .npz of radarsdf, a folder of point clouds, a ROS bag, or the folder of a data set; or a mesh: .ply,
        .obj, .off, .stl, .glb.
    out: .npz: the scans with their poses, as every command reads them; .ply, .pcd, .las, .laz, .npy or .csv: all returns in
        the world frame, with intensity, doppler, number and time of the scan; of a mesh, a mesh.
    """
    from radarsdf.io.cloud_writing import check_cloud_path, write_cloud
    from radarsdf.io.clouds import CLOUD_SUFFIXES
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import check_mesh_path, holds_mesh, read_mesh, write_mesh
    from radarsdf.io.npz import write_scans

    check_outputs([out], recording.inputs)
    if recording.poses is None and holds_mesh(recording.scans):
        check_mesh_path(out)
        mesh = read_mesh(recording.scans)
        results.add_mesh(mesh, out, write_mesh(out, mesh))
        return
    suffix = out.suffix.lower()
    if suffix != ".npz":
        check_cloud_path(out)
    folder = recording.scans.resolve()
    if suffix in CLOUD_SUFFIXES and folder.is_dir() and folder in out.resolve().parents:
        msg = f"{out} lies in the folder of the scans, and would be read as one of them: write it elsewhere"
        raise ValueError(msg)
    scans = recording.read()
    origin = None
    if suffix == ".npz":
        write_scans(out, scans)
        returns = sum(map(len, scans.points))
    else:
        written = write_cloud(out, scans, progress=results.progress)
        returns, origin = written.returns, written.origin
    line = f"{returns} returns of {counted(len(scans), 'scan')} written to {out}"
    results.add(line, returns=returns, scans=len(scans), out=out)
    results.add_origin(out, origin)
