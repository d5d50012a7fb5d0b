# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rows of a measurement: printed as they come, and kept with what is needed to repeat them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.paper.report import provenance, write_json


def kept(rows: Iterable[dict[str, Any]], module: str, path: Path) -> list[dict[str, Any]]:
    """The rows, printed as a Markdown table and written to a JSON file. Their keys are the headings of the columns.

    The file is written after each row, so that an interrupted run of hours keeps its rows.
    """
    made = provenance(module)
    found: list[dict[str, Any]] = []
    for row in rows:
        if not found:
            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
        print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)
        found.append(row)
        write_json(path, made | {"rows": found})
    return found


def quantile(values: list[float] | NDArray[np.float64], share: float) -> float:
    """The value below which this share of all is, for a row."""
    return round(float(np.quantile(values, share)), 2)
