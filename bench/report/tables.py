# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The tables of `BENCHMARK.md`, each from the rows of an experiment."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from statistics import fmean

from bench.paper.report import Column, markdown, metric_table

from .results import Row

_SURFACE: tuple[Column, ...] = (
    ("f_score", "F-score", 100, 1, True),
    ("f_score_all", "F-all", 100, 1, True),
    ("outlier_ratio", "outliers", 100, 1, False),
    ("seconds", "time", 1, 1, False),
    ("peak_bytes", "memory", 1e-6, 0, False),
)
OURS, OCTREE, KNN = "radarsdf", "SHINE (octree)", "kNN"

# What, and the cases of pytest-benchmark that it compares: a word of the group, and words of ours and of the other.
_STEPS = 100  # in each round of the bench of training steps
_COMPARED: tuple[tuple[str, str, tuple[str, ...], str, tuple[str, ...]], ...] = (
    ("interpolation, forward", "interpolation forward, 262144", ("ours",), "bare C++ loop", ("roofline",)),
    (
        "interpolation, forward and backward", "interpolation forward and backward, 262144",
        ("ours",), "`embedding_bag`", ("embedding_bag",),
    ),
    (
        "marching cubes, gyroid, 192³", "marching cubes, 1,415,084",
        ("test_dense", "gyroid192", "2"), "VTK", ("vtk", "gyroid192", "2"),
    ),
    (
        "marching cubes, sphere, 256³", "marching cubes, 392,252",
        ("test_dense", "sphere256", "2"), "VTK", ("vtk", "sphere256", "2"),
    ),
    ("marching cubes, map of `hugin`", "real map", ("test_map_by_cells", "2"), "VTK", ("vtk", "2")),
    *(
        (f"training step, {stage}", f"training step, {stage}", ("test_whole",),
         "matrix products", ("test_matrix_products",))
        for stage in ("geometry", "joint")
    ),
)  # fmt: skip


def by_scene(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each scene, in their order."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["scene"], []).append(row)
    return found


def surface(rows: Sequence[Row]) -> str:
    """Of one scene, a line for each method; the best of a column in bold."""
    return metric_table([row for row in rows if row.get("f_score") is not None], _SURFACE)


def intensity(rows: Sequence[Row]) -> str:
    """A line for each scene: the error of each method, and the floor."""
    scenes = by_scene([row for row in rows if row.get("mae") is not None])
    methods = list(dict.fromkeys(row["method"] for own in scenes.values() for row in own))
    methods.sort(key=lambda method: (method != OURS, method))
    lines = []
    for scene, own in scenes.items():
        means = [_mean([row["mae"] for row in own if row["method"] == method]) for method in methods]
        floor = next((row["noise_floor"] for row in own if row.get("noise_floor") is not None), None)
        lines.append([f"`{scene}`", *means, "–" if floor is None else f"{floor:.2f}"])
    return markdown(["scene", *methods, "floor"], lines)


def real(rows: Sequence[Row]) -> str:
    """A line for each drive: F-all of each method, the best in bold."""
    scenes = by_scene([row for row in rows if row.get("f_score_all") is not None])
    methods = list(dict.fromkeys(row["method"] for own in scenes.values() for row in own))
    lines = []
    for scene, own in scenes.items():
        values = {row["method"]: f"{100 * row['f_score_all']:.1f}" for row in own}
        best = max(values.values(), key=float)
        cells = [values.get(method, "–") for method in methods]
        lines.append([scene, *(f"**{cell}**" if cell == best else cell for cell in cells)])
    return markdown(["drive", *methods], lines)


def octree_ahead(rows: Sequence[Row]) -> tuple[int, int]:
    """On how many drives the published octree has the higher F-all, and how many there are."""
    ahead, drives = 0, 0
    for own in by_scene(rows).values():
        values = {row["method"]: row.get("f_score_all") for row in own}
        octree, ours = values.get(OCTREE), values.get(OURS)
        if octree is not None and ours is not None:
            ahead, drives = ahead + (octree > ours), drives + 1
    return ahead, drives


def kernels(cases: Sequence[Row]) -> str:
    """A line for each comparison of which both sides were measured, then what has no peer; empty without any."""
    lines = []
    for what, group, ours, other, theirs in _COMPARED:
        own, peer = _case(cases, group, ours), _case(cases, group, theirs)
        if own is None:
            continue
        scale = 1000 / _STEPS if what.startswith("training step") else 1000
        times = [two_digits(scale * own), other, "–" if peer is None else two_digits(scale * peer)]
        lines.append([what, *times, "–" if peer is None else f"{peer / own:.1f}"])
    return (
        markdown(["what", "ours, ms", "compared with", "its time, ms", "its time / ours"], lines)
        if lines
        else ""
    )


def fits(rows: Sequence[Row]) -> str:
    """Time and memory of fits of one size, without intensities first."""
    return ", ".join(
        f"{two_digits(row['wall_s'])} s and {row['peak_mb'] / 1000:.1f} GB "
        f"{'with' if row['intensities'] else 'without'} intensities"
        for row in sorted(rows, key=lambda row: bool(row["intensities"]))
    )


def _case(cases: Sequence[Row], group: str, words: Sequence[str]) -> float | None:
    for case in cases:
        parts = case["case"].replace("]", "").replace("[", "-").split("-")
        fits = all(word in parts or (not word.isdigit() and word in case["case"]) for word in words)
        if case["group"].startswith(group) and fits:
            return float(case["seconds"])
    return None


def _mean(values: Sequence[float]) -> str:
    return f"{fmean(values):.2f}" if values else "–"


def two_digits(value: float) -> str:
    """Two digits that mean something, as a time of one run has."""
    if value >= 10:
        return f"{value:.0f}"
    return f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def wrapped(text: str) -> str:
    """A paragraph in lines as long as a page may have."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)
