# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""F-score of the growing map after each tenth of a drive, beside fits of the same scans."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import Any

import radarsdf
import torch
from radarsdf import FitConfig, LiveMap
from radarsdf.evaluation import surface_metrics

from bench.live.rates import scans_of


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each scene and tenth."""
    torch.set_num_threads(options.threads)
    samples, parts = (20_000, 2) if options.quick else (1_000_000, 10)
    for name in options.cases or ["hugin", "oculii", "wall"]:
        scans = scans_of(name, options.seed, options.quick)
        assert scans.ground_truth is not None
        config = FitConfig(num_threads=options.threads)
        live = LiveMap(config)
        done = 0
        for part in range(1, parts + 1):
            end = len(scans) * part // parts
            for i in range(done, end):
                live.integrate(scans.points[i], scans.poses[i], scans.intensities[i])
            done = end
            begin = time.process_time()
            grown = live.mesh()
            mesh_ms = 1e3 * (time.process_time() - begin)
            meshes = [grown]
            for settings in (FitConfig.quick(num_threads=options.threads), config):
                fitted = radarsdf.fit(
                    scans.points[:end],
                    scans.poses[:end],
                    scans.intensities[:end],
                    config=settings,
                    origin=live.origin,
                    progress=False,
                )
                meshes.append(
                    fitted.mesh(config.leaf_size_m if settings is not config else 0.1, progress=False)
                )
            scores = [
                100 * surface_metrics(mesh, scans.ground_truth, samples=samples)["f_score_all"]
                for mesh in meshes
            ]
            yield {
                "scene": name,
                "scans": end,
                "live, F %": round(scores[0], 2),
                "quick fit": round(scores[1], 2),
                "fit": round(scores[2], 2),
                "live less fit": round(scores[0] - scores[2], 2),
                "mesh, ms": round(mesh_ms),
            }
