# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The parts of the method that a fit does not run, and the time that this saves."""

from __future__ import annotations

import math
from dataclasses import dataclass

from radarsdf.budget.durations import SECONDS, shared, work_of
from radarsdf.budget.schedule import Schedule
from radarsdf.config.fit_config import FitConfig


@dataclass(frozen=True)
class Skipped:
    """A part that a fit does not run."""

    words: str
    """What it is, and why it is left out."""
    seconds: float | None
    """None: unknown. About how much longer the fit would take with it, by the durations of :func:`radarsdf.estimate`."""


def skipped_parts(
    config: FitConfig,
    schedule: Schedule,
    *,
    returns: int,
    cells: int,
    rows: int,
    with_intensity: bool,
    threads: int,
    closed_form: bool = False,
) -> list[Skipped]:
    """All of them, for a fit of so many `returns`, leaf `cells` and `rows` of features.

    `closed_form`: there are intensities, but no network.
    """

    def seconds(config: FitConfig, schedule: Schedule, with_intensity: bool) -> float:
        work = work_of(
            config, schedule, returns=returns, cells=cells, rows=rows, with_intensity=with_intensity
        )
        return sum(SECONDS[kind] * amount for kind, amount in shared(work, threads).items())

    def scheduled(config: FitConfig, with_intensity: bool) -> Schedule:
        return Schedule.of(
            config, surface_returns=returns, returns=returns, vertices=rows, with_intensity=with_intensity
        )

    ours_s = seconds(config, schedule, with_intensity)
    skipped = []
    if not with_intensity:
        why = "intensities are in closed form" if closed_form else "there are no intensities"
        words = f"the intensity network: {why}"
        skipped.append(Skipped(words, seconds(config, scheduled(config, True), True) - ours_s))
    else:
        published = FitConfig.paper().networks
        for name, setting in (("normals", "normals"), ("geometry feature", "geometry_feature_dim")):
            if not getattr(config.networks, setting):
                used = config.override(networks={setting: getattr(published, setting)})
                words = f"the {name}, which the intensity network does not use"
                skipped.append(Skipped(words, seconds(used, schedule, with_intensity) - ours_s))
    if schedule.passes < 1 and config.training.sdf_iterations is None:
        why = "the others were enough" if config.effort >= 1 else f"effort is {config.effort:g}"
        whole = math.ceil(schedule.sdf_iterations / schedule.passes)
        used = config.override(training={"sdf_iterations": whole})
        words = f"{1 - schedule.passes:.0%} of the samples: {why}"
        skipped.append(
            Skipped(words, seconds(used, scheduled(used, with_intensity), with_intensity) - ours_s)
        )
    if config.moves_rows(with_intensity) and schedule.sdf_iterations > 0:
        words = "in each iteration, updates of features that its samples did not use"
        skipped.append(Skipped(words, SECONDS["moved row"] * rows * schedule.sdf_iterations))
    return skipped
