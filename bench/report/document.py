# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The text of `BENCHMARK.md`: a function of the results, and of nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from . import tables
from .experiments import NAMES, REAL
from .plots import ERROR_OVER_TIME, GROWTH
from .results import Results, Row

DOCUMENT = "BENCHMARK.md"
WORD_LIMIT = 1200

_WORDS = (
    ("F-score", "shares of mesh and of truth within 0.2 m of each other, their harmonic mean; without outliers"),
    ("F-all", "the same with outliers"),
    ("outliers", "share of the mesh more than 0.4 m from the truth"),
    ("MAE", "mean absolute error of the intensity, in scans that the fit did not see"),
    ("time", "from returns in memory to triangles in memory"),
    ("memory", "the most that the process held"),
)  # fmt: skip


def document(results: Results) -> str:
    """The whole text.

    Raises
    ------
    ValueError
        If it has more than `WORD_LIMIT` words, counted as `wc -w` counts them.
    """
    experiments = results["experiments"]
    parts = [_head(results)]
    for name, section in _SECTIONS.items():
        if rows := experiments.get(name, {}).get("rows"):
            parts.append(section(rows, experiments[name]))
    parts += [_missing(experiments), _commands(experiments)]
    text = "\n\n".join(part for part in parts if part) + "\n"
    if (count := len(text.split())) > WORD_LIMIT:
        msg = f"{DOCUMENT} would have {count} words, and may have {WORD_LIMIT}"
        raise ValueError(msg)
    return text


def _head(results: Results) -> str:
    machine = results["machine"]
    parts = (
        machine["processor"], f"{machine['cores']} cores", f"{machine['memory_gb']} GB of memory", machine["system"],
        f"instruction set {machine['instruction_set']}", f"Python {machine['python']}", f"PyTorch {machine['torch']}",
        machine["compiler"],
    )  # fmt: skip
    measured = (
        f"Measured at commit {results['commit']} on {results['date']}, on this machine: {', '.join(parts)}."
    )
    words = "\n".join(f"- **{word}**: {meaning}" for word, meaning in _WORDS)
    warning = (
        "**This was a quick run: its figures mean nothing.**" if results["quick"] else results.get("note", "")
    )
    warning = f"\n\n{tables.wrapped(warning)}" if warning else ""
    return f"""# Benchmarks

<!-- Do not edit: `python -m bench.report write` writes this file from bench/results.json. -->

{tables.wrapped(measured)}
Times are of this machine, and one time may be off by a third.{warning}

Beside this: [the defaults](docs/defaults.md), [what failed](bench/history/failed.md), [the peers](bench/README.md).

{words}"""


def _surface(rows: list[Row], _part: dict[str, Any]) -> str:
    text = (
        "Simulated scenes, whose noise is simpler than that of a real radar. "
        "Shares in %, time in s, memory in MB. The best is in bold."
    )
    if all(row["method"] != "3QFPI" for row in rows):
        text += " 3QFPI, which trains for more than a minute, is in the plot below only."
    parts = ["## Surface", tables.wrapped(text)]
    for scene, own in tables.by_scene(rows).items():
        if any(row.get("f_score") is not None for row in own):
            parts += [f"### `{scene}`, {own[0]['returns']:,} returns", tables.surface(own)]
    return "\n\n".join([*parts, *_reasons(rows)])


def _real(rows: list[Row], _part: dict[str, Any]) -> str:
    ahead, drives = tables.octree_ahead(rows)
    if ahead == drives:
        verdict = f"On all {drives} drives the published octree, SHINE, is still ahead of this package"
    else:
        verdict = f"On {ahead} of {drives} drives the published octree, SHINE, is ahead of this package"
    text = f"{verdict}. F-all, %:"
    return "\n\n".join(
        ["## Surface from a real radar", tables.wrapped(text), tables.real(rows), *_reasons(rows)]
    )


def _intensity(rows: list[Row], _part: dict[str, Any]) -> str:
    text = (
        "MAE, in dB. kNN answers with the intensities of the nearest returns, by settings chosen on the training scans. "
        "The floor is the error of the simulator's intensity without noise."
    )
    return "\n\n".join(["## Intensity", tables.wrapped(text), tables.intensity(rows), *_reasons(rows)])


def _curve(rows: list[Row], _part: dict[str, Any]) -> str:
    text = (
        "A line is one method that trains for 1/16 to 4 times its usual number of iterations. "
        "The error of the surface is what F-all lacks to 100 %."
    )
    picture = f"![Error of the surface and of the intensity over time]({ERROR_OVER_TIME})"
    return "\n\n".join(["## Error over time", tables.wrapped(text), picture, *_reasons(rows)])


def _growth(rows: list[Row], _part: dict[str, Any]) -> str:
    lines = [row for row in rows if row.get("wall_s") is not None]
    if not lines:
        return "\n\n".join(["## Growth", *_reasons(rows)])
    most = max(row["returns"] for row in lines)
    largest = tables.fits([row for row in lines if row["returns"] == most])
    text = f"Fits of a street of {lines[0]['size_m']:,.0f} m. {most:,} returns take {largest}."
    return "\n\n".join(
        ["## Growth", tables.wrapped(text), f"![Time and memory over returns]({GROWTH})", *_reasons(rows)]
    )


def _kernels(rows: list[Row], part: dict[str, Any]) -> str:
    if not (table := tables.kernels(rows)):
        return ""
    text = "Medians on two threads; training steps on one. Interpolation is at 262,144 points."
    left_out = [f"Left out: {'; '.join(part['skipped'])}."] if part.get("skipped") else []
    return "\n\n".join(["## Kernels", tables.wrapped(text), table, *left_out])


def _queries(rows: list[Row], _part: dict[str, Any]) -> str:
    said = [f"- {row['count']:,} {row['what']}: {row['seconds']:.2f} s" for row in rows]
    return "\n\n".join(["## Questions to a map of `hugin`", "\n".join(said)])


_SECTIONS: dict[str, Callable[[list[Row], dict[str, Any]], str]] = {
    "surface": _surface, REAL: _real, "intensity": _intensity, "curve": _curve, "growth": _growth,
    "kernels": _kernels, "queries": _queries,
}  # fmt: skip


def _reasons(rows: list[Row]) -> list[str]:
    """A line for each reason why there is no result, with the methods or sizes that have it."""
    found: dict[str, list[str]] = {}
    for row in rows:
        if row.get("why_not"):
            found.setdefault(row["why_not"], []).append(
                row.get("method", f"{row.get('returns', '?')} returns")
            )
    lines = [f"- {', '.join(dict.fromkeys(names))}: {reason}" for reason, names in found.items()]
    return ["No result:\n\n" + "\n".join(lines)] if lines else []


def _missing(experiments: dict[str, Any]) -> str:
    lines = [
        f"- {name}: {experiments.get(name, {}).get('why_not', 'not run')}"
        for name in NAMES
        if not experiments.get(name, {}).get("rows") or experiments[name].get("why_not")
    ]
    return "\n\n".join(["## Not in this run", "\n".join(lines)]) if lines else ""


def _commands(experiments: dict[str, Any]) -> str:
    lines = [
        "python -m bench.report run --out bench/results.json",
        "python -m bench.report write bench/results.json",
        *(part["command"] for part in experiments.values() if part.get("command")),
    ]
    return "\n\n".join(["## Commands", "```sh\n" + "\n".join(lines) + "\n```"])
