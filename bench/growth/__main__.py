# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Growth of time and memory: `python -m bench.growth fits|poses|surfels`, on Linux.

Each row runs in its own process. The table is printed row by row, and written with all numbers to
`bench_results/growth_fits.md` and `.json`, or `growth_poses`, `growth_surfels`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from bench.memory import return_freed_memory
from bench.paper.report import ROOT, provenance, write_json
from bench.peers.interface import failure

from . import fits, poses, surfels

PYTHON = [sys.executable]
"""First words of the command of a row."""
TABLES = {"fits": fits, "poses": poses, "surfels": surfels}


def main(arguments: list[str] | None = None) -> None:
    words = _parser().parse_args(arguments)
    if words.row:
        return_freed_memory()
        print(json.dumps(TABLES[words.table].row(**json.loads(words.row)), default=float))
        return
    if words.table == "fits":
        cases = fits.cases(
            quick=words.quick,
            returns=words.returns,
            sizes_m=words.sizes,
            threads=words.threads,
            every=words.every,
        )
    else:
        cases = (poses if words.table == "poses" else surfels).cases(quick=words.quick)
    columns = TABLES[words.table].COLUMNS
    lines = [f"| {' | '.join(heading for _, heading, _ in columns)} |", "|" + "---|" * len(columns)]
    print("\n".join(lines), flush=True)
    rows: list[dict[str, Any]] = []
    made = provenance("bench.growth")
    words.out.mkdir(parents=True, exist_ok=True)
    stem = words.out / f"growth_{words.table}"
    for case in cases:
        rows.append(case | _in_a_process(words.table, case))
        lines.append(line(rows[-1], columns))
        print(lines[-1], flush=True)
        # After each row, so that an interrupted run of hours keeps its rows.
        write_json(stem.with_suffix(".json"), {"table": words.table, **made, "rows": rows})
        stem.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if failed := sum("why_not" in row for row in rows):
        sys.exit(f"{failed} of {len(rows)} rows failed")


def line(row: dict[str, Any], columns: tuple[tuple[str, str, str], ...]) -> str:
    """A row of the table. A dash stands for a missing number, and the reason follows the row."""
    cells = ["–" if row.get(key) is None else _text(row[key], form) for key, _, form in columns]
    return f"| {' | '.join(cells)} |" + (f" {row['why_not']}" if "why_not" in row else "")


def _text(value: Any, form: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:{form}}"


def _in_a_process(table: str, case: dict[str, Any]) -> dict[str, Any]:
    done = subprocess.run(
        [*PYTHON, "-m", "bench.growth", table, "--row", json.dumps(case)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        return {"why_not": failure(done)}
    values: dict[str, Any] = json.loads(done.stdout)
    return values


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.growth", description=__doc__)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument(
        "--out", type=Path, default=Path("bench_results"), help="folder; default: bench_results"
    )
    parser.add_argument("--quick", action="store_true", help="only check that it runs, in some seconds")
    parser.add_argument(
        "--returns",
        type=lambda text: int(float(text)),
        nargs="+",
        default=[],
        help="fits: numbers of returns; default: 1e4 to 1e7",
    )
    parser.add_argument(
        "--sizes",
        type=float,
        nargs="+",
        default=[],
        help="fits: lengths of the street, m; default: 50 500 5000",
    )
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[], help="fits: numbers of threads; default: 1 and 2"
    )
    parser.add_argument(
        "--every",
        action="store_true",
        help="fits: all combinations of size and returns; default: sizes with 1e6 returns, returns at 500 m",
    )
    parser.add_argument("--row", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    main()
