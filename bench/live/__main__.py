# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What of `bench.live` is measured, as a table and, of circles, a plot. Times are those of the processor unless named."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from bench.live import accuracy, circles, growth, intensities, kills, loops, rates, readers, removal, tracking
from bench.rows import kept

_COMMANDS = {
    "rates": rates,
    "accuracy": accuracy,
    "intensities": intensities,
    "growth": growth,
    "removal": removal,
    "circles": circles,
    "kills": kills,
    "loops": loops,
    "readers": readers,
    "tracking": tracking,
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.live", description=__doc__)
    parser.add_argument("what", choices=_COMMANDS)
    parser.add_argument(
        "cases",
        nargs="*",
        help="scenes, of `accuracy` and `intensities` also files, of `circles` a number of scans; default: all",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the scenes")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--tenths", type=int, nargs="+", default=range(1, 11), help="of `accuracy`")
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    parser.add_argument("--out", type=Path, default=Path("bench_results"))
    options = parser.parse_intermixed_args()
    torch.set_num_threads(options.threads)
    options.out.mkdir(parents=True, exist_ok=True)
    made = _COMMANDS[options.what].rows(options)
    rows = kept(made, "bench.live", options.out / f"live-{options.what}.json")
    if options.what == "circles":
        circles.plot(rows, options.out / "live-circles.png")


main()
