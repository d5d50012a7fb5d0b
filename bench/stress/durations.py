# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time of fits against their estimates, and the constants of the estimate calibrated on this machine."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import radarsdf
from radarsdf import FitConfig
from radarsdf.config.fit_config import flat_settings
from radarsdf.fitting import estimate as durations
from radarsdf.fitting.schedule import Schedule
from scipy.optimize import nnls

from bench.growth.street import street
from bench.paper.report import markdown
from bench.settings import PRESETS, Changes, merged
from bench.timing import timed

WITHIN = 2.0
SHORT: Changes = {"training": {"sdf_iterations": 100, "intensity_iterations": 300}}
CASES: list[tuple[int, bool, str, Changes]] = [
    (10_000, True, "default", {}),
    (30_000, False, "default", {}),
    (30_000, True, "default", {"num_threads": 1}),
    (30_000, True, "default", {"training": {"joint": False}}),
    (30_000, True, "default", SHORT | {"encoding": {"kind": "octree"}}),
    (
        30_000,
        True,
        "default",
        SHORT | {"networks": {"intensity_hidden": (128, 128, 128)}},
    ),
    (30_000, True, "default", SHORT | {"encoding": {"num_levels": 6, "fourier_count": 16}}),
    (
        30_000,
        True,
        "default",
        merged(SHORT, {"training": {"batch_size": 32768, "intensity_batch_size": 32768}}),
    ),
    (10_000, True, "paper", SHORT),
    (100_000, False, "paper", SHORT | {"num_threads": 1}),
    (100_000, True, "default", {}),
    (100_000, False, "default", {"num_threads": 1}),
    (100_000, False, "quick", {}),
    (300_000, False, "default", {"training": {"sdf_iterations": 300}}),
    (300_000, False, "default", {"training": {"sdf_iterations": 50, "row_updates": False}}),
    (300_000, False, "quick", {"num_threads": 1}),
    (1_000_000, False, "quick", {}),
    (1_000_000, False, "default", {"training": {"sdf_iterations": 100}, "returns": {"drop_ghosts": False}}),
    (1_000_000, True, "default", SHORT),
    (1_000_000, False, "default", {"training": {"sdf_iterations": 20}, "leaf_size_m": 0.8, "num_threads": 1}),
]
"""Number of returns, with intensities or without, preset, settings."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Estimated and measured time of a fit."""

    estimated_s: float
    work: dict[str, float]
    """Amounts of work, as of `durations.work_of`."""
    wall_s: float
    processor_s: float
    """Processor time of all threads. Other processes hardly change it."""


def measured(count: int, with_intensities: bool, preset: str, changes: Changes, repetitions: int) -> Fit:
    """The shortest times of `repetitions` fits, each in its own process."""
    case = json.dumps([count, with_intensities, preset, changes])
    command = [sys.executable, "-m", "bench.stress.durations", case]
    fits = []
    for _ in range(repetitions):
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        fits.append(Fit(**json.loads(done.stdout)))
    least_s = min(fit.processor_s for fit in fits)
    return dataclasses.replace(min(fits, key=lambda fit: fit.wall_s), processor_s=least_s)


def _measure(count: int, with_intensities: bool, preset: str, changes: Changes) -> None:
    scene = street(count)
    returns = (scene.points, scene.poses, scene.intensities if with_intensities else None)
    config = PRESETS[preset].override(**changes)
    estimate = radarsdf.estimate(*returns, config=config)
    schedule = Schedule.of(
        config,
        surface_returns=estimate.returns,
        returns=estimate.returns,
        vertices=estimate.vertices,
        with_intensity=with_intensities,
    )
    work = durations.work_of(
        config,
        schedule,
        returns=estimate.returns,
        cells=estimate.leaf_cells,
        rows=estimate.vertices,
        with_intensity=with_intensities,
    )
    # A small fit first: the estimate does not include what PyTorch sets up in its first steps.
    small, tiny = (
        street(2000),
        FitConfig().override(training={"sdf_iterations": 5, "intensity_iterations": 10}),
    )
    radarsdf.fit(small.points, small.poses, small.intensities, config=tiny, progress=False)
    with timed() as taken:
        radarsdf.fit(*returns, config=config, progress=False)
    print(json.dumps(dataclasses.asdict(Fit(estimate.seconds, work, taken.wall_s, taken.cpu_s))))


def constants(fits: list[Fit]) -> dict[str, float]:
    """Seconds per unit of each kind of work, by non-negative least squares of the relative errors."""
    kinds = list(durations.SECONDS)
    shares = np.array([[fit.work[kind] / fit.processor_s for kind in kinds] for fit in fits])
    scale = shares.max(axis=0).clip(1e-30)
    found, _ = nnls(shares / scale, np.ones(len(shares)))
    return dict(zip(kinds, (found / scale).tolist(), strict=True))


def run(largest: int, repetitions: int) -> bool:
    """Print the table and the calibrated constants. True if all estimates are within the factor `WITHIN`."""
    cases = [case for case in CASES if case[0] <= largest]
    fits = []
    for case in cases:
        fits.append(measured(*case, repetitions))
        print(f"{case}: {fits[-1].wall_s:.1f} s", flush=True)
    anew = constants(fits)
    rows, good = [], True
    for (count, with_intensities, preset, changes), fit in zip(cases, fits, strict=True):
        settings = ", ".join([preset, *(f"{k} {v}" for k, v in flat_settings(changes).items())])
        estimated_s, anew_s = (
            sum(seconds[kind] * fit.work[kind] for kind in seconds) for seconds in (durations.SECONDS, anew)
        )
        ratios = [fit.estimated_s / fit.wall_s, estimated_s / fit.processor_s]
        good &= all(1 / WITHIN < ratio < WITHIN for ratio in ratios)
        rows.append(
            [f"{count:,}", "yes" if with_intensities else "no", settings, f"{fit.wall_s:.2f}"]
            + [f"{fit.estimated_s:.2f}", f"{ratios[0]:.2f}", f"{fit.processor_s:.2f}", f"{ratios[1]:.2f}"]
            + [f"{anew_s / fit.processor_s:.2f}"]
        )
    columns = [
        "returns",
        "intensities",
        "settings",
        "fit, s",
        "estimate, s",
        "ratio",
        "processor, s",
        "ratio",
    ]
    print(markdown([*columns, "calibrated"], rows))
    print("calibrated:\n\nSECONDS = {")
    for kind, value in anew.items():
        print(f'    "{kind}": {value:.2g},')
    print("}")
    return good


if __name__ == "__main__":
    _measure(*json.loads(sys.argv[1]))
