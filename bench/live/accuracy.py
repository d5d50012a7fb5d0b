"""Surface and intensities of live maps, compared with fits of the same scans."""

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf import FitConfig, LiveMap
from radarsdf.evaluation import holdout, surface_metrics
from radarsdf.simulate import measured_motion

from bench.measure import timed
from bench.runner import Row
from scenes.scene import Scene, load_scene

_FINE_M = 0.1  # voxels of a fit; those of a live map are its leaf cells
_HELD_OUT_EVERY = 5


def _scenes(options: argparse.Namespace, few: int = 12) -> Iterator[tuple[Scene, FitConfig]]:
    for spec in options.cases:
        scene = load_scene(spec, seed=options.seed, frames=few if options.quick else None)
        yield scene, scene.config("default", num_threads=options.threads[0])


def _f_percent(mesh: Any, scene: Scene, options: argparse.Namespace) -> float:
    samples = 20_000 if options.quick else 300_000
    assert scene.ground_truth is not None
    f_score: float = surface_metrics(mesh, scene.ground_truth, samples=samples)["f_score_all"]
    return 100 * f_score


def accuracy(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene and tenth of its scans: F-scores of the growing map and of a fit.

    `all` is without the confidence threshold: what is missing there is missing in the surface itself.
    """
    for scene, config in _scenes(options):
        assert scene.intensities is not None
        live = LiveMap(config)
        for tenth in (5, 10) if options.quick else range(1, 11):
            end = max(2, len(scene) * tenth // 10)
            for i in range(len(live), end):
                live.integrate(scene.points[i], scene.poses[i], scene.intensities[i])
            part = scene.first(end)
            fitted = radarsdf.fit(
                part.points, part.poses, part.intensities, config=config, origin=live.origin, progress=False
            )
            meshes = {
                "live, F %": live.mesh(),
                "fit": fitted.mesh(_FINE_M, progress=False),
                "live, all": live.mesh(min_confidence=0),
                "fit, all": fitted.mesh(_FINE_M, min_confidence=0, progress=False),
            }
            found = {name: round(_f_percent(mesh, scene, options), 2) for name, mesh in meshes.items()}
            yield {"scene": scene.name, "scans": end, **found}


def intensities(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene: MAE at the returns of held-out scans, every fifth, where all maps have predictions."""
    for scene, config in _scenes(options):
        train, test = holdout(len(scene), _HELD_OUT_EVERY)
        known = scene._select(train)
        assert known.intensities is not None
        live = LiveMap(config)
        for points, pose, values in zip(known.points, known.poses, known.intensities, strict=True):
            live.integrate(points, pose, values)
        maps: dict[str, Any] = {"live": live.map()}
        for name, reflectance in (("fit", "both"), ("fit, closed form", "closed-form")):
            maps[name] = radarsdf.fit(
                known.points,
                known.poses,
                known.intensities,
                config=config.override(networks={"reflectance": reflectance}),
                origin=live.origin,
                progress=False,
            )
        x, sensors, measured = scene._select(test).world_returns()
        errors: NDArray[Any] = np.array(
            [np.abs(own.intensity(x, sensors) - measured) for own in maps.values()]
        )
        everywhere = np.isfinite(errors).all(axis=0)
        means = zip(maps, errors[:, everywhere].mean(axis=1), strict=True)
        yield {"scene": scene.name, "returns": int(everywhere.sum())} | {
            f"{name}, dB": round(float(value), 3) for name, value in means
        }


def loops(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per lap: a live map of tracked scans, before and after `close_loops`, and a map with true poses."""
    for scene, config in _scenes(options, few=60):  # of fewer, neighbours are too far apart to be tracked
        assert scene.simulation is not None
        motion = measured_motion(scene.simulation, seed=options.seed)
        live, true = LiveMap(config), LiveMap(config)
        each = zip(scene.points, scene.poses, motion.doppler_mps, motion.times_s.tolist(), strict=True)
        for points, pose, doppler_mps, time_s in each:
            live.integrate(points, doppler_mps=doppler_mps, time_s=time_s)
            true.integrate(points, pose)

        def compared(live: LiveMap = live, scene: Scene = scene) -> tuple[float, float]:
            T_true_live = scene.poses[0] @ np.linalg.inv(live.pose(live.scan_ids[0]))
            end_m = (T_true_live @ live.pose(live.scan_ids[-1]) - scene.poses[-1])[:3, 3]
            f_percent = _f_percent(live.mesh().apply_transform(T_true_live), scene, options)
            return round(f_percent, 2), round(float(np.linalg.norm(end_m)), 3)

        before = compared()
        with timed() as taken:
            live.close_loops()
        after = compared()
        yield {
            "scene": scene.name,
            "tracked, F %": before[0],
            "closed": after[0],
            "true poses": round(_f_percent(true.mesh(), scene, options), 2),
            "end off, m": before[1],
            "closed, m": after[1],
            "close_loops, s": round(taken.cpu_s, 2),
        }
