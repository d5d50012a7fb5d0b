"""Time and memory of live maps and of odometry. Times are CPU times unless stated."""

import argparse
import dataclasses
import resource
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.simulate import SCENES, Simulation, measured_motion, simulate

from bench.measure import timed
from bench.runner import Row, quantile

DENSE = "hugin, 20,000 returns a scan"
_MESH_EVERY = 10


def denser(scans: Simulation, times: float) -> Simulation:
    """The same drive by a sensor with `times` as many beams."""
    sensor = dataclasses.replace(scans.sensor, beams=round(times * scans.sensor.beams))
    return simulate(scans.scene, sensor, scans.poses, name=scans.name, seed=scans.seed)


def rates(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene and method: time of a scan and of a mesh, also of VDBFusion if installed."""
    for name in options.cases:
        if name == DENSE:
            scans = denser(radarsdf.simulate.hugin(seed=options.seed, frames=12 if options.quick else 60), 12)
        else:
            scans = SCENES[name](seed=options.seed, frames=12 if options.quick else None)
        for method, add, mesh in _methods(options.threads[0]):
            of_scans, of_meshes, wall_ms = [], [], []
            for i in range(len(scans)):
                with timed() as taken:
                    add(scans.points[i], scans.poses[i], scans.intensities[i])
                wall_ms.append(1e3 * taken.wall_s)
                of_scans.append(1e3 * taken.cpu_s)
                if i % _MESH_EVERY == _MESH_EVERY - 1:
                    with timed() as taken:
                        mesh()
                    of_meshes.append(1e3 * taken.cpu_s)
            yield {
                "scene": name,
                "returns a scan": int(np.median([len(scan) for scan in scans.points])),
                "method": method,
                "integrate p50, ms": quantile(of_scans, 0.5),
                "p99": quantile(of_scans, 0.99),
                "worst": quantile(of_scans, 1),
                "p99 by the clock": quantile(wall_ms, 0.99),
                f"mesh after {_MESH_EVERY} scans p50, ms": quantile(of_meshes, 0.5),
                "mesh worst": quantile(of_meshes, 1),
            }


def _methods(threads: int) -> Iterator[tuple[str, Callable[..., Any], Callable[[], Any]]]:
    live = LiveMap(FitConfig(num_threads=threads))
    yield "radarsdf", live.integrate, live.mesh
    try:
        from vdbfusion import VDBVolume  # noqa: PLC0415 - an optional peer
    except ImportError:
        return
    volume = VDBVolume(0.2, 0.6, space_carving=False)

    def integrate(points: Any, pose: Any, intensities: Any) -> None:
        del intensities
        volume.integrate(points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3], pose)

    yield "VDBFusion", integrate, lambda: volume.extract_triangle_mesh(fill_holes=False, min_weight=0.0)


_PLACES, _FRAMES, _LAST = (1, 6), 100, 4  # number of single scans at the last place
_APART_M = 200.0
# Fixed: an estimated noise would change as the map grows, and all results with it.
_NOISE = {"range_noise_m": 0.073, "azimuth_noise_rad": 0.0059, "elevation_noise_rad": 0.0093}


def growth(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for maps of one and several distant places: a mesh after one more scan should take equally long."""
    frames = 12 if options.quick else _FRAMES
    drives = [radarsdf.simulate.hugin(seed=options.seed + k, frames=frames) for k in range(max(_PLACES))]
    for places in _PLACES:
        live = LiveMap(FitConfig(num_threads=options.threads[0], returns=_NOISE), origin=(0, 0, 0))
        times = []
        # The place of the last scans is the same in all maps.
        for k in reversed(range(places)):
            for i in range(frames):
                pose = drives[k].poses[i].copy()
                pose[0, 3] += _APART_M * k
                live.integrate(drives[k].points[i], pose, drives[k].intensities[i])
                if k == 0 and i >= frames - _LAST - 1:
                    with timed() as taken:
                        mesh = live.mesh()
                    times.append(1e3 * taken.cpu_s)
        yield {
            "scans": len(live),
            "triangles": len(mesh.faces),
            "whole mesh, ms": round(times[0]),
            "after one more scan, ms": quantile(times[1:], 0.5),
        }


_LAP, _ROWS = 500, 20
_RANGE_NOISE = 0.002  # as a share of the range, drawn anew each time
_MAX_BYTES = 150_000_000


def circles(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per twentieth of very many scans of one place, driven in circles with new noise each time."""
    count = 400 if options.quick else int(options.cases[0])
    lap = radarsdf.simulate.oculii(seed=options.seed, frames=min(_LAP, count // 4))
    rng = np.random.default_rng(options.seed)
    live = LiveMap(FitConfig(num_threads=options.threads[0]), max_bytes=_MAX_BYTES)
    times: list[float] = []
    for i in range(count):
        scan = lap.points[i % len(lap)]
        noisy = scan * (1 + rng.normal(0, _RANGE_NOISE, (len(scan), 1))).astype(np.float32)
        with timed() as taken:
            live.integrate(noisy, lap.poses[i % len(lap)], lap.intensities[i % len(lap)])
        times.append(1e3 * taken.cpu_s)
        if (i + 1) % max(1, count // _ROWS) == 0:
            with timed() as taken:
                mesh = live.mesh()
            yield {
                "scans": i + 1,
                "integrate p50, ms": quantile(times, 0.5),
                "p99": quantile(times, 0.99),
                "worst": quantile(times, 1),
                "mesh, ms": round(1e3 * taken.cpu_s),
                "triangles": len(mesh.faces),
                "map, MB": round(live.num_bytes / 1e6, 1),
                "process at most, MB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
                "scans let go": live.sealed_scans,
            }
            times = []


_RETURNS = 2000  # per scan
_SCANS = 120  # per drive


def tracking(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, without and with Doppler: time in which `odometry` tracks a scan of 2,000 returns."""
    for name in options.cases:
        scans = SCENES[name](seed=options.seed, frames=_SCANS)
        scans = denser(scans, _RETURNS / float(np.median([len(scan) for scan in scans.points])))
        motion = measured_motion(scans, seed=options.seed)
        count = 12 if options.quick else _SCANS
        for source, doppler in (("returns", None), ("returns and Doppler", motion.doppler_mps[:count])):
            config = FitConfig(num_threads=options.threads[0])
            with timed() as taken:
                radarsdf.odometry(
                    scans.points[:count], doppler_mps=doppler, times_s=motion.times_s[:count], config=config
                )
            yield {
                "scene": name,
                "returns a scan": int(np.median([len(scan) for scan in scans.points])),
                "tracked by": source,
                "a scan, ms": round(1e3 * taken.cpu_s / count, 2),
                "by the clock, ms": round(1e3 * taken.wall_s / count, 2),
            }
