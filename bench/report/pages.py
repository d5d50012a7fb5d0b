# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The figures that pages for users have, between `<!-- measured: NAME -->` and `<!-- end -->`: a function of the results."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from statistics import fmean, median

from bench.paper.report import best_in_bold, markdown

from . import tables
from .experiments import REAL
from .results import Results, Row

_BLOCK = re.compile(r"(<!-- measured: (\S+) -->\n)(.*?)(<!-- end -->\n)", re.DOTALL)
_MARK = re.compile(r"^<!-- (?:measured: \S+|end) -->$", re.MULTILINE)

_SCENE = "hugin"
_FULL, _SURFACE, _QUICK, _PUBLISHED = (
    "radarsdf, intensities, × 1", "radarsdf, × 1", "radarsdf, quick", "3QFPI",
)  # fmt: skip
_COMPARED = {
    _FULL: "radarsdf",
    _QUICK: "radarsdf, `FitConfig.quick()`, surface only",
    "VDBFusion": "VDBFusion, surface only",
    _PUBLISHED: "3QFPI as published",
}


def pages(root: Path) -> dict[Path, str]:
    """The pages below `root` that have such a block, with their text as it is."""
    paths = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    texts = {path: path.read_text(encoding="utf-8") for path in paths if path.is_file()}
    return {path: text for path, text in texts.items() if _MARK.search(text)}


def measured(text: str, results: Results) -> str:
    """The text of a page with the figures of `results` in its blocks.

    Raises
    ------
    ValueError
        If a block has no end or an unknown name, or if the results are of a quick run.
    """
    if 2 * len(_BLOCK.findall(text)) != len(_MARK.findall(text)):
        msg = "a block <!-- measured: … --> has no <!-- end -->, or the other way round"
        raise ValueError(msg)
    if results["quick"]:
        msg = "the figures of a quick run mean nothing: they are not for a page"
        raise ValueError(msg)

    def block(match: re.Match[str]) -> str:
        if match[2] not in _BLOCKS:
            msg = f"nothing is measured as {match[2]}: {', '.join(_BLOCKS)} are"
            raise ValueError(msg)
        return f"{match[1]}{_BLOCKS[match[2]](results)}\n{match[4]}"

    return _BLOCK.sub(block, text)


def outside(text: str) -> str:
    """The text of a page without its blocks; their lines are empty, so that others keep their numbers."""
    return _BLOCK.sub(lambda match: "\n" * match[0].count("\n"), text)


def _comparison(results: Results) -> str:
    """The table of README.md: the methods side by side on one scene, of which every tenth scan was held out."""
    columns = [list(_COMPARED.values())]
    for key, scale, unit, highest in (
        ("f_score_all", 100, "%", True), ("mae", 1, "dB", False), ("seconds", 1, "s", False),
    ):  # fmt: skip
        values = [_of_curve(results, method, key) for method in _COMPARED]
        digits = {"%": "{:.1f}".format, "dB": "{:.2f}".format, "s": tables.two_digits}[unit]
        cells = ["–" if value is None else f"{digits(scale * value)} {unit}" for value in values]
        columns.append(best_in_bold(cells, values, highest=highest))
    header = [f"scene `{_SCENE}`, simulated", "F-score, nothing discarded", "error of intensities", "time"]
    command = results["experiments"].get("curve", {}).get("command", "–")
    text = f"{_where(results)}: `{command}`. Without intensities radarsdf takes {_time(results, _SURFACE)}."
    return markdown(header, list(zip(*columns, strict=True))) + "\n\n" + tables.wrapped(text)


def _drives(results: Results) -> str:
    """What recorded drives say, of the surface and of the intensities."""
    drives = tables.by_scene(_rows(results, REAL, "f_score_all"))
    methods = [{row["method"]: row for row in own} for own in drives.values()]
    both = [own for own in methods if {tables.OURS, tables.OCTREE} <= set(own)]
    if not both:
        return "No recorded drive is in this run."
    ours, theirs = (
        ", ".join(f"{100 * own[method]['f_score_all']:.1f}" for own in both)
        for method in (tables.OURS, tables.OCTREE)
    )
    ahead = sum(own[tables.OURS]["f_score_all"] > own[tables.OCTREE]["f_score_all"] for own in both)
    behind = sum(
        own[tables.OURS]["completion_ratio"] < own[tables.OCTREE]["completion_ratio"] for own in both
    )
    text = (
        f"On recorded drives, F-scores with nothing discarded are {ours} %, and those of the published octree "
        f"(SHINE-Mapping) {theirs} %: radarsdf is ahead on {ahead} of {len(both)}. The octree has the larger share of the "
        f"lidar's surface on {behind} of them."
    )
    intensities = tables.by_scene(_rows(results, "intensity", "mae"))
    ratios = [
        _mean_error(own, tables.OURS) / _mean_error(own, tables.KNN)
        for scene, own in intensities.items()
        if scene in drives
    ]
    if ratios:
        text += (
            f" The error of radarsdf's intensities is {min(ratios):.2f} to {max(ratios):.2f} times that of the nearest "
            "neighbours."
        )
    return tables.wrapped(text)


def _configurations(results: Results) -> str:
    """How long the ready-made configurations take."""
    return tables.wrapped(
        f"Time on `{_SCENE}`, {_where(results)}: the default {_time(results, _SURFACE)}, with intensities "
        f"{_time(results, _FULL)}; `quick()` {_time(results, _QUICK)}; `paper()` {_time(results, _PUBLISHED)}."
    )


def _growth(results: Results) -> str:
    """How much a fit of a million returns takes."""
    returns = 1_000_000
    rows = [row for row in _rows(results, "growth", "wall_s") if row["returns"] == returns]
    if not rows:
        return "The growth is not in this run."
    return tables.wrapped(
        f"A street of {rows[0]['size_m']:,.0f} m with {returns:,} returns takes {tables.fits(rows)} "
        f"({_machine(results)})."
    )


_BLOCKS: dict[str, Callable[[Results], str]] = {
    "comparison": _comparison, "drives": _drives, "configurations": _configurations, "growth": _growth,
}  # fmt: skip


def _rows(results: Results, experiment: str, key: str) -> list[Row]:
    rows = results["experiments"].get(experiment, {}).get("rows", [])
    return [row for row in rows if row.get(key) is not None]


def _of_curve(results: Results, method: str, key: str) -> float | None:
    """Median over the repetitions."""
    rows = _rows(results, "curve", key)
    values = [float(row[key]) for row in rows if row["scene"] == _SCENE and row["method"] == method]
    return median(values) if values else None


def _time(results: Results, method: str) -> str:
    seconds = _of_curve(results, method, "seconds")
    return "–" if seconds is None else f"{tables.two_digits(seconds)} s"


def _where(results: Results) -> str:
    returns = next(
        (row["returns"] for row in _rows(results, "curve", "returns") if row["scene"] == _SCENE), 0
    )
    return f"{returns:,} returns, {_machine(results)}"


def _machine(results: Results) -> str:
    return f"{results['machine']['cores']} cores, commit {results['commit']}"


def _mean_error(rows: list[Row], method: str) -> float:
    return fmean(row["mae"] for row in rows if row["method"] == method)
