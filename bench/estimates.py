"""Memory and time of fits compared with their estimates: `python -m bench.estimates memory|durations`, on Linux."""

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
import radarsdf
import radarsdf.fitting.fit  # else the first fit would import it, in what is measured
from radarsdf import Estimate, FitConfig

from bench.growth.street import street
from bench.measure import in_new_process, measured, memory_bytes, timed
from bench.runner import Column, Experiment, Row, main
from scenes.settings import PRESETS, Changes, merged, words_of

MEMORY_CASES: list[tuple[int, bool, Changes]] = [
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
"""Number of returns, whether with intensities, settings."""
_FEW: Changes = {"training": {"sdf_iterations": 20, "intensity_iterations": 24, "batch_size": 16384}}
"""Enough iterations to reach the peak: pages of zeros take no memory until the training writes to them."""


def _street(count: int, with_intensities: bool) -> tuple[Any, Any, Any]:
    scans = street(count)
    return scans.points, scans.poses, scans.intensities if with_intensities else None


def memory(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per case: growth of the peak memory, and its estimate."""
    for count, with_intensities, changes in MEMORY_CASES[: 1 if options.quick else None]:
        estimate, peak = peak_of_a_fit(count, with_intensities, changes)
        row: Row = {"returns": count, "intensities": with_intensities, "settings": words_of(changes)}
        row |= {"measured": peak / 1e6, "estimated": estimate.peak_memory_bytes / 1e6}
        yield row | {"ratio": estimate.peak_memory_bytes / peak}


def peak_of_a_fit(count: int, with_intensities: bool, changes: Changes) -> tuple[Estimate, float]:
    """Estimate, and measured growth of the peak memory, bytes, in a new process."""
    case = count, with_intensities, merged(_FEW, changes)
    values, peak = in_new_process("bench.estimates:measured_peak", *case)
    return Estimate(**values), peak


def measured_peak(count: int, with_intensities: bool, changes: Changes) -> tuple[dict[str, Any], float]:
    """Fields of the estimate, and growth of the peak memory of this process, bytes."""
    scans, config = _street(count, with_intensities), FitConfig().override(**changes)
    estimate = radarsdf.estimate(*scans, config=config)
    with measured() as taken:
        radarsdf.fit(*scans, config=config, progress=False)
    return vars(estimate), 1e6 * taken.grown_mb


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


_SHORT: Changes = {"training": {"sdf_iterations": 100, "intensity_iterations": 300}}
_WIDE: Changes = {"networks": {"intensity_hidden": (128, 128, 128)}}
_LARGE: Changes = {"training": {"batch_size": 32768, "intensity_batch_size": 32768}}
DURATION_CASES: list[tuple[int, bool, str, Changes]] = [
    (10_000, True, "default", {}),
    (30_000, False, "default", {}),
    (30_000, True, "default", {"num_threads": 1}),
    (30_000, True, "default", _SHORT | {"encoding": {"kind": "octree"}}),
    (30_000, True, "default", _SHORT | _WIDE),
    (30_000, True, "default", _SHORT | {"encoding": {"fourier_count": 16}}),
    (30_000, True, "default", merged(_SHORT, _LARGE)),
    (10_000, True, "paper", _SHORT),
    (100_000, False, "paper", _SHORT | {"num_threads": 1}),
    (100_000, True, "default", {}),
    (100_000, False, "default", {"num_threads": 1}),
    (100_000, False, "quick", {}),
    (300_000, False, "default", {"training": {"sdf_iterations": 300}}),
    (300_000, False, "default", {"training": {"sdf_iterations": 50, "optimiser": "adam"}}),
    (300_000, False, "quick", {"num_threads": 1}),
    (1_000_000, False, "quick", {}),
    (1_000_000, False, "default", {"training": {"sdf_iterations": 100}, "returns": {"drop_ghosts": False}}),
    (1_000_000, True, "default", _SHORT),
    (1_000_000, False, "default", {"training": {"sdf_iterations": 20}, "leaf_size_m": 0.8, "num_threads": 1}),
]
"""Number of returns, with intensities or without, preset, settings."""


def durations(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per case: time of a fit, and its estimate."""
    for count, with_intensities, preset, changes in DURATION_CASES[: 1 if options.quick else None]:
        fits = [
            in_new_process("bench.estimates:measured_duration", count, with_intensities, preset, changes)
            for _ in range(options.repetitions)
        ]
        estimated_s, wall_s = fits[0]["estimated_s"], min(fit["wall_s"] for fit in fits)
        row: Row = {"returns": count, "intensities": with_intensities}
        row |= {"settings": f"{preset} {words_of(changes)}", "measured": wall_s, "estimated": estimated_s}
        yield row | {"ratio": estimated_s / wall_s}


def measured_duration(count: int, with_intensities: bool, preset: str, changes: Changes) -> Row:
    """Estimated and measured time of a fit."""
    returns, config = _street(count, with_intensities), PRESETS[preset].override(**changes)
    estimate = radarsdf.estimate(*returns, config=config)
    # Warm up with a small fit: the estimate does not include PyTorch's initialisation in its first steps.
    tiny = FitConfig().override(training={"sdf_iterations": 5, "intensity_iterations": 10})
    radarsdf.fit(*_street(2000, True), config=tiny, progress=False)
    with timed() as taken:
        radarsdf.fit(*returns, config=config, progress=False)
    return {"estimated_s": estimate.seconds, "wall_s": taken.wall_s}


_LINES = ("returns", "intensities", "settings")
_RATIO = {"ratio": Column("estimated / measured")}

EXPERIMENTS = {
    "memory": Experiment(
        "Memory of fits",
        memory,
        columns={"measured": Column("MB", digits=0), "estimated": Column("estimated, MB", digits=0)} | _RATIO,
        lines=_LINES,
    ),
    "durations": Experiment(
        "Time of fits",
        durations,
        options=("repetitions",),
        defaults={"repetitions": 2},
        columns={"measured": Column("s"), "estimated": Column("estimated, s")} | _RATIO,
        lines=_LINES,
    ),
}

if __name__ == "__main__":
    main("bench.estimates", EXPERIMENTS)
