# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One reconstruction in a process of its own: `python -m bench.peers.child METHOD OPTIONS SCANS RESULT`.

METHOD is `module:function` of this package, OPTIONS its keywords as JSON, SCANS and RESULT are .npz files. A process of
its own gives each method a fresh peak of memory, its own Python where it needs one, and nobody else's crash. Needs NumPy
and what the method needs, so that it runs where radarsdf does not.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class ScanArrays:
    """All returns of some scans."""

    points: np.ndarray  # (N, 3) float32, sensor frame, m
    frame: np.ndarray  # (N,) row of `poses`
    poses: np.ndarray  # (F, 4, 4) float64, T_world_sensor
    intensities: np.ndarray | None  # (N,) sensor units

    def world(self) -> np.ndarray:
        """(N, 3) float64, world, m."""
        T = self.poses[self.frame]
        return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], self.points.astype(np.float64)) + T[:, :3, 3])

    def sensors(self) -> np.ndarray:
        """(N, 3) float64, where each return was seen from, world, m."""
        return self.poses[self.frame, :3, 3]


def _peak_bytes() -> int:
    """Largest resident memory so far, or -1. Not ru_maxrss: a child starts with its parent's."""
    status = Path("/proc/self/status")
    if not status.exists():
        return -1
    (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
    return 1024 * int(line.split()[1])


def main() -> None:
    method, options, scans_path, result_path = sys.argv[1:]
    module, function = method.split(":")
    reconstruct = getattr(importlib.import_module(f"bench.peers.{module}"), function)
    with np.load(scans_path) as file:
        scans = ScanArrays(
            file["points"],
            file["frame"],
            file["poses"],
            file.get("intensities"),
        )
    started = time.perf_counter()
    vertices, faces, map_bytes = reconstruct(scans, **json.loads(options))
    seconds = time.perf_counter() - started
    np.savez(
        result_path,
        vertices=np.asarray(vertices, np.float64).reshape(-1, 3),
        faces=np.asarray(faces, np.int64).reshape(-1, 3),
        seconds=seconds,
        map_bytes=-1 if map_bytes is None else map_bytes,
        peak_bytes=_peak_bytes(),
    )


if __name__ == "__main__":
    main()
