# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Returns that are read a second: `python -m bench.reading`, in each format, beside Open3D or rosbags.

The scans are in the cache of the system. Each time is the least of some; `radarsdf` finds the files, parses the poses and
checks every return, a peer only reads the points. The table is printed and written to `bench_results/reading.md`.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from radarsdf.io import read

from bench.paper.report import ROOT
from bench.timing import timed

from .formats import FORMATS, Format, make_scans, poses

_TOLERANCE = 1e-3  # of the sum of a million coordinates of some metres, rounded to 1e-4 in text


def main(arguments: list[str] | None = None) -> None:
    """Measure, print and write the table."""
    words = _parser().parse_args(arguments)
    logging.getLogger("radarsdf.io").setLevel(logging.ERROR)  # that bags have no extrinsic
    count, returns, repetitions = (
        (3, 100, 1) if words.quick else (words.scans, words.returns, words.repetitions)
    )
    scans = make_scans(count, returns)
    expected = float(sum(scan[:, :3].sum(dtype=np.float64) for scan in scans))
    lines = [
        f"{count} scans of {returns} returns.",
        "",
        "| format | million returns a second | bytes a return | peer | million returns a second |",
        "|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    for name in words.only or FORMATS:
        with tempfile.TemporaryDirectory() as folder:
            lines.append(_row(name, FORMATS[name], Path(folder), scans, expected, repetitions))
        print(lines[-1], flush=True)
    words.out.mkdir(parents=True, exist_ok=True)
    (words.out / "reading.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(name: str, form: Format, folder: Path, scans: list, expected: float, repetitions: int) -> str:  # type: ignore[type-arg]
    path = form.write(folder, scans)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    count = sum(len(scan) for scan in scans)
    own = name.startswith((".npz", "ROS"))  # these hold their poses

    def by_radarsdf() -> float:
        stream = read(path) if own else read(path, poses(len(scans)))
        return float(sum(scan.points.sum(dtype=np.float64) for scan in stream))

    rates = [count / _least_s(by_radarsdf, expected, repetitions) / 1e6]
    words = [f"{rates[0]:.3g}", f"{size / count:.0f}"]
    if form.peer is None or form.peer_reads is None:
        words += ["", ""]
    else:
        peer = form.peer_reads
        try:
            words += [form.peer, f"{count / _least_s(lambda: peer(path), expected, repetitions) / 1e6:.3g}"]
        except ImportError:
            words += [form.peer, "not installed"]
    return f"| {name} | {' | '.join(words)} |"


def _least_s(measured: Callable[[], float], expected: float, repetitions: int) -> float:
    """The least wall-clock time of some calls, s, each of which must give the right sum."""
    times = []
    for _ in range(repetitions):
        with timed() as taken:
            total = measured()
        times.append(taken.wall_s)
        if abs(total - expected) > _TOLERANCE * max(1.0, abs(expected)):
            msg = f"the coordinates add up to {total}, not {expected}"
            raise ArithmeticError(msg)
    return min(times)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.reading", description=__doc__)
    parser.add_argument("--scans", type=int, default=200, help="default: 200")
    parser.add_argument("--returns", type=int, default=5000, help="of a scan; default: 5000")
    parser.add_argument("--repetitions", type=int, default=3, help="of which the fastest counts; default: 3")
    parser.add_argument("--only", nargs="+", choices=list(FORMATS), metavar="FORMAT", help="default: all")
    parser.add_argument("--quick", action="store_true", help="only check that it runs")
    parser.add_argument("--out", type=Path, default=ROOT / "bench_results", help="default: bench_results")
    return parser


if __name__ == "__main__":
    main()
