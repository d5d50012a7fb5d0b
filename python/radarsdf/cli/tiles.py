# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf tiles``: maps that do not fit into memory, in one go or step by step. Each function is a step."""

from __future__ import annotations

import dataclasses
import itertools
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.app import refuse_if, warn
from radarsdf.cli.options import Recording, Settings, Surface
from radarsdf.cli.results import Results
from radarsdf.cli.scans import warn_or_refuse

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from radarsdf.tiles.plan import Plan

_FIRST_SCANS = 100  # that are checked before the work


@dataclass(kw_only=True)
class Cut:
    """How a drive is cut into tiles.

    tile_size: Edge of a tile, m; default: 512 leaf cells.
    halo: Margin around a tile that its fit sees, m.
    geometry_only: Do not use the intensities.
    no_check: Do not check the first scans.
    """

    tile_size: float | None = None
    halo: float | None = None
    geometry_only: bool = False
    no_check: bool = False


@dataclass(kw_only=True)
class Where:
    """Where the work is done.

    processes: Number of worker processes; each fits one tile at a time.
    cluster: Address of the scheduler of dask.distributed, such as tcp://host:8786.
    """

    processes: int | None = None
    cluster: str | None = None

    def __post_init__(self) -> None:
        both = self.processes and self.cluster
        refuse_if(both, "--processes and --cluster exclude each other: leave out one")
        too_few = self.processes is not None and self.processes < 1
        refuse_if(too_few, f"--processes must be at least 1, not {self.processes}")

    @property
    def is_here(self) -> bool:
        """Whether this process does it."""
        return self.processes is None and self.cluster is None

    def executor(self, folder: Path) -> AbstractContextManager[Executor | None]:
        """What runs the tasks. None: this process."""
        if self.cluster is not None:
            from radarsdf.tiles.plan import Plan
            from radarsdf.tiles.tasks import cluster_executor

            return cluster_executor(self.cluster, max(tile.memory_bytes for tile in Plan.load(folder).tiles))
        if self.processes is not None:
            import multiprocessing
            from concurrent.futures import ProcessPoolExecutor

            # Not forked: a forked child has only one of the threads of PyTorch and OpenMP.
            return ProcessPoolExecutor(self.processes, multiprocessing.get_context("spawn"))
        return nullcontext()


def run(
    recording: Recording,
    *,
    out: Path,
    cut: Cut,
    where: Where,
    settings: Settings,
    surface: Surface,
    results: Results,
) -> int:
    """Plan, fit and mesh in one go.

    out: The folder to write.
    """
    plan(recording, out=out, cut=cut, where=where, settings=settings, results=results)
    missing = fit(out, where=where, results=results)
    mesh(out, surface=surface, results=results)
    return missing


def plan(
    recording: Recording, *, out: Path, cut: Cut, where: Where, settings: Settings, results: Results
) -> None:
    """Read the scans once, and write to a file for each tile the rays that cross it.

    out: The folder to write.
    """
    from radarsdf.io.scans import Notes, Scans, scans_in_memory
    from radarsdf.tiles.fit_tiles import plan_tiles

    config = settings.load()
    scans = recording.read()
    if not cut.no_check:  # a city of wrong poses would take hours
        first = list(itertools.islice(iter(scans), _FIRST_SCANS))
        if len(first) > 1:
            some = scans_in_memory(first)
            warn_or_refuse(some, some.intensities)
    used = scans
    if cut.geometry_only:
        used = Scans.of_source(
            lambda: (dataclasses.replace(scan, intensities=None) for scan in scans),
            Notes(str(recording.scans)),
        )
    planned = plan_tiles(
        used,
        out,
        tile_size=cut.tile_size,
        halo=cut.halo,
        config=config,
        threads=None if where.is_here else 1,
    )
    _add_plan(results, planned, out)


def _add_plan(results: Results, plan: Plan, folder: Path) -> None:
    returns, rays = (sum(getattr(tile, name) for tile in plan.tiles) for name in ("returns", "rays"))
    seconds, most = sum(tile.seconds for tile in plan.tiles), max(tile.memory_bytes for tile in plan.tiles)
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


def fit(folder: Path, *, tile: list[str] | None = None, where: Where, results: Results) -> int:
    """Fit the tiles of a plan.

    folder: What radarsdf tiles plan wrote.
    tile: Fit only the tile of this name; may be repeated.
    """
    from radarsdf.tiles.fit_tiles import run_fits

    with where.executor(folder) as executor:
        city = run_fits(folder, executor=executor, names=tile, progress=results.progress)
    results.add(f"{city} in {folder}", tiles_done=len(city.tiles))
    return status(folder, tile=tile, results=results)


def mesh(folder: Path, *, out: Path | None = None, surface: Surface, results: Results) -> None:
    """Write the surface of all tiles as one mesh.

    folder: What radarsdf tiles fit wrote.
    out: The mesh to write: one file, or a .json file for 3D Tiles; default: mesh.ply in the folder.
    """
    from radarsdf.io.files import check_outputs
    from radarsdf.tiles.tiled_map import TiledMap

    out = folder / "mesh.ply" if out is None else out
    check_outputs([out])
    city = TiledMap(folder)
    vertices, triangles = city.export(out, surface.voxel, **surface.limits, progress=results.progress)
    line = f"{vertices} vertices and {triangles} triangles written to {out}"
    results.add(line, vertices=vertices, triangles=triangles, out=out)
    results.add_threshold(city.threshold(surface.voxel, **surface.limits).metadata)


def status(folder: Path, *, tile: list[str] | None = None, results: Results) -> int:
    """Name the tiles that are not done, and why.

    folder: What radarsdf tiles plan wrote.
    tile: Check only the tile of this name; may be repeated.
    """
    from radarsdf.tiles.plan import Plan, failure_of, is_done

    plan = Plan.load(folder)
    tiles = [planned for planned in plan.tiles if tile is None or planned.name in tile]
    undone = [planned for planned in tiles if not is_done(folder, plan, planned)]
    missing = {planned.name: failure_of(folder, planned) or "not yet done" for planned in undone}
    results.add(f"{len(tiles) - len(missing)} of {len(tiles)} tiles are done", missing=missing)
    for name, reason in missing.items():
        warn(f"error: {name}: {reason}")
    return int(bool(missing))
