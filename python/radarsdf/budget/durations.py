# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How long a fit takes: how much there is of each kind of work, and what that took where it was measured."""

from __future__ import annotations

import os

from radarsdf.budget.schedule import Schedule
from radarsdf.config import FitConfig
from radarsdf.field.widths import intensity_widths, sdf_widths, weights_of

# `python -m bench.stress durations` measures fits and prints these anew. Seconds of one thread of the machine of
# BENCHMARK.md. What they say of twenty fits is 0.58 to 1.25 times their processor time.
SECONDS = {
    "return": 3.1e-06,
    "cell": 4.1e-07,
    "moved row": 4.3e-09,
    "iteration": 5.5e-4,
    "encoded number": 3.2e-9,
    "multiplication": 2.7e-11,
}
_SHARED = ("encoded number", "multiplication")  # by all threads; the other kinds of work are done by one


def work_of(
    config: FitConfig, schedule: Schedule, *, returns: int, cells: int, rows: int, with_intensity: bool
) -> dict[str, float]:
    """How often a fit does each of the things that :data:`SECONDS` has, all threads together."""
    sampling, training, normals = config.sampling, config.training, config.networks.normals
    iterations = schedule.sdf_iterations
    joint = iterations if with_intensity and training.joint else 0
    later = max(0, schedule.intensity_iterations - joint)
    near_share = sampling.near_samples / (sampling.near_samples + sampling.free_samples)
    of_both = schedule.batch_size * (1 if training.intensity_in_free_space else near_share)
    # Forward and backward is three times forward alone, a normal is a backward pass, and its own gradient two more.
    passes, of_frozen = (9, 3) if normals and with_intensity else (3, 1)
    ways = passes * iterations * schedule.batch_size + of_frozen * later * training.intensity_batch_size
    sdf, intensity = weights_of(sdf_widths(config)), weights_of(intensity_widths(config))
    multiplied = sdf * ways + intensity * 3 * (joint * of_both + later * training.intensity_batch_size)
    return {
        "return": float(returns),
        "cell": float(cells),
        "moved row": float(rows * iterations * (not config.moves_rows(with_intensity))),
        "iteration": float(iterations + later),
        "encoded number": float(sdf_widths(config)[0] * ways),
        "multiplication": float(multiplied),
    }


def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shared(work: dict[str, float], threads: int) -> dict[str, float]:
    """The same work where so many threads share what can be shared, as far as there are processors for them."""
    threads = min(threads, processors())
    return {kind: amount / (threads if kind in _SHARED else 1) for kind, amount in work.items()}
