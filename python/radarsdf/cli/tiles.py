# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf tiles``: maps that do not fit into memory, in one go or step by step."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from radarsdf.cli.options import (
    add_config_options,
    add_json,
    add_quiet,
    add_surface,
    config_of,
    limits_of,
    progress_of,
)
from radarsdf.cli.posing import finding, scans_or_unposed
from radarsdf.cli.results import Results
from radarsdf.cli.saying import complain
from radarsdf.cli.scans_in import add_scans

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from radarsdf.tiles.plan import Plan

STEPS = {
    "plan": "read the scans once, and write to a file for each tile the rays that cross it",
    "fit": "fit the tiles of a plan; those that are done are kept",
    "mesh": "write the surface of all tiles as one mesh, which need not fit into memory",
    "status": "name the tiles that are not done, and why",
    "clean": "remove the rays of tiles that are done, and pieces of meshes",
}
"""Name of each step, and its help in one line."""
_FIRST_SCANS = 100  # that are checked before the work


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of all steps in one go."""
    _add_plan(parser)
    _add_where(parser)
    add_surface(parser)
    add_quiet(parser)
    add_json(parser)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    steps = "\n".join(f"  {name:<8}{text}" for name, text in STEPS.items())
    parser.epilog = f"one step at a time: radarsdf tiles STEP; radarsdf tiles STEP --help says more\n{steps}"


def add_step_arguments(parser: argparse.ArgumentParser, step: str) -> None:
    """Declare the arguments of one of `STEPS`."""
    if step == "plan":
        _add_plan(parser)
    else:
        parser.add_argument("folder", type=Path, help="what radarsdf tiles plan wrote")
    if step in ("fit", "status"):
        parser.add_argument("--tile", action="append", metavar="NAME", help="only this tile; may be repeated")
    if step == "mesh":
        parser.add_argument(
            "-o",
            "--out",
            type=Path,
            help="the mesh to write: a .ply file, or a .json file for 3D Tiles; default: mesh.ply in the folder",
        )
        add_surface(parser)
    if step in ("plan", "fit", "mesh"):
        _add_where(parser)
        add_quiet(parser)
    add_json(parser)


def _add_plan(parser: argparse.ArgumentParser) -> None:
    add_scans(parser)
    parser.add_argument("-o", "--out", type=Path, required=True, help="the folder to write")
    parser.add_argument(
        "--tile-size", type=float, metavar="M", help="edge of a tile, m; default: 512 leaf cells"
    )
    parser.add_argument("--halo", type=float, metavar="M", help="what a tile knows beyond its edges, m")
    parser.add_argument(
        "--refine",
        action="store_true",
        help="mend the poses by the returns before the plan is made; they are written into the folder, poses.tum",
    )
    parser.add_argument("--geometry-only", action="store_true", help="do not use the intensities")
    parser.add_argument("--no-check", action="store_true", help="do not check the first scans")
    add_config_options(parser)


def _add_where(parser: argparse.ArgumentParser) -> None:
    """Who does the work. A plan only estimates by it."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--processes", type=int, metavar="N", help="so many tiles at a time")
    where.add_argument(
        "--cluster", metavar="ADDRESS", help="the scheduler of dask.distributed, such as tcp://host:8786"
    )


def run(options: argparse.Namespace) -> int:
    """Do one step, or plan, fit and mesh."""
    step = getattr(options, "step", None)
    folder: Path = options.out if step in (None, "plan") else options.folder
    results = Results(options)
    if step in (None, "plan"):
        _say_plan(results, _plan(options), folder)
    if step in (None, "fit"):
        _fit(options, results, folder)
    if step in (None, "mesh"):
        _mesh(options, results, folder, None if step is None else options.out)
    if step == "clean":
        _clean(results, folder)
    names = getattr(options, "tile", None)
    status = _status(results, folder, names) if step in (None, "fit", "status") else 0
    results.end()
    return status


def _plan(options: argparse.Namespace) -> Plan:
    from radarsdf.io.scans import Notes, Scans
    from radarsdf.tiles.fit_tiles import plan_tiles

    scans, missing = scans_or_unposed(options)
    if not options.no_check and missing is None:
        _check_first(scans)
    given = scans
    if options.geometry_only:
        given = Scans.of_source(
            lambda: (_without_intensities(scan) for scan in scans),
            Notes(str(options.scans)),
            imu=lambda: scans.imu,
        )
    alone = options.processes is None and options.cluster is None
    with finding(options, missing):
        return plan_tiles(
            given,
            options.out,
            tile_size=options.tile_size,
            halo=options.halo,
            config=config_of(options),
            threads=None if alone else 1,
            refine=options.refine,
            find=missing is not None,
            progress=progress_of(options),
        )


def _check_first(scans: Any) -> None:
    """A city of wrong poses would take hours."""
    import itertools

    from radarsdf.cli.check import warn_or_refuse
    from radarsdf.io.scans import scans_in_memory

    some = list(itertools.islice(iter(scans), _FIRST_SCANS))
    if len(some) > 1:
        first = scans_in_memory(some)
        warn_or_refuse(first, first.intensities)


def _without_intensities(scan: Any) -> Any:
    import dataclasses

    return dataclasses.replace(scan, intensities=None)


def _executor(options: argparse.Namespace, folder: Path) -> AbstractContextManager[Executor | None]:
    """What runs the tasks. None: this process."""
    if options.cluster is not None:
        from radarsdf.tiles.plan import Plan
        from radarsdf.tiles.tasks import cluster_executor

        plan = Plan.load(folder)
        return cluster_executor(options.cluster, max(tile.memory_bytes for tile in plan.tiles))
    if options.processes is not None:
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor

        from radarsdf.checks import whole_number

        count = whole_number(options.processes, "--processes", 1, 1024)
        # Not forked: a child that is forked has only one of the threads of PyTorch and OpenMP.
        return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"))
    return nullcontext()


def _fit(options: argparse.Namespace, results: Results, folder: Path) -> None:
    from radarsdf.tiles.fit_tiles import run_fits

    with _executor(options, folder) as executor:
        city = run_fits(
            folder, executor=executor, names=getattr(options, "tile", None), progress=progress_of(options)
        )
    results.add(f"{city} in {folder}", tiles_done=len(city.tiles))


def _mesh(options: argparse.Namespace, results: Results, folder: Path, out: Path | None) -> None:
    from radarsdf.io.files import check_outputs
    from radarsdf.tiles.tiled_map import TiledMap

    out = folder / "mesh.ply" if out is None else out
    check_outputs([out])
    city = TiledMap(folder)
    with _executor(options, folder) as executor:
        vertices, triangles = city.export(
            out, options.voxel, **limits_of(options), executor=executor, progress=progress_of(options)
        )
    results.add(
        f"{vertices} vertices and {triangles} triangles written to {out}",
        vertices=vertices,
        triangles=triangles,
        out=out,
    )
    results.add_threshold(city.threshold(options.voxel, **limits_of(options)).metadata)


def _clean(results: Results, folder: Path) -> None:
    from radarsdf.tiles.tiled_map import TiledMap

    freed = TiledMap(folder).clean()
    results.add(f"{freed / 1e6:.1f} MB of rays and pieces of meshes removed from {folder}", bytes=freed)


def _say_plan(results: Results, plan: Plan, folder: Path) -> None:
    from radarsdf.tiles.drive_poses import TRAJECTORY, DrivePoses

    if (poses := DrivePoses.load(folder)) is not None:
        way, rows = poses.posed.way or {}, poses.posed.rows
        results.add(way["verdict"], poses=folder / TRAJECTORY, improved=way["improved"])
        for note in poses.posed.notes:
            complain(f"radarsdf tiles: {note}")
        if poses.posed.pieces > 1:
            results.add(f"the scans {rows.start} to {rows.stop - 1} are used, the longest piece")
    returns, rays = (sum(getattr(tile, name) for tile in plan.tiles) for name in ("returns", "rays"))
    most, seconds = max(tile.memory_bytes for tile in plan.tiles), sum(tile.seconds for tile in plan.tiles)
    results.add(
        f"{len(plan.tiles)} tiles of {plan.tile_m:g} m with a halo of {plan.halo_m:g} m, {returns} returns in "
        f"{plan.scans} scans, {rays / returns:.1f} rays for each; about {seconds:.0f} s in all, and "
        f"{most / 1e9:.2f} GB for the largest",
        tiles=len(plan.tiles),
        tile_m=plan.tile_m,
        halo_m=plan.halo_m,
        returns=returns,
        rays=rays,
        scans=plan.scans,
        seconds=seconds,
        memory_bytes=most,
        plan=folder / "plan.json",
    )


def _status(results: Results, folder: Path, names: list[str] | None) -> int:
    """Name the tiles that are not done, of all or of these `names`. The exit status is 1 if there are any."""
    from radarsdf.tiles.plan import Plan, failure_of, is_done

    plan = Plan.load(folder)
    missing = {}
    tiles = [tile for tile in plan.tiles if names is None or tile.name in names]
    for tile in tiles:
        if not is_done(folder, plan, tile):
            missing[tile.name] = failure_of(folder, tile) or "not yet done"
    results.add(f"{len(tiles) - len(missing)} of {len(tiles)} tiles are done", missing=missing)
    for name, reason in missing.items():
        complain(f"radarsdf tiles: {name}: {reason}")
    return 1 if missing else 0
