"""Maps in tiles compared with one fit, and their scaling with returns: `python -m bench.tiles seams|growth`, on Linux."""

import argparse
import multiprocessing
import resource
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf import FitConfig, RadarMap, TiledMap, evaluation
from radarsdf.io import Scan, Scans
from radarsdf.tiles.fit_tiles import plan_tiles, run_fits

from bench.growth.street import street, street_scans
from bench.measure import in_new_process, timed
from bench.runner import Experiment, Row, main
from scenes.scene import load_scene

# Edges of the tiles: small, for many borders; the default on the long street.
_TILE_M = {"hugin": 32.0, "oculii": 51.2, "street": None}
_RETURNS = 10_000_000
_WORKERS = 2
_SIDE_M = 1e-3  # offset to either side of a border at which queries are compared
_NEAR_M = 1.0  # distance of points near a border

_Floats = NDArray[np.float64]


def seams(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene: F-scores, steps across borders, distance from the surface of one fit, and open edges."""
    for name in options.cases:
        scans, config = _scene(name, options.quick)
        with tempfile.TemporaryDirectory() as folder:
            yield _row(name, scans, config, Path(folder) / "city", options.quick)


def _scene(name: str, quick: bool) -> tuple[Scans, FitConfig]:
    config = FitConfig.quick() if quick else FitConfig()
    if name == "street":
        count = 100_000 if quick else _RETURNS
        made = street(count, num_hits=count)  # all of them: the ground truth must be denser than the mesh
        return Scans(made.points, made.poses, made.intensities, made.hits), config
    scene = load_scene(name)
    scans = Scans(scene.points, scene.poses, scene.intensities, scene.ground_truth)
    return scans, config.override(returns=scene.ranges)


def _row(name: str, scans: Scans, config: FitConfig, folder: Path, quick: bool) -> Row:
    voxel_m = 0.2 if quick or name == "street" else 0.1
    city = radarsdf.fit_tiles(scans, folder, tile_size=_TILE_M[name], config=config, progress=False)
    scale = city.intensity_scale
    assert scale is not None
    one = radarsdf.fit(scans, config=config, intensity_range=(scale.low, scale.high), progress=False)
    meshes = [map_.mesh(voxel_m, progress=False) for map_ in (one, city)]
    truth = scans.ground_truth
    assert truth is not None
    scores = [evaluation.surface_metrics(mesh, truth, samples=500_000) for mesh in meshes]
    vertices = np.array(meshes[1].vertices)
    near = _to_border(city, vertices) < _NEAR_M
    distance_m = np.abs(one.sdf(vertices))
    steps = _steps(city, one, vertices)
    row: Row = {
        "scene": name,
        "tiles": len(city.tiles),
        "F of one fit": f"{100 * scores[0]['f_score_all']:.2f}",
        "F of tiles": f"{100 * scores[1]['f_score_all']:.2f}",
    }
    for what, sizes in steps.items():
        for of_map, (most, largest) in zip(("tiles", "one fit", "tiles elsewhere"), sizes, strict=True):
            row[f"step of {what}: {of_map}, 99 % and largest"] = f"{most:.2g}, {largest:.2g}"
    row["from one fit, border, median, 95 %, m"] = _two(distance_m[near])
    row["elsewhere  "] = _two(distance_m[~near])
    on_borders, inside = _open_edges(city, meshes[1])
    row["open edges, border"] = f"{on_borders:.2%}"
    row["elsewhere   "] = f"{inside:.2%}"
    return row


def _two(values: _Floats) -> str:
    return ", ".join(f"{value:.3f}" for value in np.nanquantile(values, [0.5, 0.95]))


def _to_border(city: TiledMap, points: _Floats) -> _Floats:
    """Distance (N,) to the nearest border between tiles, m."""
    way_m = points[:, :2] - city.plan.grid.corner_m
    nearest: _Floats = np.abs(way_m - np.round(way_m / city.plan.tile_m) * city.plan.tile_m).min(axis=1)
    return nearest


def _steps(city: TiledMap, one: RadarMap, vertices: _Floats) -> dict[str, tuple[tuple[float, float], ...]]:
    """The 99 % quantile and the maximum of steps in queries: of tiles and of the single fit across borders, and of
    tiles across planes in the middle of tiles.
    """
    found: dict[str, tuple[tuple[float, float], ...]] = {}
    sensor = city.config.lattice.position(city.tiles[0].origin_cells)
    places = [_sides(city, vertices, shift_m) for shift_m in (0.0, city.plan.tile_m / 2)]
    for what in ("sdf, m", "intensity, dB"):
        steps = []
        for map_, (points, side) in ((city, places[0]), (one, places[0]), (city, places[1])):
            here, there = (
                map_.sdf(at) if what == "sdf, m" else map_.intensity(at, sensor)
                for at in (points - side, points + side)
            )
            step = np.abs(here - there)
            steps.append((float(np.nanquantile(step, 0.99)), float(np.nanmax(step))))
        found[what] = tuple(steps)
    return found


def _sides(city: TiledMap, vertices: _Floats, shift_m: float) -> tuple[_Floats, _Floats]:
    """Points (N, 3) of the surface moved onto shifted borders, and steps (N, 3) across, where both are known."""
    rng = np.random.default_rng(0)
    way_m = vertices[:, :2] - city.plan.grid.corner_m - shift_m
    way_m -= np.round(way_m / city.plan.tile_m) * city.plan.tile_m
    near = rng.permutation(np.flatnonzero(np.abs(way_m).min(axis=1) < _NEAR_M))[:20_000]
    rows = np.arange(len(near)), np.abs(way_m[near]).argmin(axis=1)
    points, side = vertices[near], np.zeros((len(near), 3))
    points[rows] -= way_m[near, rows[1]]
    side[rows] = _SIDE_M
    seen = city.observed(points - side) & city.observed(points + side)
    return points[seen], side[seen]


def _open_edges(city: TiledMap, mesh: Any) -> tuple[float, float]:
    """Share of the edges with one triangle: on borders, and on planes in the middle of tiles."""
    edges, counts = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    shares = []
    for shift in (0.0, 0.5):
        way_m = np.asarray(mesh.vertices)[edges][:, :, :2] - city.plan.grid.corner_m
        places = way_m / city.plan.tile_m + shift
        on = (np.abs(places - np.round(places)) < 1e-9).all(axis=1).any(axis=1)
        shares.append(float((counts[on] == 1).mean()) if on.any() else float("nan"))
    return shares[0], shares[1]


def growth(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per number of returns of a street, each in a new process; workers are processes."""
    for count in [100_000] if options.quick else options.returns:
        yield in_new_process("bench.tiles:growth_row", count)


def growth_row(count: int) -> Row:
    """Plan, fit and export a street without intensities. Memory is the peak of a process according to the kernel."""
    scans = (Scan(points, pose) for pose, points, *_ in street_scans(count))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "city"
        with timed() as planning:
            plan = plan_tiles(scans, out, config=FitConfig.quick(num_threads=1))
        own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        with ProcessPoolExecutor(_WORKERS, multiprocessing.get_context("spawn")) as executor:
            with timed() as fitting:
                city = run_fits(out, executor=executor, progress=False)
            with timed() as meshing:
                _, triangles = city.export(out / "mesh.ply", 0.2, progress=False)
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        processor_s = sum(of.ru_utime + of.ru_stime for of in used)
        disk_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    return {
        "returns": count,
        "tiles": len(city.tiles),
        "plan, s": round(planning.wall_s, 1),
        "fit, s": round(fitting.wall_s, 1),
        "mesh, s": round(meshing.wall_s, 1),
        "processor, µs a return": round(1e6 * processor_s / count, 2),
        "plan, MB": round(own_mb),
        "worker, MB": round(used[1].ru_maxrss / 1e3),
        "disk, MB": round(disk_mb),
        "rays a return": round(sum(tile.rays for tile in plan.tiles) / count, 2),
        "triangles": triangles,
    }


EXPERIMENTS = {
    "seams": Experiment("Tiles and one fit", seams, tuple(_TILE_M)),
    "growth": Experiment(
        "Tiles of a street",
        growth,
        options=("returns",),
        defaults={"returns": [10**6, 3 * 10**6, 10**7, 3 * 10**7, 10**8]},
    ),
}

if __name__ == "__main__":
    main("bench.tiles", EXPERIMENTS)
