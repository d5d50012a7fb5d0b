# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How long a fit takes: how much there is of each kind of work, and what that took where it was measured."""

from __future__ import annotations

import itertools
import os

from radarsdf.budget.schedule import Schedule
from radarsdf.config import FitConfig
from radarsdf.field.kernels import FEATURE_DIM

# `python -m bench.stress durations` measures fits and prints these anew. Seconds of one thread of BENCHMARK.md's machine;
# what they say of twenty fits is 0.58 to 1.25 times their processor time. A 0 is what the others account for.
SECONDS = {
    "always": 0.0,
    "return": 3.1e-06,
    "ghost": 0.0,
    "averaged return": 0.0,
    "cell": 4.1e-07,
    "row": 0.0,
    "moved row": 4.3e-09,
    "iteration": 5.5e-4,
    "encoded number": 3.2e-9,
    "multiplication": 2.7e-11,
}


def work_of(
    config: FitConfig, schedule: Schedule, *, returns: int, cells: int, rows: int, with_intensity: bool
) -> dict[str, float]:
    """How often a fit does each of the things that :data:`SECONDS` has, all threads together."""
    iterations = schedule.sdf_iterations
    joint = iterations if with_intensity and config.joint else 0
    later = max(0, schedule.intensity_iterations - joint)
    encoding, sdf, intensity = widths(config)
    samples = config.near_samples + config.free_samples
    of_both = schedule.batch_size * (1 if config.intensity_in_free_space else config.near_samples / samples)
    # Forward and backward is three times forward alone, a normal is a backward pass, and its own gradient two more.
    passes, of_frozen = (9, 3) if config.normals and with_intensity else (3, 1)
    ways = passes * iterations * schedule.batch_size + of_frozen * later * config.intensity_batch_size
    multiplied = sdf * ways + intensity * 3 * (joint * of_both + later * config.intensity_batch_size)
    all_rows_move = not config.row_updates or (config.normals and joint > 0)
    return {
        "always": 1.0,
        "return": float(returns),
        "ghost": float(returns * config.drop_ghosts),
        "averaged return": float(returns * (config.start == "average")),
        "cell": float(cells),
        "row": float(rows),
        "moved row": float(rows * iterations * all_rows_move),
        "iteration": float(iterations + later),
        "encoded number": float(encoding * ways),
        "multiplication": float(multiplied),
    }


_SHARED = ("ghost", "averaged return", "encoded number", "multiplication")


def processors() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shared(work: dict[str, float], threads: int) -> dict[str, float]:
    """The same work where so many threads share what can be shared, as far as there are processors for them."""
    threads = min(threads, processors())
    return {kind: amount / (threads if kind in _SHARED else 1) for kind, amount in work.items()}


def widths(config: FitConfig) -> tuple[int, int, int]:
    """Numbers of a point's encoding, and multiplications of the two networks for it."""
    encoding = FEATURE_DIM * (config.num_levels if config.encoding == "tri-quadtree" else 1)
    encoding += 6 * config.fourier_count
    sdf = (encoding, *config.sdf_hidden, 1 + config.geometry_feature_dim)
    intensity = (encoding + 21 + config.geometry_feature_dim, *config.intensity_hidden, 1)
    products = [sum(a * b for a, b in itertools.pairwise(layers)) for layers in (sdf, intensity)]
    return encoding, products[0], products[1]
