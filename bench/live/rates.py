# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time of a scan and of a mesh, beside VDBFusion where it is installed."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.simulate import Simulation
from radarsdf.simulate.worlds import HUGIN_A3

from bench.rows import quantile
from bench.timing import timed

_MESH_EVERY = 10
_DENSE = "hugin, 20,000 returns a scan"


def scans_of(name: str, seed: int, quick: bool) -> Simulation:
    """A scene by its name; the dense one has a sensor of ten times as many beams."""
    if name != _DENSE:
        return radarsdf.simulate.SCENES[name](seed=seed, frames=12 if quick else None)
    scans = radarsdf.simulate.hugin(seed=seed, frames=12 if quick else 60)
    sensor = dataclasses.replace(HUGIN_A3, beams=12 * HUGIN_A3.beams)
    return radarsdf.simulate.simulate(scans.scene, sensor, scans.poses, name=name, seed=seed)


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each scene and method."""
    for name in options.cases or ["hugin", "oculii", "wall", "astyx", _DENSE]:
        scans = scans_of(name, options.seed, options.quick)
        for method, add, mesh in _methods(options.threads):
            if add is None:
                continue
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
