# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How finding ghosts and counting support grow with the returns: `python bench/growth.py`, on Linux.

Scans of 5,000 returns, a metre apart, along a street with walls 25 m to either side; what meets neither wall nor ground
within 100 m is clutter at 30 to 100 m, and a tenth are ghosts. Each row runs in a process of its own, on two threads.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from radarsdf import FitConfig
from radarsdf.fitting import occupied_leaf_keys
from radarsdf.scans import Rays
from radarsdf.surfels import Surfels, support_of

THREADS = 2
Result = TypeVar("Result")


def street(count: int) -> Rays:
    rng = np.random.default_rng(0)
    scans = np.arange(count, dtype=np.int32) // 5000
    sensors = np.stack([scans - scans.mean(), np.zeros(count), np.full(count, 2.0)], 1)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, count), rng.uniform(-0.06, 0.25, count)
    across = np.cos(elevation) * np.sin(azimuth)
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), across, np.sin(elevation)], 1)
    hit_m = np.minimum(25 / np.abs(across), np.where(elevation < 0, -2 / rays[:, 2], np.inf))
    range_m = np.where(hit_m < 100, hit_m, rng.uniform(30, 100, count))
    range_m *= np.where((rng.random(count) < 0.1) & (hit_m < 70), rng.uniform(1.1, 1.4, count), 1.0)
    range_m += rng.normal(scale=0.05, size=count)
    rays += rng.normal(scale=0.005, size=rays.shape)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = sensors + rays * range_m[:, None]
    return Rays(
        origin=np.zeros(3),
        points=points.astype(np.float32),
        directions=rays.astype(np.float32),
        ranges_m=range_m.astype(np.float32),
        intensities=None,
        scans=scans,
    )


def scans_of(rays: Rays) -> tuple[list[np.ndarray], np.ndarray]:
    """A street's returns (F times (N_i, 3), sensor frame, m), and poses (F, 4, 4), as a fit takes them."""
    poses = np.eye(4)[None].repeat(int(rays.scans[-1]) + 1, 0)
    poses[:, 0, 3] = np.arange(len(poses)) - rays.scans.mean()
    poses[:, 2, 3] = 2.0
    points = np.split(rays.points, np.flatnonzero(np.diff(rays.scans)) + 1)
    return [(p - T[:3, 3]).astype(np.float32) for p, T in zip(points, poses, strict=True)], poses


def memory_mb(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1e3


def measured(function: Callable[[], Result]) -> Result:
    """Prints a table's columns: seconds of processor and of wall, peak of memory over what there was before."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    before_mb, wall_s, processor_s = memory_mb("VmRSS"), time.perf_counter(), time.process_time()
    result = function()
    wall_s, processor_s = time.perf_counter() - wall_s, time.process_time() - processor_s
    print(f" {processor_s:.2f} | {wall_s:.2f} | {memory_mb('VmHWM') - before_mb:.0f} |", end="")
    return result


def row(count: int) -> None:
    rays, config = street(count), FitConfig()
    print(f"| {count:,} |", end="")
    is_ghost = measured(lambda: Surfels.of(rays, THREADS).ghosts(rays, THREADS))
    rays = rays.select(~is_ghost)
    leaf_keys = occupied_leaf_keys(rays, config, THREADS)
    measured(lambda: support_of(rays.points, leaf_keys, config.leaf_size_m, THREADS))
    print(f" {is_ghost.sum():,} | {len(leaf_keys):,} |")


def main() -> None:
    print(
        "| returns | ghosts: processor, s | wall, s | MB | support: processor, s | wall, s | MB | ghosts | leaf cells |"
    )
    print("|" + "---|" * 9, flush=True)
    for count in (10**5, 10**6, 10**7):
        # Without the threshold, memory of the scene that was freed but kept would hide some of the peak.
        environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "1000000"}
        subprocess.run([sys.executable, __file__, str(count)], env=environment, check=True)


if __name__ == "__main__":
    row(int(sys.argv[1])) if len(sys.argv) > 1 else main()
