# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time and memory of `fit_tiles` over the returns of a street, each in a new process; workers are processes."""

from __future__ import annotations

import dataclasses
import itertools
import json
import multiprocessing
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from radarsdf import FitConfig
from radarsdf.io import Scan
from radarsdf.tiles.fit_tiles import plan_tiles, run_fits

from bench.growth.street import street_scans

_RETURNS = ("1000000", "3000000", "10000000", "30000000", "100000000")
_WORKERS = 2


def rows(counts: list[str], quick: bool, out: Path) -> Iterator[dict[str, Any]]:
    """A row for each number of returns."""
    del out
    for count in counts or (["100000"] if quick else _RETURNS):
        words = [sys.executable, "-m", "bench.tiles.growth", str(int(float(count)))]
        done = subprocess.run(words, check=True, capture_output=True, text=True)
        yield json.loads(done.stdout.splitlines()[-1])


def _measure(count: int) -> dict[str, Any]:
    """Plans, fits and exports a street. Memory is what the kernel says that a process held at most."""

    def scans() -> Iterator[Scan]:
        for pose, points, intensities, *_ in street_scans(count):
            yield Scan(points, pose, intensities)

    laps = [time.perf_counter()]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "city"
        plan = plan_tiles((scan for scan in _geometry(scans())), out, config=FitConfig.quick(num_threads=1))
        laps.append(time.perf_counter())
        own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        with ProcessPoolExecutor(_WORKERS, multiprocessing.get_context("spawn")) as executor:
            city = run_fits(out, executor=executor, progress=False)
            laps.append(time.perf_counter())
            _, triangles = city.export(out / "mesh.ply", 0.2, executor=executor, progress=False)
            laps.append(time.perf_counter())
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        processor_s = sum(of.ru_utime + of.ru_stime for of in used)
        disk_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    plan_s, fit_s, mesh_s = (after - before for before, after in itertools.pairwise(laps))
    return {
        "returns": count,
        "tiles": len(city.tiles),
        "plan, s": round(plan_s, 1),
        "fit, s": round(fit_s, 1),
        "mesh, s": round(mesh_s, 1),
        "all, µs a return": round(1e6 * (laps[-1] - laps[0]) / count, 2),
        "processor, µs a return": round(1e6 * processor_s / count, 2),
        "plan, MB": round(own_mb),
        "worker, MB": round(used[1].ru_maxrss / 1e3),
        "disk, MB": round(disk_mb),
        "rays a return": round(sum(tile.rays for tile in plan.tiles) / count, 2),
        "triangles": triangles,
    }


def _geometry(scans: Any) -> Any:
    """Without intensities: the surface is what is measured."""
    for scan in scans:
        yield dataclasses.replace(scan, intensities=None)


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Seconds and memory over the returns. Processor time is of all steps and workers."""
    from bench.paper.report import figure  # noqa: PLC0415 - the process that is measured imports no more than it needs

    with figure(path, columns=2, size=(4, 3.2)) as ((left, right),):
        counts = [row["returns"] for row in rows]
        for name in ("plan, s", "fit, s", "mesh, s"):
            left.loglog(counts, [row[name] for row in rows], "o-", label=name)
        processor_s = [1e-6 * row["returns"] * row["processor, µs a return"] for row in rows]
        left.loglog(counts, processor_s, "k.--", label="processor, s")
        for name in ("plan, MB", "worker, MB"):
            right.semilogx(counts, [row[name] for row in rows], "o-", label=name)
        right.set_ylim(0)
        for axes in (left, right):
            axes.set_xlabel("returns")
            axes.grid(alpha=0.3)


if __name__ == "__main__":
    print(json.dumps(_measure(int(sys.argv[1]))))
