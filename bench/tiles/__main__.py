# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What of `bench.tiles` is measured, as tables and a plot."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from bench.tiles import growth, kills, seams

_COMMANDS = {"seams": seams, "growth": growth, "kills": kills}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.tiles", description=__doc__)
    parser.add_argument("what", choices=_COMMANDS)
    parser.add_argument(
        "cases", nargs="*", help="scenes of seams, numbers of returns of growth; default: all"
    )
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    module = _COMMANDS[options.what]
    rows: list[dict[str, Any]] = []
    for row in module.rows(options.cases, options.quick, options.out):
        if not rows:
            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
        print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)
        rows.append(row)
    (options.out / f"tiles-{options.what}.json").write_text(json.dumps(rows, indent=1))
    if options.what == "growth":
        growth.plot(rows, options.out / "tiles-growth.png")


main()
