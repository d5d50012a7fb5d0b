# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Estimate of the time of a fit: the amount of each kind of work, and the time measured for each."""

from __future__ import annotations

import os

from radarsdf.budget.schedule import Schedule, seen_jointly
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.widths import intensity_widths, sdf_widths, weights_of

# Seconds on one thread, measured on the machine that BENCHMARK.md names: `python -m bench.estimates durations`
# measures fits and prints them. The estimates of twenty fits were 0.65 to 1.24 times their processor time.
SECONDS = {
    "return": 1.7e-06,
    "cell": 9.4e-07,
    "moved row": 7.5e-09,
    "iteration": 9.3e-4,
    "encoded number": 2.2e-9,
    "multiplication": 2.6e-11,
}
_SHARED = ("encoded number", "multiplication")  # done by all threads; one thread does the other kinds


def work_of(
    config: FitConfig, schedule: Schedule, *, returns: int, cells: int, rows: int, with_intensity: bool
) -> dict[str, float]:
    """Amount of each kind of work in :data:`SECONDS` for a fit, all threads together.

    `returns`, `cells`, `rows`: numbers of returns, leaf cells and rows of features.
    """
    training, normals = config.training, config.networks.normals
    iterations = schedule.sdf_iterations
    joint = iterations if with_intensity and training.joint else 0
    later = max(0, schedule.intensity_iterations - joint)
    of_both = seen_jointly(config, schedule.batch_size)
    # Units: a forward pass of a sample. Forward and backward take 3. Normals take a backward pass of their
    # own, and their gradient two more: 9 in all, or 3 if the field is frozen.
    passes, frozen_passes = (9, 3) if normals and with_intensity else (3, 1)
    evaluations = passes * iterations * schedule.batch_size
    evaluations += frozen_passes * later * schedule.intensity_batch_size
    sdf, intensity = weights_of(sdf_widths(config)), weights_of(intensity_widths(config))
    multiplied = sdf * evaluations + intensity * 3 * (joint * of_both + later * schedule.intensity_batch_size)
    return {
        "return": float(returns),
        "cell": float(cells),
        "moved row": float(rows * iterations * (not config.moves_rows(with_intensity))),
        "iteration": float(iterations + later),
        "encoded number": float(sdf_widths(config)[0] * evaluations),
        "multiplication": float(multiplied),
    }


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shared(work: dict[str, float], threads: int) -> dict[str, float]:
    """The amounts of `work` for one of so many threads. More threads than processors do not help."""
    threads = min(threads, processors())
    return {kind: amount / (threads if kind in _SHARED else 1) for kind, amount in work.items()}
