# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`python -m bench.report run` measures; `write` makes `BENCHMARK.md`, its plots and the figures of other pages of it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from bench.paper.report import ROOT, write_json

from . import pages, results
from .document import DOCUMENT, WORD_LIMIT, document
from .experiments import EXPERIMENTS, NAMES, REAL, run
from .plots import PLOTS, draw

_RESULTS = ROOT / "bench" / "results.json"


def main(arguments: list[str] | None = None) -> None:
    """Run the experiments, or write the document, as the words of the command line say."""
    words = _parser().parse_args(arguments)
    try:
        if words.command == "run":
            _measure(words)
        elif words.check:
            _check(words.results, words.root)
        else:
            _write(words.results, words.root)
    except (ValueError, OSError) as error:
        sys.exit(str(error))


def _measure(words: argparse.Namespace) -> None:
    """Run each experiment and put it into the file at once: a run that is stopped leaves what it has.

    All of them begin a new file; those of `--only` join the file that is there.

    Raises
    ------
    ValueError
        If the file is of another run, or an experiment failed; the others are in the file all the same. If recorded
        scans are asked for, and not given.
    """
    if REAL in words.only and not words.real:
        msg = f"{REAL} needs recorded scans: --real FILE.npz ..."
        raise ValueError(msg)
    size = "quick" if words.quick else "long" if words.long else "usual"
    joins = bool(words.only) and words.out.exists()
    collected = results.read(words.out) if joins else None
    if collected is not None:
        results.merge(collected, results.begin(quick=words.quick))  # to refuse now, and not after minutes
    words.out.parent.mkdir(parents=True, exist_ok=True)
    failed: list[str] = []
    for name in words.only or [name for name in NAMES if words.real or name != REAL]:
        about = f"about {EXPERIMENTS[name].minutes:g} minutes" if size == "usual" else size
        _say(f"{name}: {about} …")
        new = results.begin(quick=words.quick)
        new["experiments"][name] = part = run(name, size=size, real=words.real)
        collected = new if collected is None else results.merge(collected, new, same_process=True)
        write_json(words.out, collected)
        _say(f"{name}: {part.get('why_not') or 'done'}")
        failed += [name] if part.get("why_not") else []
    _say(f"written: {words.out}")
    if failed:
        msg = f"failed: {', '.join(failed)}; the file says why"
        raise ValueError(msg)


def _write(path: Path, root: Path) -> None:
    found = results.read(path)
    text = document(found)
    filled = {page: pages.measured(old, found) for page, old in pages.pages(root).items()}
    (root / "docs").mkdir(parents=True, exist_ok=True)
    (root / DOCUMENT).write_text(text, encoding="utf-8")
    draw(found, root)
    for page, new in filled.items():
        page.write_text(new, encoding="utf-8")
    names = [*PLOTS, *(str(page.relative_to(root)) for page in filled)]
    _say(f"written: {DOCUMENT}, {len(text.split())} of {WORD_LIMIT} words; {', '.join(names)}")


def _check(path: Path, root: Path) -> None:
    """Whether document, plots and the figures of pages are what the results give.

    Raises
    ------
    ValueError
        If one of them is not.
    """
    found = results.read(path)
    again = f"run: python -m bench.report write {path}"
    if (root / DOCUMENT).read_text(encoding="utf-8") != document(found):
        msg = f"{DOCUMENT} is not what {path} gives; {again}"
        raise ValueError(msg)
    mark = results.digest(found).encode()
    for name in PLOTS:
        if mark not in (root / name).read_bytes():
            msg = f"{name} was not drawn from {path}; {again}"
            raise ValueError(msg)
    for page, text in pages.pages(root).items():
        if pages.measured(text, found) != text:
            msg = f"the figures of {page.relative_to(root)} are not those of {path}; {again}"
            raise ValueError(msg)
    _say(f"{DOCUMENT}, its plots and the figures of pages are what {path} gives")


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.report", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    measure = commands.add_parser("run", help="run the experiments, about 40 minutes on two cores")
    measure.add_argument("--out", type=Path, default=_RESULTS, help="the JSON; default: bench/results.json")
    measure.add_argument("--only", nargs="+", choices=NAMES, default=[], help="these, merged into the JSON")
    size = measure.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="only see that everything runs")
    size.add_argument("--long", action="store_true", help="also 3QFPI, all scenes")
    measure.add_argument(
        "--real",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE.npz",
        help="recorded scans with lidar and poses",
    )
    write = commands.add_parser("write", help="write BENCHMARK.md, its plots and the figures of pages")
    write.add_argument("results", type=Path, nargs="?", default=_RESULTS, help="default: bench/results.json")
    write.add_argument("--check", action="store_true", help="write nothing; fail where they would change")
    write.add_argument("--root", type=Path, default=ROOT, help="where they lie; default: this repository")
    return parser


if __name__ == "__main__":
    main()
