"""Surface and intensities of live maps, compared with fits of the same scans."""

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf import FitConfig, LiveMap
from radarsdf.evaluation import holdout, surface_metrics
from radarsdf.poses.rigid import aligned

from bench.measure import timed
from bench.paper.poses import walked
from bench.runner import Row
from scenes.scene import Scene, load_scene

_FINE_M = 0.1  # voxels of a fit; those of a live map are its leaf cells
_HELD_OUT_EVERY = 5


def _scenes(options: argparse.Namespace) -> Iterator[tuple[Scene, FitConfig]]:
    for spec in options.cases:
        scene = load_scene(spec, seed=options.seed, frames=12 if options.quick else None)
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
    """Yield a row per scene: a drifting drive, corrected by `refine_poses` and `move_all`, and a map with true poses."""
    for scene, config in _scenes(options):
        given = walked(scene.poses, 0.02, 0.1, options.seed)

        def grown(poses: Any, scene: Scene = scene, config: FitConfig = config) -> LiveMap:
            live = LiveMap(config)
            for points, pose in zip(scene.points, poses, strict=True):
                live.integrate(points, pose)
            return live

        live = grown(aligned(given, scene.poses))
        before = _f_percent(live.mesh(), scene, options)
        refined = radarsdf.refine_poses(scene.points, given, config=config)
        with timed() as taken:
            # Returns do not determine the global pose, which is not evaluated.
            live.move_all(dict(zip(live.scan_ids, aligned(refined.poses, scene.poses), strict=True)))
        yield {
            "scene": scene.name,
            "drifted, F %": round(before, 2),
            "moved": round(_f_percent(live.mesh(), scene, options), 2),
            "true poses": round(_f_percent(grown(scene.poses).mesh(), scene, options), 2),
            "move_all, s": round(taken.cpu_s, 2),
        }
