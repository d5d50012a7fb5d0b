# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What of `bench.tiles` is measured, as tables and a plot."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.rows import kept
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
    made = module.rows(options.cases, options.quick, options.out)
    rows = kept(made, "bench.tiles", options.out / f"tiles-{options.what}.json")
    if options.what == "growth":
        growth.plot(rows, options.out / "tiles-growth.png")


main()
