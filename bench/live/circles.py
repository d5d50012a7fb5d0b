# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Memory and time over very many scans of one place, driven in circles with new noise each time."""

from __future__ import annotations

import argparse
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, LiveMap

from bench.paper.report import figure
from bench.rows import quantile
from bench.timing import timed

_SCANS, _ROWS, _LAP = 100_000, 20, 500
_NOISE = 0.002  # of a range, new each time
_MAX_BYTES = 150_000_000


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each twentieth of the scans."""
    count = int(options.cases[0]) if options.cases else 400 if options.quick else _SCANS
    lap = radarsdf.simulate.oculii(seed=options.seed, frames=min(_LAP, count // 4))
    rng = np.random.default_rng(options.seed)
    live = LiveMap(FitConfig(num_threads=options.threads), max_bytes=_MAX_BYTES)
    times: list[float] = []
    for i in range(count):
        scan = lap.points[i % len(lap)]
        noisy = scan * (1 + rng.normal(0, _NOISE, (len(scan), 1))).astype(np.float32)
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


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Milliseconds and megabytes over the scans."""
    with figure(path, columns=2, size=(4, 3.2)) as ((left, right),):
        scans = [row["scans"] for row in rows]
        for name in ("integrate p50, ms", "p99"):
            left.plot(scans, [row[name] for row in rows], "o-", label=name)
        for name in ("map, MB", "process at most, MB"):
            right.plot(scans, [row[name] for row in rows], "o-", label=name)
        for axes in (left, right):
            axes.set_ylim(0)
            axes.set_xlabel("scans")
            axes.grid(alpha=0.3)
