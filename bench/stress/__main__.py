# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Long random tests, one command each: `python -m bench.stress COMMAND`."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.stress", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    kernels = commands.add_parser("kernels", help="rounding errors of the kernels against float64")
    kernels.add_argument("--largest", type=int, default=1_000_000, help="largest batch; default: 1000000")
    files = commands.add_parser("files", help="damaged files for every reader")
    files.add_argument("--count", type=int, default=100_000, help="files in all; default: 100000")
    files.add_argument("--seed", type=int, default=0)
    files.add_argument("--only", nargs="+", metavar="READER", help="default: all")
    save = commands.add_parser("save", help="processes killed at random times while they save a map")
    save.add_argument("--count", type=int, default=200, help="kills; default: 200")
    random = commands.add_parser("arguments", help="random arguments for the public functions")
    random.add_argument("--count", type=int, default=2000, help="examples per function; default: 2000")
    interrupts = commands.add_parser("interrupts", help="Ctrl-C at many times during a fit and a mesh")
    interrupts.add_argument("--returns", type=int, default=3_000_000, help="default: 3000000")
    interrupts.add_argument("--count", type=int, default=40, help="interrupts of each; default: 40")
    memory = commands.add_parser(
        "memory", help="memory of fits against their estimates, and of many fits in a row"
    )
    memory.add_argument("--largest", type=int, default=3_000_000, help="most returns; default: 3000000")
    memory.add_argument("--count", type=int, default=100, help="fits in a row; default: 100")
    durations = commands.add_parser("durations", help="time of fits against their estimates")
    durations.add_argument("--largest", type=int, default=1_000_000, help="most returns; default: 1000000")
    durations.add_argument(
        "--repetitions", type=int, default=2, help="fits per case, of which the fastest counts; default: 2"
    )
    training = commands.add_parser("training", help="extreme settings, and very many iterations")
    training.add_argument("--iterations", type=int, default=1000, help="per case; default: 1000")
    training.add_argument(
        "--longest", type=int, default=100_000, help="iterations of the last case; default: 100000"
    )
    seeds = commands.add_parser("seeds", help="variation of the errors with the seed")
    seeds.add_argument("scenes", nargs="*", default=["hugin"], metavar="SCENE", help="default: hugin")
    seeds.add_argument("--count", type=int, default=10, help="seeds; default: 10")
    seeds.add_argument("--quick", action="store_true", help="only check that it runs")
    return parser


def main(arguments: list[str] | None = None) -> None:
    """Run one command. A failure ends the program with status 1."""
    words = _parser().parse_args(arguments)
    if words.command == "kernels":
        from .kernels import BATCHES, run  # noqa: PLC0415 - each command imports what it needs

        run(tuple(count for count in BATCHES if count <= words.largest))
    elif words.command == "files":
        from .files import run as run_files  # noqa: PLC0415

        sys.exit(not run_files(words.count, words.seed, words.only))
    elif words.command == "save":
        from .save import run as run_save  # noqa: PLC0415

        run_save(words.count)
    elif words.command == "interrupts":
        from .interrupts import run as run_interrupts  # noqa: PLC0415

        sys.exit(not run_interrupts(words.returns, words.count))
    elif words.command == "memory":
        from .memory import run as run_memory  # noqa: PLC0415

        sys.exit(not run_memory(words.largest, words.count))
    elif words.command == "durations":
        from .durations import run as run_durations  # noqa: PLC0415

        sys.exit(not run_durations(words.largest, words.repetitions))
    elif words.command == "training":
        from .training import run as run_training  # noqa: PLC0415

        run_training(words.iterations, words.longest)
    elif words.command == "seeds":
        from .seeds import run as run_seeds  # noqa: PLC0415

        run_seeds(words.scenes, words.count, quick=words.quick)
    else:
        environment = os.environ | {"RADARSDF_EXAMPLES": str(words.count)}
        folder = Path(__file__).parents[2] / "tests"
        tests = [folder / "test_arguments.py"]
        sys.exit(
            subprocess.run(
                [sys.executable, "-m", "pytest", "-q", *tests], env=environment, check=False
            ).returncode
        )


if __name__ == "__main__":
    main()
