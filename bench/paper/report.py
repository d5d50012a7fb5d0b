# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Results as files: tables in Markdown, numbers in JSON with all that is needed to repeat them, and plots."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from radarsdf import _core
from radarsdf.evaluation.calibration import CALIBRATION_PROTOCOL
from radarsdf.evaluation.intensity import INTENSITY_PROTOCOL
from radarsdf.evaluation.surface import PROTOCOL

ROOT = Path(__file__).resolve().parents[2]


def provenance(module: str = "bench.paper") -> dict[str, Any]:
    """Command, commit, machine and versions."""
    return {
        "command": " ".join([f"python -m {module}", *sys.argv[1:]]),
        "commit": _commit(),
        "protocols": [PROTOCOL, INTENSITY_PROTOCOL, CALIBRATION_PROTOCOL],
        "processor": _processor(),
        "threads": torch.get_num_threads(),
        "instruction_set": _core.instruction_set(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "compiler": _core.compiler(),
    }


def _commit() -> str:
    try:
        git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=10"]
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write `values` as JSON. Arrays become lists, and numbers that are not finite become null."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple, np.ndarray)):
            return [plain(item) for item in value]
        if isinstance(value, (float, np.floating)):
            return float(f"{value:.6g}") if np.isfinite(value) else None
        return value.item() if isinstance(value, np.generic) else value

    path.write_text(json.dumps(plain(values), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with aligned columns."""
    table = [list(header), *(list(row) for row in rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in table
    ]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])


Column = tuple[str, str, float, int, bool | None]
"""Key in the rows, heading, factor to the unit of the heading, digits, and whether the highest or the lowest value is
best: True, False or None (no best)."""


def metric_table(rows: Sequence[dict[str, Any]], columns: Sequence[Column]) -> str:
    """A table with one row for each method and the best value of each column in bold."""
    cells = [[row["method"] for row in rows]]
    for key, _, factor, digits, highest in columns:
        values = [row.get(key) for row in rows]
        texts = ["–" if value is None else f"{value * factor:.{digits}f}" for value in values]
        cells.append(texts if highest is None else best_in_bold(texts, values, highest=highest))
    header = ["method", *(heading for _, heading, *_ in columns)]
    return markdown(header, list(zip(*cells, strict=True)))


def best_in_bold(cells: list[str], values: Sequence[float | None], *, highest: bool) -> list[str]:
    """The cells of a column with the best value in bold, also where several print the same."""
    known = [value for value in values if value is not None]
    if not known:
        return cells
    best = cells[list(values).index(max(known) if highest else min(known))]
    return [
        f"**{cell}**" if cell == best and value is not None else cell
        for cell, value in zip(cells, values, strict=True)
    ]


@contextmanager
def figure(
    path: Path, rows: int = 1, columns: int = 1, size: tuple[float, float] = (5, 3.6)
) -> Iterator[Any]:
    """Axes (rows, columns) of a plot, which is written to `path` at the end of the ``with`` block."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - tables need no matplotlib

    drawing = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    axes = drawing.subplots(rows, columns, squeeze=False)
    yield axes
    for ax in axes.flat:
        if not ax.has_data():
            ax.set_axis_off()
            ax.text(0.5, 0.5, "no results", ha="center")
        elif ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=7)
    drawing.savefig(path, dpi=130)
