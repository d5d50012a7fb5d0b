# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""F-score of the growing map after each tenth of a drive, beside fits of the same scans.

`all` is without the rule that leaves improbable surface out: what is missing there is missing in the surface itself.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.evaluation import surface_metrics
from radarsdf.simulate import Simulation

from bench.live.rates import scans_of
from bench.paper.scenes import Scene, load_scene
from bench.timing import timed

_FINE_M = 0.1  # voxels of a fit; those of a live map are its leaf cells


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each scene and tenth. A case may be a file of recorded scans with ground truth."""
    samples = 20_000 if options.quick else 300_000
    for name in options.cases or ["hugin", "oculii", "wall"]:
        drive = drive_of(name, options)
        scans, config = drive.scans, drive.config
        assert scans.ground_truth is not None
        assert scans.intensities is not None
        live = LiveMap(config)
        done = 0
        for tenth in (5, 10) if options.quick else options.tenths:
            end = max(2, len(scans) * tenth // 10)
            for i in range(done, end):
                live.integrate(scans.points[i], scans.poses[i], scans.intensities[i])
            done = end
            fitted = radarsdf.fit(
                scans.points[:end],
                scans.poses[:end],
                scans.intensities[:end],
                config=config,
                origin=live.origin,
                progress=False,
            )
            with timed() as taken:
                grown = live.mesh()
            meshes = (
                grown,
                fitted.mesh(_FINE_M, progress=False),
                live.mesh(min_confidence=0),
                fitted.mesh(_FINE_M, min_confidence=0, progress=False),
            )
            kept, of_fit, whole, whole_of_fit = (
                100 * surface_metrics(mesh, scans.ground_truth, samples=samples)["f_score_all"]
                for mesh in meshes
            )
            yield {
                "scene": drive.name,
                "tenths": tenth,
                "scans": end,
                "live, F %": round(kept, 2),
                "fit": round(of_fit, 2),
                "live less fit": round(kept - of_fit, 2),
                "live, all": round(whole, 2),
                "fit, all": round(whole_of_fit, 2),
                "live less fit, all": round(whole - whole_of_fit, 2),
                "mesh, ms": round(1e3 * taken.cpu_s),
            }


class Drive(NamedTuple):
    """Scans with what they show, and settings with the ranges of the recorded ones."""

    name: str
    scans: Simulation | Scene
    config: FitConfig


def drive_of(name: str, options: argparse.Namespace) -> Drive:
    """A simulated scene, or a file of recorded scans with ground truth."""
    config = FitConfig(num_threads=options.threads)
    if not Path(name).is_file():
        return Drive(name, scans_of(name, options.seed, options.quick), config)
    scene = load_scene(name)
    return Drive(scene.name, scene, config.override(returns=scene.ranges))
