"""``radarsdf tiles``: large maps in tiles, locally or on a cluster."""

import itertools
import multiprocessing
from argparse import Namespace
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext

from radarsdf.cli import Results, warn
from radarsdf.cli.inputs import mesh_limits, read_scans, without_intensities
from radarsdf.cli.options import refuse_if
from radarsdf.cli.scans import warn_or_refuse
from radarsdf.cli.settings import load_config
from radarsdf.io.files import check_outputs
from radarsdf.scans import scans_in_memory
from radarsdf.tiles.fit_tiles import cluster_executor, plan_tiles, run_fits
from radarsdf.tiles.mesh import voxels_along
from radarsdf.tiles.plan import Plan, failure_of, is_done
from radarsdf.tiles.tiled_map import TiledMap

_FIRST_SCANS = 100  # checked before the work


def run(given: Namespace, results: Results) -> int:
    voxels_along(load_config(given).leaf_size_m, given.voxel)  # raises before the work
    plan(given, results)
    in_folder = Namespace(**vars(given) | {"folder": given.out, "tile": None, "out": None})
    missing = fit(in_folder, results)
    mesh(in_folder, results)
    return missing


def plan(given: Namespace, results: Results) -> None:
    _check_where(given)
    config = load_config(given)
    scans = read_scans(given)
    if not given.no_check:  # with wrong poses, a city would waste hours
        first = list(itertools.islice(iter(scans), _FIRST_SCANS))
        if len(first) > 1:
            warn_or_refuse(scans_in_memory(first))
    threads = 1 if given.processes or given.cluster else None
    scans = without_intensities(scans) if given.geometry_only else scans
    options = {"tile_size": given.tile_size, "halo": given.halo, "config": config, "threads": threads}
    planned = plan_tiles(scans, given.out, **options)
    names = ("returns", "rays", "seconds")
    totals = {name: sum(getattr(tile, name) for tile in planned.tiles) for name in names}
    most = max(tile.memory_bytes for tile in planned.tiles)
    line = (
        f"{len(planned.tiles)} tiles of {planned.tile_m:g} m with a halo of {planned.halo_m:g} m, "
        f"{totals['returns']} returns in {planned.scans} scans; about {totals['seconds']:.0f} s in all, and "
        f"{most / 1e9:.2f} GB for the largest"
    )
    totals |= {name: getattr(planned, name) for name in ("tile_m", "halo_m", "scans")}
    results.add(line, tiles=len(planned.tiles), memory_bytes=most, plan=given.out / "plan.json", **totals)


def _check_where(given: Namespace) -> None:
    here = given.processes is None
    refuse_if(not here and given.cluster, "--processes and --cluster exclude each other: leave out one")
    refuse_if(not here and given.processes < 1, f"--processes must be at least 1, not {given.processes}")


def _executor(given: Namespace) -> AbstractContextManager[Executor | None]:
    _check_where(given)
    if given.cluster is not None:
        memory_bytes = max(tile.memory_bytes for tile in Plan.load(given.folder).tiles)
        return cluster_executor(given.cluster, memory_bytes)
    if given.processes is not None:
        # Not forked: a forked child lacks all threads of PyTorch and OpenMP but one.
        return ProcessPoolExecutor(given.processes, multiprocessing.get_context("spawn"))
    return nullcontext()


def fit(given: Namespace, results: Results) -> int:
    with _executor(given) as executor:
        city = run_fits(given.folder, executor=executor, names=given.tile, progress=results.progress)
    results.add(f"{city} in {given.folder}", tiles_done=len(city.tiles))
    return status(given, results)


def mesh(given: Namespace, results: Results) -> None:
    out, limits = given.out or given.folder / "mesh.ply", mesh_limits(given)
    check_outputs([out])
    city = TiledMap(given.folder)
    counts = city.export(out, given.voxel, **limits, progress=results.progress)
    results.add_mesh(out, *counts, city.threshold(given.voxel, **limits))


def status(given: Namespace, results: Results) -> int:
    plan = Plan.load(given.folder)
    tiles = [tile for tile in plan.tiles if given.tile is None or tile.name in given.tile]
    undone = [tile for tile in tiles if not is_done(given.folder, plan, tile)]
    missing = {tile.name: failure_of(given.folder, tile) or "not yet done" for tile in undone}
    results.add(f"{len(tiles) - len(missing)} of {len(tiles)} tiles are done", missing=missing)
    for name, reason in missing.items():
        warn(f"error: {name}: {reason}")
    return int(bool(missing))
