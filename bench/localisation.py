"""Localisation of scans in the map of an earlier day: what is found, wrong and refused, with which errors, in which time.

    python -m bench.localisation [--kinds hugin court] [--seeds 1 2 3] [--cases day reverse other] [--peers [kiss-matcher]]

A quick map of each place is fitted to one drive, and searched without a guess for 24 scans of another: of another day, in the
other direction (reverse), or of another radar with a third of the beams and twice the noise (other). Found: the medians of the
errors of the located scans are below 0.5 m and 3°. Unsure: above, but within three of their standard deviations, as heights that
steep surfaces do not observe. In symmetric places several poses are right, so each answer but a refusal is wrong.

Peers register the returns of the same scans, placed by `radarsdf.odometry`. `kiss-matcher` and `map-closures` search the returns
of the first drive; both are coarse, so small-gicp follows, to the vertices of the map's mesh. `small-gicp` alone needs a guess: the
true pose, displaced by 2 m and turned by 10°.

    pip install --no-deps kiss-matcher==1.0.2 map-closures==2.2.0 small-gicp==1.0.1
"""

import argparse
import importlib
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import radarsdf
import radarsdf.poses.locate
from numpy.typing import NDArray
from radarsdf import FitConfig, RadarMap, SurfaceIndex
from radarsdf.poses.rigid import increments, rotation_vector
from radarsdf.poses.search import search_scans
from radarsdf.simulate import MeasuredMotion, Simulation, measured_motion
from scipy.spatial.transform import Rotation

from bench.measure import timed
from bench.runner import Column, Experiment, Row, groups, provenance, run
from scenes.revisits import PLACES, SYMMETRIC, another_day, scan_rate_hz, weaker

Floats = NDArray[np.float64]

_OURS, _GUESSING = "radarsdf", "small-gicp"
_MOST_M, _MOST_DEG = 0.5, 3.0  # errors of a place that is found
_GUESS_M, _GUESS_DEG = 2.0, 10.0  # errors of the guess for small-gicp
_FEWEST_INLIERS = 5  # the default of map-closures, also for kiss-matcher, whose example has none
_KISS_VOXELS_M = (0.3, 0.5, 1.0)  # the answer with most inliers counts
_DENSITY_CELL_M, _THINNED_M = 0.5, 0.4  # of map-closures, which counts returns and finds less in all of them
_MAP_FRAMES = dict.fromkeys(PLACES, 60) | {"astyx": 24, "facade": 30, "wall": 40, "forest": 40, "tunnel": 40}

CASES: dict[str, Callable[[Simulation], dict[str, Any]]] = {
    "day": lambda _: {},
    "reverse": lambda _: {"reverse": True},
    "other": lambda first: {"sensor": weaker(first.sensor)},
}


@dataclass(frozen=True)
class Submap:
    """What peers register: scans placed by odometry in a frame of their own."""

    vertices: Floats
    """(M, 3) of the mesh of the map, world frame, m."""
    earlier: Floats
    """(N, 3) returns of the drive of the map, world frame, m."""
    returns: Floats
    """(K, 3) of the scans, frame of the odometry, m."""
    guess: Floats
    """(4, 4) T_world_odometry, wrong by 2 m and 10°."""


def _kiss_matcher(submap: Submap) -> Floats | None:
    searched = []
    for voxel_m in _KISS_VOXELS_M:
        matcher = importlib.import_module("kiss_matcher").KISSMatcher(voxel_m)
        found = matcher.estimate(submap.returns.astype(np.float32), submap.earlier.astype(np.float32))
        searched.append((matcher.get_num_final_inliers() if found.valid else 0, found))
    inliers, found = max(searched, key=lambda one: one[0])
    if inliers < _FEWEST_INLIERS:
        return None
    T_world_odometry = np.eye(4)
    T_world_odometry[:3, :3], T_world_odometry[:3, 3] = found.rotation, np.ravel(found.translation)
    return _gicp(submap, T_world_odometry)


def _map_closures(submap: Submap) -> Floats | None:
    package = importlib.import_module("map_closures.map_closures")
    closures = package.MapClosures(package.MapClosuresConfig(density_map_resolution=_DENSITY_CELL_M))
    closures.get_best_closure(0, _thinned(submap.earlier))
    # Neighbours in the sequence of local maps, those with numbers less than 4 apart, are not compared.
    found = closures.get_best_closure(4, _thinned(submap.returns))
    if found.number_of_inliers < _FEWEST_INLIERS:
        return None
    return _gicp(submap, np.linalg.inv(found.pose))


def _thinned(points: Floats) -> Floats:
    _, first = np.unique(np.floor(points / _THINNED_M), axis=0, return_index=True)
    return points[first]


def _gicp(submap: Submap, guess: Floats, may_refuse: bool = False) -> Floats | None:
    found = importlib.import_module("small_gicp").align(
        submap.vertices, submap.returns, init_T_target_source=guess, max_iterations=100
    )
    return np.asarray(found.T_target_source) if found.converged or not may_refuse else None


PEERS: dict[str, Callable[[Submap], Floats | None]] = {
    "kiss-matcher": _kiss_matcher,
    "map-closures": _map_closures,
    _GUESSING: lambda submap: _gicp(submap, submap.guess, may_refuse=True),
}
"""Each returns T_world_odometry (4, 4), or None if it refuses."""


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per place, seed, case and method, then their sums."""
    found: list[Row] = []
    for kind, seed in itertools.product(options.kinds, options.seeds):
        first = PLACES[kind](seed=seed, frames=_MAP_FRAMES[kind])
        config = FitConfig.quick(num_threads=options.threads)
        radar_map = radarsdf.fit(first.points, first.poses, config=config, progress=False)
        with timed() as indexing:
            index = SurfaceIndex.of(radar_map)
        for case in options.cases:
            day = another_day(first, seed, **CASES[case](first))
            place = "symmetric" if kind in SYMMETRIC else "unique"
            base: Row = {"part": "drives", "kind": kind, "place": place, "seed": seed, "case": case}
            motion = measured_motion(day, rate_hz=scan_rate_hz(day), seed=seed)
            peers = _of_peers(options.peers, radar_map, first, day, motion) if options.peers else ()
            for row in itertools.chain([_ours(index, day, motion) | {"index_s": indexing.cpu_s}], peers):
                if kind in SYMMETRIC and row["method"] != _GUESSING and "median_m" in row:
                    row["verdict"] = "wrong"
                found.append(base | row)
                yield found[-1]
    yield from sums(found)


def _ours(index: SurfaceIndex, day: Simulation, motion: MeasuredMotion) -> Row:
    scans: Row = {"doppler_mps": motion.doppler_mps, "times_s": motion.times_s}
    row: Row = {"method": _OURS, "verdict": "refused"}
    try:
        with _searches() as searches_s, timed() as whole:
            found = radarsdf.locate(index, day.points, **scans)
    except ValueError as error:
        row |= {} if isinstance(error, radarsdf.Lost) else {"why_not": str(error)}
    else:
        row |= judged(found.poses, day.poses) | {"explained": float(np.nanmedian(found.explained))}
        known = found.segments >= 0
        off = increments(day.poses[known], found.poses[known])
        off /= np.sqrt(np.einsum("fii->fi", found.covariance[known]))
        if row["verdict"] == "wrong" and np.median(np.abs(off).max(axis=1)) < 3:
            row["verdict"] = "unsure"
        row["track_ms"] = 1e3 * (whole.cpu_s - sum(searches_s)) / len(day)
    return row | {"search_s": sum(searches_s), "whole_s": whole.cpu_s}


@contextmanager
def _searches() -> Iterator[list[float]]:
    """Collect the CPU times, s, of the searches without a guess."""
    taken_s: list[float] = []

    def timed_search(*given: Any) -> Any:
        begin = time.process_time()
        try:
            return search_scans(*given)
        finally:
            taken_s.append(time.process_time() - begin)

    with mock.patch.object(radarsdf.poses.locate, "search_scans", timed_search):
        yield taken_s


def _of_peers(
    names: Sequence[str], radar_map: RadarMap, first: Simulation, day: Simulation, motion: MeasuredMotion
) -> Iterator[Row]:
    scans: Row = {"doppler_mps": motion.doppler_mps, "times_s": motion.times_s}
    try:
        odometry = radarsdf.odometry(day.points, config=radar_map.config, progress=False, **scans)
    except ValueError as error:
        yield from ({"method": name, "why_not": f"no odometry: {error}"} for name in names)
        return
    part = odometry.longest_segment()
    poses, true = odometry.poses[part], day.poses[part]
    points = [scan.astype(np.float64) for scan in day.points[part]]
    returns = np.concatenate([x @ T[:3, :3].T + T[:3, 3] for x, T in zip(points, poses, strict=True)])
    mesh = radar_map.mesh(radar_map.config.leaf_size_m, progress=False)
    guess = _disturbed(true[len(true) // 2], day.seed) @ np.linalg.inv(poses[len(true) // 2])
    submap = Submap(np.asarray(mesh.vertices, dtype=np.float64), first.world_points(), returns, guess)
    for name in names:
        try:
            for package in (name, _GUESSING):
                importlib.import_module(package.replace("-", "_"))
        except ModuleNotFoundError as error:
            yield {"method": name, "why_not": str(error)}
            continue
        with timed() as taken:
            T_world_odometry = PEERS[name](submap)
        row: Row = {"method": name, "verdict": "refused", "search_s": taken.cpu_s}
        yield row if T_world_odometry is None else row | judged(T_world_odometry @ poses, true)


def _disturbed(pose: Floats, seed: int) -> Floats:
    angle, found = np.random.default_rng(seed).uniform(0, 2 * np.pi), pose.copy()
    found[:2, 3] += _GUESS_M * np.array([np.cos(angle), np.sin(angle)])
    found[:3, :3] = Rotation.from_euler("z", _GUESS_DEG, degrees=True).as_matrix() @ pose[:3, :3]
    return found


def judged(poses: Floats, true: Floats) -> Row:
    """Return the errors of poses (F, 4, 4), NaN where a scan is lost, and the verdict on them."""
    located = np.isfinite(poses).all(axis=(1, 2))
    if not located.any():
        return {"verdict": "refused"}
    poses, true = poses[located], true[located]
    error_m = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    turns_rad = rotation_vector(poses[:, :3, :3] @ true[:, :3, :3].swapaxes(1, 2))
    error_deg = np.degrees(np.linalg.norm(turns_rad, axis=1))
    row: Row = {"located": float(located.mean())}
    for share, name in ((0.5, "median"), (0.9, "p90")):
        row[f"{name}_m"] = float(np.quantile(error_m, share))
        row[f"{name}_deg"] = float(np.quantile(error_deg, share))
    is_found = row["median_m"] < _MOST_M and row["median_deg"] < _MOST_DEG
    return {"verdict": "found" if is_found else "wrong"} | row


def sums(found: Sequence[Row]) -> Iterator[Row]:
    """Yield per method, case and kind of place the numbers of verdicts, and medians over the drives that were found."""
    known = [row for row in found if not row.get("why_not")]
    for (method, case, place), own in groups(known, "method", "case", "place").items():
        row: Row = {"part": "sums", "method": method, "case": case, "place": place}
        row |= {verdict: sum(one["verdict"] == verdict for one in own) for verdict in _VERDICTS}
        for key in _MEDIANS:
            values = [one[key] for one in own if key in one and one["verdict"] == "found"]
            row[key] = float(np.median(values)) if values else None
        yield row


_VERDICTS = ("found", "unsure", "wrong", "refused")
_MEDIANS = {
    "located": Column("located, %", 100, 0),
    "median_m": Column("median, cm", 100, 1),
    "p90_m": Column("90 %, cm", 100, 1),
    "median_deg": Column("median, °"),
    "p90_deg": Column("90 %, °"),
    "explained": Column("explained, %", 100, 0),
    "index_s": Column("index, s"),
    "search_s": Column("search, s"),
    "track_ms": Column("tracking, ms a scan", 1, 0),
    "whole_s": Column("search and tracking, s"),
}
EXPERIMENT = Experiment(
    "Localisation in the map of an earlier day",
    rows,
    columns={verdict: Column(verdict, 1, 0) for verdict in _VERDICTS} | _MEDIANS,
    tables=("part",),
    lines=("place", "kind", "seed", "case", "method", "verdict"),
)


def main() -> None:
    """Print one line a drive and method, and write the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kinds", nargs="+", default=list(PLACES), choices=list(PLACES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--peers", nargs="*", choices=list(PEERS), help="without names: all")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("bench_results"), help="folder of the tables")
    parser.set_defaults(quick=False)
    options = parser.parse_args()
    options.peers = list(PEERS) if options.peers == [] else options.peers
    options.out.mkdir(parents=True, exist_ok=True)
    run(EXPERIMENT, options, options.out / "localisation", provenance("bench.localisation"))


if __name__ == "__main__":
    main()
