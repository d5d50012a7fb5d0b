# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The experiments of `BENCHMARK.md`: a command each, and what is kept of the JSON that the command writes."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.paper.report import ROOT
from bench.peers.interface import PEERS, failure
from bench.timing import timed

from .results import Row

Values = dict[str, Any]

PYTHON = [sys.executable]
"""Begins the commands."""

# 3QFPI trains for more than a minute on each scene: `curve` has it on one, and `--long` on all.
_PEERS = tuple(name for name in PEERS if name != "3QFPI")
_SCENES = ("hugin", "oculii", "wall")
REAL = "real"
_SAMPLES = ("--samples", "1000000")
_KERNELS = tuple(
    f"bench/{file}::{case}"
    for file, cases in (
        ("test_kernels.py", ("test_interpolation_forward", "test_interpolation_forward_and_backward")),
        (
            "test_marching_cubes.py",
            ("test_dense", "test_vtk_flying_edges", "test_map_by_cells", "test_map_vtk_flying_edges"),
        ),
        ("test_training_step.py", ("test_whole", "test_matrix_products")),
    )
    for case in cases
)
_PYTEST = ("pytest", "--benchmark-json={folder}/kernels.json")
_ROW_KEYS = {
    "surface": (
        "scene", "method", "returns", "f_score", "f_score_all", "accuracy_error_m", "outlier_ratio",
        "completion_ratio", "seconds", "peak_bytes", "why_not",
    ),
    "intensity": ("scene", "method", "seed", "mae", "medae", "noise_floor", "why_not"),
    "curve": (
        "scene", "kind", "method", "repetition", "returns", "seconds", "peak_bytes", "f_score", "f_score_all",
        "mae", "noise_floor", "why_not",
    ),
    "growth": (
        "returns", "size_m", "threads", "intensities", "wall_s", "cpu_s", "peak_mb", "leaf_cells", "map_mb",
        "right", "mae", "why_not",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """One command, in three sizes."""

    about: str
    minutes: float
    """On two cores, at its usual size; of the figures that were known when this was written."""
    words: tuple[str, ...]
    """Of the command, after `python -m`; `{folder}` is where it writes, and `{drives}` stands for recorded scans."""
    quick: tuple[str, ...]
    """The same to see that it runs."""
    long: tuple[str, ...]
    """The same with all peers and sizes."""
    file: str
    """The JSON that it writes, in its folder."""
    rows: Callable[[Values], list[Row]]
    """What is kept of that."""


def _kept(name: str) -> Callable[[Values], list[Row]]:
    keys = _ROW_KEYS[name]
    return lambda values: [{key: row[key] for key in keys if key in row} for row in values["rows"]]


def _medians(values: Values) -> list[Row]:
    """The cases of pytest-benchmark."""
    return [
        {"group": case["group"], "case": case["name"], "seconds": case["stats"]["median"]}
        for case in values["benchmarks"]
    ]


def _paper(experiment: str, *words: str, peers: Sequence[str] = ()) -> tuple[str, ...]:
    """An experiment of `bench.paper`; without `peers` it has all of them."""
    named = ("--peers", *peers) if peers else ()
    return ("bench.paper", experiment, *words, *named, "--out", "{folder}")


def _experiments() -> dict[str, Experiment]:
    fits = ("bench.growth", "fits", "--threads", "2", "--out", "{folder}")
    sizes = ("--sizes", "500", "--returns", "1e4", "1e5", "1e6", "1e7")
    once, thrice, quick = ("--repetitions", "1"), ("--repetitions", "3"), ("wall", "--quick")
    two, three = ("VDBFusion", "radarsdf"), ("VDBFusion", "SHINE (octree)", "radarsdf")
    return {
        "surface": Experiment(
            "quality of the surface, beside the peers",
            7,
            _paper("surface", *_SCENES, *_SAMPLES, peers=_PEERS),
            _paper("surface", *quick, peers=two),
            _paper("surface", *_SCENES, *_SAMPLES),
            "surface.json",
            _kept("surface"),
        ),
        "intensity": Experiment(
            "error of the intensity, beside the nearest neighbours",
            4,
            _paper("intensity", *_SCENES, "{drives}", "--base", "default", *thrice),
            _paper("intensity", *quick, "--base", "default", *once),
            _paper("intensity", *_SCENES, "{drives}", *once),
            "intensity.json",
            _kept("intensity"),
        ),
        "curve": Experiment(
            "error over time",
            20,
            _paper("curve", "hugin", *_SAMPLES, *thrice),
            _paper("curve", *quick, *once, peers=two),
            _paper("curve", *_SCENES, *_SAMPLES, *once),
            "curve.json",
            _kept("curve"),
        ),
        "growth": Experiment(
            "time and memory over the number of returns",
            5,
            (*fits, *sizes),
            (*fits, "--quick"),
            (*fits, *sizes),
            "growth_fits.json",
            _kept("growth"),
        ),
        "kernels": Experiment(
            "kernels and training steps",
            2.5,
            (*_PYTEST, *_KERNELS),
            (
                *_PYTEST, _KERNELS[0], "-k", "8192 and ours",
                "--benchmark-max-time=0.1", "--benchmark-min-rounds=1",
            ),
            (*_PYTEST, *_KERNELS),
            "kernels.json",
            _medians,
        ),
        "queries": Experiment(
            "distances and meshes of a map",
            0.5,
            ("bench.report.queries", "--out", "{folder}"),
            ("bench.report.queries", "--quick", "--out", "{folder}"),
            ("bench.report.queries", "--out", "{folder}"),
            "queries.json",
            lambda values: list(values["rows"]),
        ),
        REAL: Experiment(
            "quality of the surface of recorded drives",
            1.5,
            _paper("surface", "{drives}", *_SAMPLES, peers=three),
            _paper("surface", "{drives}", "--quick", peers=two),
            _paper("surface", "{drives}", *_SAMPLES),
            "surface.json",
            _kept("surface"),
        ),
    }  # fmt: skip


EXPERIMENTS = _experiments()
NAMES = tuple(EXPERIMENTS)


def run(name: str, *, size: str, real: Sequence[Path] = ()) -> Values:
    """Run an experiment and return its part of the results. A command that fails becomes a reason, no exception.

    Parameters
    ----------
    name
        One of `NAMES`.
    size
        "quick", "long" or "usual".
    real
        Recorded scans. Without them, `real` cannot run, and `intensity` has simulated scenes only.
    """
    experiment = EXPERIMENTS[name]
    words = {"quick": experiment.quick, "long": experiment.long}.get(size, experiment.words)
    drives = [str(path.resolve()) for path in real]
    words = tuple(part for word in words for part in (drives if word == "{drives}" else [word]))
    return _run(words, experiment.file, experiment.rows)


def _run(words: Sequence[str], file: str, rows: Callable[[Values], list[Row]]) -> Values:
    with tempfile.TemporaryDirectory() as folder:
        command = [*PYTHON, "-m", *(word.replace("{folder}", folder) for word in words)]
        with timed() as taken:
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        found: Values = {"command": _shown(words), "seconds": round(taken.wall_s, 1)}
        path = Path(folder) / file
        if done.returncode != 0:
            found["why_not"] = _plain(failure(done), folder)
        try:
            kept = rows(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, KeyError) as error:
            return {"why_not": _plain(f"{file} was not written: {error!r}", folder)} | found
    found["rows"] = [
        row | {"why_not": _plain(row["why_not"], folder)} if row.get("why_not") else row for row in kept
    ]
    if skipped := sorted(set(_skipped(done.stdout))):
        found["skipped"] = [_plain(reason, folder) for reason in skipped]
    return found


def _skipped(text: str) -> list[str]:
    """Reasons why pytest left cases out, of lines such as `SKIPPED [2] bench/test_x.py:64: vtk is not installed`."""
    lines = [line for line in text.splitlines() if line.startswith("SKIPPED [")]
    return [line.split(": ", 1)[1] if ": " in line else line for line in lines]


def _shown(words: Sequence[str]) -> str:
    """The command as a reader would type it: without the folder, and of files the names only."""
    shown = []
    for word in words:
        if word == "--out" or "{folder}" in word:
            continue
        shown.append(Path(word).name if Path(word).is_absolute() else word)
    return "python -m " + shlex.join(shown)


def _plain(reason: str, folder: str) -> str:
    """A reason without the folders of this machine."""
    for path, name in (
        (folder, "…"), (f"{ROOT}/", ""), (sys.executable, "python"), (sys.prefix, "…"), (str(Path.home()), "~"),
    ):  # fmt: skip
        reason = reason.replace(path, name) if len(path) > 1 else reason
    return reason
