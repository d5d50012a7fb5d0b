# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How long a fitted map takes to answer: `python -m bench.report.queries`. Medians of five, all threads."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import radarsdf

from bench.paper.report import write_json
from bench.timing import timed

_ROUNDS = 5
_COUNT = 1_000_000
_VOXELS_M = (0.1, 0.05)


def rows(*, quick: bool) -> list[dict[str, Any]]:
    """Signed distances near the surface, and meshes, of a map of `hugin`.

    Raises
    ------
    RuntimeError
        Where the answers are not those of a surface: a wrong answer must not look fast.
    """
    scans = radarsdf.simulate.hugin(frames=4) if quick else radarsdf.simulate.hugin()
    radar_map = radarsdf.fit(scans.points, scans.poses, progress=False)
    rng = np.random.default_rng(0)
    world = np.concatenate(
        [
            points @ pose[:3, :3].T + pose[:3, 3]
            for points, pose in zip(scans.points, scans.poses, strict=True)
        ]
    )
    count = _COUNT // 100 if quick else _COUNT
    near = world[rng.integers(len(world), size=count)] + rng.normal(0, 0.1, (count, 3))
    seconds, distances = _timed(lambda: radar_map.sdf(near))
    known = np.isfinite(distances)  # elsewhere nothing was observed
    if not (len(distances) == count and known.mean() > 0.5 and np.median(np.abs(distances[known])) < 1):
        msg = "the distances near the returns are not those of a surface"
        raise RuntimeError(msg)
    found: list[dict[str, Any]] = [{"what": "signed distances", "count": count, "seconds": seconds}]
    for voxel_m in _VOXELS_M[:1] if quick else _VOXELS_M:
        seconds, mesh = _timed(partial(radar_map.mesh, voxel_size=voxel_m))
        if len(mesh.faces) == 0:
            msg = f"the mesh with voxels of {voxel_m} m is empty"
            raise RuntimeError(msg)
        found.append(
            {
                "what": f"vertices of a mesh, voxels of {voxel_m} m",
                "count": len(mesh.vertices),
                "seconds": seconds,
            }
        )
    return found


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Median seconds, and the last answer. One call before them is not counted."""
    call()
    seconds, answer = [], None
    for _ in range(_ROUNDS):
        with timed() as taken:
            answer = call()
        seconds.append(taken.wall_s)
    return median(seconds), answer


def main(arguments: list[str] | None = None) -> None:
    """Write `queries.json`."""
    parser = argparse.ArgumentParser(prog="python -m bench.report.queries", description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("bench_results"), help="folder; default: bench_results"
    )
    parser.add_argument("--quick", action="store_true", help="only see that it runs")
    words = parser.parse_args(arguments)
    words.out.mkdir(parents=True, exist_ok=True)
    write_json(words.out / "queries.json", {"rows": rows(quick=words.quick)})


if __name__ == "__main__":
    main()
