# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time and memory of the refinement of poses, of a street that is driven once, and of copies of it one after another."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
import radarsdf.poses.refine  # else the first call would import it, in what is measured
from radarsdf import FitConfig
from radarsdf.poses.rigid import steps, turned_by

from bench.memory import memory_bytes
from bench.paper.broken_poses import walked
from bench.timing import timed

_APART_M = 500.0  # from a copy to the next: they have no returns in common
_WALK = 0.02, 0.1  # m and degrees a step

COLUMNS = (
    ("scans", "scans", ","),
    ("returns", "returns", ","),
    ("threads", "threads", "d"),
    ("wall_s", "wall, s", ".2f"),
    ("cpu_s", "processor, s", ".2f"),
    ("peak_mb", "grown by, MB", ".0f"),
    ("rounds", "rounds", "d"),
    ("given_deg", "a step given, °", ".3f"),
    ("found_deg", "a step refined, °", ".3f"),
)


def cases(*, quick: bool) -> list[dict[str, Any]]:
    """Arguments of `row`."""
    return [{"scans": count, "threads": 2} for count in ((40,) if quick else (120, 1200, 9960))]


def row(scans: int, threads: int) -> dict[str, Any]:
    """Wall time, processor time and growth of the peak memory of `refine_poses`, of poses that drift.

    Raises
    ------
    RuntimeError
        If the poses are not improved, or their steps turn no better than the given ones.
    """
    drive = radarsdf.simulate.hugin(seed=1)
    copies = -(-scans // len(drive.poses))
    points = (drive.points * copies)[:scans]
    true = np.tile(drive.poses, (copies, 1, 1))[:scans]
    true[:, 0, 3] += _APART_M * (np.arange(scans) // len(drive.poses))
    given, config = walked(true, *_WALK, 0), FitConfig(num_threads=threads)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    before = memory_bytes("VmRSS")
    with timed() as taken:
        refined = radarsdf.refine_poses(points, given, config=config)
    found = {
        **asdict(taken),
        "peak_mb": (memory_bytes("VmHWM") - before) / 1e6,
    }
    errors_deg = [
        float(np.degrees(np.sqrt((turned_by(steps(true), steps(poses)) ** 2).mean())))
        for poses in (given, refined.poses)
    ]
    if not refined.improved or errors_deg[1] >= errors_deg[0]:
        msg = f"steps turn by {errors_deg[1]:.3f} and not {errors_deg[0]:.3f}°: {refined.report['verdict']}"
        raise RuntimeError(msg)
    return found | {
        "returns": sum(map(len, points)),
        "rounds": refined.report["rounds"],
        "given_deg": errors_deg[0],
        "found_deg": errors_deg[1],
    }
