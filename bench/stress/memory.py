# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Memory of fits against their estimates, and over many fits in one process. On Linux."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
import radarsdf.fitting.fit  # else the first fit would import it, in what is measured
from radarsdf import Estimate, FitConfig
from radarsdf.config.fit_config import flat_settings

from bench.growth.street import street
from bench.memory import memory_bytes, return_freed_memory
from bench.paper.report import markdown
from bench.settings import Changes, merged

CASES: list[tuple[int, bool, Changes]] = [
    (10_000, True, {}),
    (100_000, False, {}),
    (100_000, True, {}),
    (100_000, True, {"training": {"batch_size": 65536, "intensity_batch_size": 65536}}),
    (300_000, True, {"encoding": {"kind": "octree"}}),
    (1_000_000, True, {"returns": {"drop_ghosts": False}, "leaf_size_m": 0.8}),
    (1_000_000, True, {}),
    (3_000_000, False, {}),
    (3_000_000, True, {}),
]
"""Returns, whether with intensities, settings."""
WITHIN = 2.0
MAX_GROWTH_MB = 8.0  # from a tenth of the fits to the last
SHORT: Changes = {"training": {"sdf_iterations": 20, "intensity_iterations": 24, "batch_size": 16384}}
"""Enough iterations for the peak: pages of zeros take no memory until the training writes to them."""


def _street(count: int, with_intensities: bool) -> tuple[Any, Any, Any]:
    scans = street(count)
    return scans.points, scans.poses, scans.intensities if with_intensities else None


def peak_of_a_fit(
    count: int, with_intensities: bool, changes: Changes, python: Sequence[str] = (sys.executable,)
) -> tuple[Estimate, float]:
    """The estimate, and the measured growth of the peak memory, bytes, in a new process, whose command begins with `python`."""
    case = json.dumps([count, with_intensities, merged(SHORT, changes)])
    command = [*python, "-m", "bench.stress.memory", case]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    values, peak = json.loads(done.stdout)
    return Estimate(**values), peak


def _measure(count: int, with_intensities: bool, changes: Changes) -> None:
    return_freed_memory()
    scans, config = _street(count, with_intensities), FitConfig().override(**changes)
    estimate = radarsdf.estimate(*scans, config=config)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    before = memory_bytes("VmRSS")
    radarsdf.fit(*scans, config=config, progress=False)
    print(json.dumps([vars(estimate), memory_bytes("VmHWM") - before]))


def memory_of_fits(count: int) -> list[float]:
    """Resident memory of this process, MB, after each of `count` small fits with a query and a mesh."""
    scans, config = (
        _street(2000, True),
        FitConfig().override(training={"sdf_iterations": 6, "intensity_iterations": 12, "batch_size": 1024}),
    )
    found = []
    for _ in range(count):
        radar_map = radarsdf.fit(*scans, config=config, progress=False)
        radar_map.sdf(np.zeros((10_000, 3)))
        radar_map.mesh(0.2, progress=False)
        found.append(memory_bytes("VmRSS") / 1e6)
    return found


def run(largest: int, fits: int) -> bool:
    """Print the two tables. True if all estimates are within the factor `WITHIN`, and no fit leaks memory."""
    rows, good = [], True
    for count, with_intensities, changes in CASES:
        if count <= largest:
            estimate, peak = peak_of_a_fit(count, with_intensities, changes)
            good &= 1 / WITHIN < estimate.peak_memory_bytes / peak < WITHIN
            settings = ", ".join(f"{k} {v}" for k, v in flat_settings(changes).items()) or "default"
            rows.append(
                [f"{count:,}", "yes" if with_intensities else "no", settings, f"{estimate.leaf_cells:,}"]
                + [f"{peak / 1e6:.0f}", f"{estimate.peak_memory_bytes / 1e6:.0f}"]
                + [f"{estimate.peak_memory_bytes / peak:.2f}"]
            )
    columns = [
        "returns",
        "intensities",
        "settings",
        "leaf cells, estimated",
        "peak, MB",
        "estimate, MB",
        "ratio",
    ]
    print(markdown(columns, rows))
    found = memory_of_fits(fits)
    after = sorted({1, 2, max(1, fits // 10), max(1, fits // 2), fits})
    print(markdown(["fits in a row", "MB"], [[str(n), f"{found[n - 1]:.1f}"] for n in after]))
    return good and found[-1] - max(found[: max(1, fits // 10)]) < MAX_GROWTH_MB


if __name__ == "__main__":
    _measure(*json.loads(sys.argv[1]))
