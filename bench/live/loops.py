# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A drifted drive in a growing map, mended by `refine_poses` and `move_all`, beside a map of true poses."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.evaluation import surface_metrics
from radarsdf.poses.rigid import aligned

from bench.paper.broken_poses import walked
from bench.timing import timed


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each scene."""
    config = FitConfig(num_threads=options.threads)
    for name in options.cases or ["hugin", "oculii", "wall"]:
        scans = radarsdf.simulate.SCENES[name](seed=options.seed, frames=12 if options.quick else None)
        given = walked(scans.poses, 0.02, 0.1, options.seed)

        def score(live: LiveMap, truth: Any = scans.ground_truth) -> float:
            samples = 20_000 if options.quick else 1_000_000
            return 100 * surface_metrics(live.mesh(), truth, samples=samples)["f_score_all"]

        def grown(poses: Any, scans: Any = scans) -> LiveMap:
            live = LiveMap(config)
            for points, pose in zip(scans.points, poses, strict=True):
                live.integrate(points, pose)
            return live

        live = grown(aligned(given, scans.poses))
        before = score(live)
        refined = radarsdf.refine_poses(scans.points, given, config=config)
        with timed() as taken:
            # The returns do not tell where the whole is: that is not judged.
            live.move_all(dict(zip(live.scan_ids, aligned(refined.poses, scans.poses), strict=True)))
        after, true = score(live), score(grown(scans.poses))
        yield {
            "scene": name,
            "drifted, F %": round(before, 2),
            "moved": round(after, 2),
            "true poses": round(true, 2),
            "moved less true": round(after - true, 2),
            "move_all, s": round(taken.cpu_s, 2),
        }
